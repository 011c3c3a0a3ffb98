"""The control loop as identified from the records of step trials, and what it predicts."""
