"""What is wrong with measurements, before anything is fitted to them."""
