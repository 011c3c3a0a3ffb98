"""The paper's second method (section V-C): the slope by least squares over neighbouring points.

The trials visit neighbours of the centre on an orthogonal design, the logarithm of the cost is
regressed on where they were, and the centre steps against the slope:

    minimise over (c, g)   sum_m lambda^(k-m) [l(m) - c - g . x(m)]^2
    th(k+1) = th(k) - gamma g, limited and straightened as in `steps`

with x the logarithms of the parameters and l that of the cost. The regression forgets with
lambda = n/(n+1), a memory of n + 1 trials, the fewest that determine a slope; so the centre can
step after every trial and not only after a whole design, and on a cost that is linear in these
coordinates the slope is exact from the first n + 1 trials on, however the centre moved meanwhile.
"""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

from estune.tuners.observation import Observation, log_cost
from estune.tuners.perturbation import dither
from estune.tuners.search_space import Coordinates, Point, SearchSpace
from estune.tuners.settings import check_above_zero, check_logarithmic
from estune.tuners.step_control import (
    best_after,
    clip_norm,
    kesten_step,
    recover_after_safe,
    shrink_after_unsafe,
)


class LeastSquaresGradientState(NamedTuple):
    """Where the search stands before trial k."""

    k: int
    centre: Coordinates  # th(k), logarithms
    regressed: int  # trials in the regression since it last began
    moments: tuple[float, ...]  # sum lambda^(k-m) v v' with v = (1, x, l), upper triangle by rows
    drift: tuple[float, ...]  # mean step wanted, see `straightened`
    path: float  # mean length of it
    step_scale: float
    best_point: Point
    best_cost: float | None


@dataclass(frozen=True, slots=True)
class LeastSquaresGradient:
    """Steps against the slope of a linear regression on recent trials.

    Attributes:
        space: What is tuned, on a logarithmic scale.
        dither_amplitude: How far the neighbours lie from the centre, in logarithms.
        adaptation_gain: gamma, step in logarithms per slope of the logarithm of the cost.
        step_limit: Longest step of the centre between two trials, in logarithms.
        name: What the tuner is called.

    Raises:
        InvalidInput: a setting is out of its range, or the scale is not logarithmic.
    """

    space: SearchSpace
    dither_amplitude: float = 0.3
    adaptation_gain: float = 0.5
    step_limit: float = 0.1
    name: Literal["least_squares_gradient"] = "least_squares_gradient"

    def __post_init__(self) -> None:
        check_logarithmic("least_squares_gradient", self.space)
        for what in ("dither_amplitude", "adaptation_gain", "step_limit"):
            check_above_zero("least_squares_gradient", what, getattr(self, what))

    def start(self) -> LeastSquaresGradientState:
        """The state before the first trial."""
        return LeastSquaresGradientState(
            k=0,
            centre=self.space.coordinates(self.space.start),
            regressed=0,
            moments=_no_moments(len(self.space.names)),
            drift=(0.0,) * len(self.space.names),
            path=0.0,
            step_scale=1.0,
            best_point=self.space.start,
            best_cost=None,
        )

    def ask(self, state: LeastSquaresGradientState) -> Point:
        """The next neighbour of the centre, within the bounds."""
        k, alpha = state.k, state.step_scale * self.dither_amplitude
        rows = zip(state.centre, dither(len(state.centre)).frequencies, strict=True)
        return self.space.point(tuple([th + alpha * math.cos(w * k) for th, w in rows]))

    def tell(
        self, state: LeastSquaresGradientState, observation: Observation
    ) -> LeastSquaresGradientState:
        """The state after the trial last asked for.

        Raises:
            InvalidInput: the cost is not finite although the observation is not censored.
        """
        n = len(self.space.names)
        if observation.censored:
            return state._replace(
                k=state.k + 1,
                centre=self.space.coordinates(state.best_point),
                regressed=0,
                moments=_no_moments(n),
                drift=(0.0,) * n,
                path=0.0,
                step_scale=shrink_after_unsafe(state.step_scale),
            )
        point = self.ask(state)
        best_point, best_cost = best_after(state, point, observation)
        # Measured from the start, so that the moments stay small and their differences exact.
        origin = self.space.coordinates(self.space.start)
        x = [c - o for c, o in zip(self.space.coordinates(point), origin, strict=True)]
        moments = _moments_with(state.moments, n / (n + 1), [1.0, *x, log_cost(observation)])
        centre, drift, path = state.centre, state.drift, state.path
        if state.regressed >= n:
            wanted = clip_norm(
                tuple([-self.adaptation_gain * g for g in slope(moments, n)]),
                state.step_scale * self.step_limit,
            )
            step, drift, path = kesten_step(wanted, drift, path)
            centre = self.space.clipped(
                tuple([th + s for th, s in zip(centre, step, strict=True)])
            )
        return LeastSquaresGradientState(
            k=state.k + 1,
            centre=centre,
            regressed=state.regressed + 1,
            moments=moments,
            drift=drift,
            path=path,
            step_scale=recover_after_safe(state.step_scale),
            best_point=best_point,
            best_cost=best_cost,
        )

    def recommend(self, state: LeastSquaresGradientState) -> Point:
        """The search's centre, without dither."""
        return self.space.point(state.centre)


def _no_moments(parameters: int) -> tuple[float, ...]:
    return (0.0,) * ((parameters + 2) * (parameters + 3) // 2)


def _moments_with(
    moments: tuple[float, ...], forgetting: float, v: list[float]
) -> tuple[float, ...]:
    """The moments times the forgetting, plus v v', the upper triangle by rows."""
    products = [left * right for i, left in enumerate(v) for right in v[i:]]
    return tuple([forgetting * m + p for m, p in zip(moments, products, strict=True)])


def slope(moments: tuple[float, ...], parameters: int) -> tuple[float, ...]:
    """The slope of the weighted least-squares plane through the trials in the moments.

    Gauss elimination of the moments of (1, x, l); taking out the first row centres the rest.
    A direction the trials did not vary in has no slope to be known, and gets zero.

    Args:
        moments: Upper triangle by rows of the weighted moments of (1, x_1 ... x_n, l).
        parameters: n.
    """
    rows, first = [], 0
    for length in range(parameters + 2, 1, -1):
        rows.append(list(moments[first : first + length]))  # from the diagonal to the last column
        first += length
    least = [1e-12 * row[0] for row in rows]
    for j, pivot_row in enumerate(rows):
        if pivot_row[0] <= least[j]:
            pivot_row[0] = math.inf  # nothing is eliminated by it, and its slope comes out zero
        for i in range(j + 1, parameters + 1):
            factor = pivot_row[i - j] / pivot_row[0]
            rows[i] = [a - factor * b for a, b in zip(rows[i], pivot_row[i - j :], strict=True)]
    found: list[float] = []
    for row in reversed(rows[1:]):
        known = sum([a * b for a, b in zip(row[1:-1], found, strict=True)])
        found.insert(0, (row[-1] - known) / row[0])
    return tuple(found)
