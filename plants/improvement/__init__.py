"""Improvement of a rig's model by experiment, and the tuning of the rig with it."""
