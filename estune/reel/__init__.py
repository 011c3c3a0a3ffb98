"""What runs on the reel beside the PIDF: compensations, calibrations, estimation, hybrid control.

Pure like `estune.core`: functions of their arguments, with state as a value.
"""
