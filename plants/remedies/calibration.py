"""Calibrations that records move further than they are believed to be off."""

GAIN_MOVED = 0.05
OFFSET_NOISES = 10.0
"""Changes of a calibration from which it comes first: a curve of the gauge for which no effect was
found has moved the torque's gain by 17 % and the offset by 34 noises."""
OFFSET_SHARE = 0.03
"""Change of an offset, as a share of the greatest reading, from which it is a finding by itself:
of 12 sound machines whose gauge and drive are up to 0.3 N off it comes out by 0.10 to 0.53 N, of
readings up to 25 N."""


def has_moved(name: str, given: float, fitted: float, offset_N: float | None) -> bool:
    """Whether a number of the base model is a calibration that moved by more than its tolerance.

    Args:
        name: Its name; no other than the torque's gain and the gauge's offset are calibrations.
        given: As given.
        fitted: As fitted.
        offset_N: Tolerance of the gauge's offset; None without a gauge.
    """
    if name == "torque_gain":
        return abs(fitted / (given or 1.0) - 1.0) > GAIN_MOVED
    return name == "gauge_offset_N" and offset_N is not None and abs(fitted - given) > offset_N
