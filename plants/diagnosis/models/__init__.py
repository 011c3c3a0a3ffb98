"""What may be held against measurements, and what is free in it."""
