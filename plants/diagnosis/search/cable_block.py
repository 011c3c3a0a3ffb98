"""Error power of cable and gauge, and that of the drum.

A drum that does not move as predicted shows in angle and tension alike, k R newtons a radian. What
is left of the tension beside that is the cable's and the gauge's own. So an effect of the one is
seen under an effect of the other whose law is not quite the machine's.
"""

import math

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.prediction.prediction import CHANNELS, Index

Powers = tuple[float, float]


def block_powers(index: Index, residuals: FloatArray, pull_N_rad: FloatArray) -> Powers:
    """Mean squares of the cable and gauge block, and of the rest; nan without gauge or encoder.

    (y - y^ - k R (theta - theta^))/sigma, sigma^2 = sigma_y^2 + (k R sigma_theta)^2, and what is
    left of both when each pair is turned into it.

    Args:
        index: What the entries stand for.
        residuals: Whitened, shape (entries,).
        pull_N_rad: k R of each record, shape (records,).
    """
    moment = index.measurement * (int(index.sample.max(initial=0)) + 1) + index.sample
    gauge, encoder = (
        np.flatnonzero(index.channel == CHANNELS.index(name))
        for name in ("tension_N", "angle_rad")
    )
    _, first, second = np.intersect1d(
        moment[gauge], moment[encoder], assume_unique=True, return_indices=True
    )
    if not first.size or not np.isfinite(pull_N_rad).all():
        return math.nan, math.nan
    gauge, encoder = gauge[first], encoder[second]
    mine = index.sigma[gauge]
    pulled = pull_N_rad[index.measurement[gauge]] * index.sigma[encoder]
    left = (residuals[gauge] * mine - residuals[encoder] * pulled) / np.hypot(mine, pulled)
    power = float(left @ left)
    return power / left.size, (float(residuals @ residuals) - power) / (residuals.size - left.size)
