"""Search for poles, noise and dead time of a linear loop model of given order.

The logarithms of the coordinates of the poles and of the sizes of the noise are searched from
several starts, the dead time, a whole number of samples, beside the best one found.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import product
from operator import attrgetter
from typing import NamedTuple, TypeVar

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.fit_signals import FitSignals
from estune.loop_model.least_squares import EVALUATIONS, NOISE_EVALUATIONS, Solution
from estune.loop_model.noise_model import WHITE, NoiseModel

T = TypeVar("T")

START_FREQUENCIES = (0.1, 0.5, 1.5)
START_DAMPINGS = (0.2, 1.0)
"""Poles that a search begins from, in units of 2 pi over the settling time."""

START_NOISES = (WHITE, NoiseModel(1.0, 0.0), NoiseModel(100.0, 0.0))
"""Noises that a search in records of ordinary service begins from."""

STARTS = 2
"""Starts that are improved, and one more without dead time: on a plant of 4 Hz in two trials of
the same gains most starts of the coarse grid ended at 25 samples of dead time and more."""

FINE, ROUGH = 1e-8, 1e-5
"""Relative decrease of the sum of squares at which a fit ends, and one that is only compared: the
tuned gains of 13 plants cost the same to 0.01 %, and a search takes half of the evaluations."""

by_cost = attrgetter("cost")


class PoleFit(NamedTuple):
    """A fit of the poles at one dead time.

    Attributes:
        cost: Half the sum of squared residuals, with the price of dead time.
        coordinates: Of the poles, and of the friction where there is any.
    """

    cost: float
    coordinates: FloatArray
    dead: int
    noise: NoiseModel = WHITE

    @classmethod
    def at(
        cls, signals: FitSignals, coordinates: FloatArray, dead: int, noise: NoiseModel = WHITE
    ) -> "PoleFit":
        """The fit of these poles as they are."""
        cost = Solution.at(signals, coordinates, dead, noise).cost
        return cls(cost, coordinates, dead, noise)

    def solution(self, signals: FitSignals) -> Solution:
        """Numerator, start states, offsets and residual of these poles."""
        return Solution.at(signals, self.coordinates, self.dead, self.noise)


def dead_times(settling_samples: float) -> list[int]:
    """Dead times that a search begins from, samples."""
    longest = max(2, round(settling_samples))
    return sorted({0, 1, 2, *np.geomspace(3, longest, 8).astype(int).tolist()})


def cold_starts(signals: FitSignals, noises: Iterable[NoiseModel] = (WHITE,)) -> list[PoleFit]:
    """The best fits of two poles from a coarse grid, the best first, with dead times far apart."""
    scale = 2.0 * math.pi / signals.settling_samples  # rad/sample
    delays = dead_times(signals.settling_samples)
    poles = [np.log([scale * f, z]) for f in START_FREQUENCIES for z in START_DAMPINGS]
    coarse = []
    for x, noise in product(poles, noises):
        cost, dead = Solution.least(signals, x, delays, noise)
        coarse.append(PoleFit(cost, x, dead, noise))
    ranked = sorted(coarse, key=by_cost)
    starts = [*ranked[:STARTS], ranked[0]._replace(dead=0)]
    found = list[PoleFit]()
    rough = [improve(signals, one, ROUGH) for one in starts]
    # The search of a load of no size ends early: readings in hundredths took another dead time.
    rough = [one._replace(noise=one.noise.counted) for one in rough]
    for fit in sorted(rough, key=by_cost):
        if all(abs(fit.dead - other.dead) > _first_step(other.dead) for other in found):
            found.append(fit)
    return [searched_dead_time(signals, found[:1]), *found[1:]]


def searched_dead_time(signals: FitSignals, starts: Sequence[PoleFit]) -> PoleFit:
    """The best dead time about some fits, the poles improved at each."""

    def fit(beside: PoleFit, dead: int) -> PoleFit:
        return improve(signals, beside._replace(dead=dead), ROUGH)

    best = min((improve(signals, start, ROUGH) for start in starts), key=by_cost)
    return improve(signals, search_dead_time(fit, best, _first_step(best.dead)))


def _first_step(dead: int) -> int:
    """Step, samples, by which a search about a dead time begins."""
    return max(1, dead // 8)


def search_dead_time(
    fit: Callable[[PoleFit, int], PoleFit], best: PoleFit, step: int = 1
) -> PoleFit:
    """The best dead time about a fit, by steps that shrink to one sample; each is fitted once."""
    tried = {best.dead}
    while True:
        beside = {best.dead - step, best.dead + step} - tried
        tried |= beside
        better = min((fit(best, d) for d in sorted(beside) if d >= 0), key=by_cost, default=best)
        if better.cost < best.cost:
            best = better
        elif step == 1:
            return best
        else:
            step = max(1, step // 3)


def remembered(f: Callable[[FloatArray], T]) -> Callable[[FloatArray], T]:
    """The function with its last value: a search asks for its first point twice."""
    known: dict[bytes, T] = {}

    def value(x: FloatArray) -> T:
        key = x.tobytes()
        if key not in known:
            known.clear()
            known[key] = f(x.copy())
        return known[key]

    return value


def least_point(
    residual: Callable[[FloatArray], FloatArray],
    start: FloatArray,
    slopes: Callable[[FloatArray], FloatArray],
    tolerances: tuple[float, float, float],
    evaluations: int,
) -> FloatArray:
    """Where a sum of squares is least, by Levenberg and Marquardt from a start.

    The tolerances are of the sum, of the point and of the gradient.
    """
    from scipy.optimize import leastsq  # noqa: PLC0415  slow to import

    limits = dict(zip(("ftol", "xtol", "gtol"), tolerances, strict=True))
    with np.errstate(over="ignore", invalid="ignore"):  # of a covariance that nobody uses
        x, *_ = leastsq(
            residual, start, Dfun=slopes, full_output=True, maxfev=evaluations, **limits
        )
    return np.asarray(x)


def improve(signals: FitSignals, start: PoleFit, tolerance: float = FINE) -> PoleFit:
    """Poles and noise of least squares; ends at this relative decrease of the sum of squares."""
    tolerances = (tolerance, 100.0 * tolerance, FINE)
    if start.noise.is_white:
        found = Solution.improved(signals, start.coordinates, start.dead, tolerances)
        if found is not None:
            return PoleFit(*found, start.dead, start.noise)
    first = start.solution(signals)

    @remembered
    def at(x: FloatArray) -> Solution:
        coordinates, noise = first.split(x)
        return Solution.at(signals, coordinates, start.dead, noise)

    @remembered
    def jacobian(x: FloatArray) -> FloatArray:
        # The numerator follows the poles, as by Kaufman (BIT 15, 1975).
        here = at(x)
        slopes = here.search_slopes(signals)
        return np.asarray(slopes - here.basis @ (here.basis.T @ slopes))

    most = EVALUATIONS if first.noise.is_white else NOISE_EVALUATIONS
    best = at(least_point(lambda x: at(x).residual, first.searched, jacobian, tolerances, most))
    return PoleFit(best.cost, best.coordinates, start.dead, best.noise)
