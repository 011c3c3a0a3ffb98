"""The Bayesian information criterion of a fit of a loop model."""

import math
from operator import attrgetter
from typing import NamedTuple

from estune.loop_model.fit_signals import FitSignals
from estune.loop_model.identification import PoleFit
from estune.loop_model.noise_model import NoiseModel
from estune.loop_model.nuisance import free_parameters


class Selected(NamedTuple):
    """A fit and its criterion.

    Attributes:
        criterion: N ln(sum of squares) + ln N times the number of parameters.
    """

    fit: PoleFit
    criterion: float


by_criterion = attrgetter("criterion")


def judged(signals: FitSignals, fit: PoleFit) -> Selected:
    """A fit with its criterion, infinite where it failed; a load or a drift of no size is none."""
    fit = fit._replace(noise=fit.noise.counted)
    # A colour without a load or a drift has no effect (`noise_model`): it is another fit.
    if not math.isfinite(fit.cost) or (fit.noise.is_white and fit.noise.colour):
        return Selected(fit, math.inf)
    return Selected(fit, criterion(signals, 2.0 * fit.cost, fit.coordinates.size, fit.noise))


def criterion_of(signals: FitSignals, fit: PoleFit) -> float:
    """The criterion of a fit."""
    return judged(signals, fit).criterion


def criterion(
    signals: FitSignals, squares: float, poles: int, noise: NoiseModel, further: int = 0
) -> float:
    """The criterion of a sum of squares, for a number of poles and of further parameters."""
    n = signals.samples
    # Below the resolution of the measurement nothing is left to explain.
    variance = squares / n + signals.resolution**2
    free = sum(free_parameters(group, poles, noise) for group in signals.groups)
    noises = sum(k > 0.0 for k in noise.sizes) + len(noise.colour)
    count = 2 * poles + 1 + noises + free + further
    return n * math.log(variance) + count * math.log(n)
