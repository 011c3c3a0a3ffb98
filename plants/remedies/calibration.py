"""Calibrations that records move further than they are believed to be off."""

GAIN_MOVED = 0.05
OFFSET_NOISES = 10.0
"""Changes of a calibration from which it comes first: a curve of the gauge for which no effect was
found has moved the torque's gain by 17 % and the offset by 34 noises."""


def has_moved(name: str, given: float, fitted: float, noise_N: float | None) -> bool:
    """Whether a number of the base model is a calibration that moved by more than its tolerance.

    Args:
        name: Its name; no other than the torque's gain and the gauge's offset are calibrations.
        given: As given.
        fitted: As fitted.
        noise_N: Noise of the gauge, rms; None without one.
    """
    if name == "torque_gain":
        return abs(fitted / (given or 1.0) - 1.0) > GAIN_MOVED
    by_offset = name == "gauge_offset_N" and noise_N is not None
    return by_offset and abs(fitted - given) > OFFSET_NOISES * (noise_N or 0.0)
