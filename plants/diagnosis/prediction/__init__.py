"""Short predictions of many records at once, compiled."""
