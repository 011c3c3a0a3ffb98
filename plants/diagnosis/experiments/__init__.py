"""What to measure: the battery, and the experiment that would decide."""
