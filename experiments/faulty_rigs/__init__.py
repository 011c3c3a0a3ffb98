"""Deliberate faults of a rig, and who finds them."""
