"""Small faults put into the source, and whether the tests notice them."""
