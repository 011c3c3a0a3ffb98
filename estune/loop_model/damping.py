"""Damping of a mode that the records do not tell from none.

A least-squares fit of a mode that hardly decays within the records ends at a damping of zero in
about half the cases, and every gain that takes anything off it is then unstable by the model. The
posterior mean over dampings z above zero,

    E z = int z p(z) dz / int p(z) dz,     p(z) = exp(-(S(z) - S_min)/(2 s^2)),

with S the sum of squared residuals and s^2 their variance, is never zero, and is the estimate
itself where the records resolve it.
"""

import math

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.fit_signals import FitSignals
from estune.loop_model.identification import PoleFit
from estune.loop_model.poles import sections_of

RESOLVED = 9.0
"""Rise of S/s^2 from which a value counts as excluded, three standard deviations: an estimate as
far above zero differs from the mean by 0.2 %."""

LEAST = 1e-9
"""Damping that stands for none."""

POINTS = 17
"""Points of the integrals, evenly from zero to the largest damping that is not excluded."""


def with_mean_damping(signals: FitSignals, found: PoleFit) -> PoleFit:
    """The fit with each damping that could be zero at its posterior mean."""
    for i in range(1, found.coordinates.size, 2):
        if found.coordinates[i] < 0.0 and not sections_of(found.coordinates)[i // 2].grows:
            found = _with_mean(signals, found, i)
    return found


def _with_mean(signals: FitSignals, found: PoleFit, i: int) -> PoleFit:
    at = found.solution(signals)
    variance = at.squares / max(at.residual.size, 1)

    def rise(damping: float) -> float:
        moved = _moved(found.coordinates, i, damping)
        squares = found._replace(coordinates=moved).solution(signals).squares
        return (squares - at.squares) / max(variance, 1e-300)

    if rise(LEAST) > RESOLVED:
        return found
    largest = max(math.exp(found.coordinates[i]), 1e-6)
    while rise(largest) < RESOLVED:
        largest *= 2.0
        if largest > 1.0:  # there may be no such mode at all
            return found
    dampings = np.linspace(LEAST, largest, POINTS)
    rises = np.array([rise(float(damping)) for damping in dampings])
    weight = np.exp(-0.5 * (rises - rises.min()))
    weight[[0, -1]] *= 0.5
    moved = _moved(found.coordinates, i, float(weight @ dampings / weight.sum()))
    return PoleFit.at(signals, moved, found.dead, found.noise)


def _moved(coordinates: FloatArray, i: int, damping: float) -> FloatArray:
    moved = coordinates.copy()
    moved[i] = math.log(damping)
    return moved
