"""Functions of the reel beside the PIDF: compensation, calibration, estimation, hybrid control.

Pure like `estune.core`: functions of their arguments, with state as a value.
"""
