"""Gradient by least squares over neighbouring points, the paper's second method (section V-C).

The trials visit neighbours of the centre on an orthogonal design. The logarithm of the cost is
regressed on their coordinates, and the centre steps against the slope:

    minimise over (c, g)   sum_m lambda^(k-m) [l(m) - c - g . x(m)]^2
    th(k+1) = th(k) - gamma g, limited and straightened as in `step_control`

with x the logarithms of the parameters and l that of the cost. The regression forgets with
lambda = n/(n+1), a memory of n + 1 trials, the fewest that determine a slope. So the centre steps
after every trial, not only after a whole design. On a cost that is linear in these coordinates the
slope is exact from the first n + 1 trials on, even while the centre moves.
"""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

from estune.core.quantities import check_positive
from estune.tuners.observation import Observation, log_cost
from estune.tuners.perturbation import dither
from estune.tuners.search_space import Coordinates, Point, SearchSpace
from estune.tuners.settings import check_logarithmic
from estune.tuners.step_control import (
    best_after,
    clip_norm,
    kesten_step,
    recover_after_safe,
    shrink_after_unsafe,
)


class LeastSquaresGradientState(NamedTuple):
    """The state of the search before trial k."""

    k: int
    centre: Coordinates  # th(k), logarithms
    regressed: int  # trials in the regression since its last reset
    moments: tuple[float, ...]  # sum lambda^(k-m) v v' with v = (1, x, l), upper triangle by rows
    mean_step: tuple[float, ...]  # see `kesten_step`
    mean_length: float
    step_scale: float
    best_point: Point
    best_cost: float | None


@dataclass(frozen=True, slots=True)
class LeastSquaresGradient:
    """Descent along the slope of a linear regression on recent trials.

    Attributes:
        space: The tuned parameters, on a logarithmic scale.
        dither_amplitude: Distance of the neighbours from the centre, in logarithms.
        adaptation_gain: gamma, step in logarithms per slope of the logarithm of the cost.
        step_limit: Longest step of the centre between two trials, in logarithms.

    Raises:
        InvalidInput: a setting is out of its range, or the scale is not logarithmic.
    """

    space: SearchSpace
    dither_amplitude: float = 0.3
    adaptation_gain: float = 0.5
    step_limit: float = 0.1
    name: Literal["least_squares_gradient"] = "least_squares_gradient"

    def __post_init__(self) -> None:
        check_logarithmic(self.name, self.space)
        for setting in ("dither_amplitude", "adaptation_gain", "step_limit"):
            check_positive(f"{self.name}: {setting}", getattr(self, setting))

    def start(self) -> LeastSquaresGradientState:
        """The state before the first trial."""
        return LeastSquaresGradientState(
            k=0,
            centre=self.space.coordinates(self.space.start),
            regressed=0,
            moments=_no_moments(len(self.space.names)),
            mean_step=(0.0,) * len(self.space.names),
            mean_length=0.0,
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
        """The state after the trial last asked for."""
        n = len(self.space.names)
        if observation.censored:
            return self.start()._replace(
                k=state.k + 1,
                centre=self.space.coordinates(state.best_point),
                step_scale=shrink_after_unsafe(state.step_scale),
                best_point=state.best_point,
                best_cost=state.best_cost,
            )
        point = self.ask(state)
        best_point, best_cost = best_after(state, point, observation)
        # Relative to the start, so that the moments stay small and their differences exact.
        x = self.space.from_start(point)
        moments = _moments_with(state.moments, n / (n + 1), [1.0, *x, log_cost(observation)])
        centre, mean_step, mean_length = state.centre, state.mean_step, state.mean_length
        if state.regressed >= n:
            downhill = [-self.adaptation_gain * g for g in slope(moments, n)]
            step, mean_step, mean_length = kesten_step(
                clip_norm(tuple(downhill), state.step_scale * self.step_limit),
                mean_step,
                mean_length,
            )
            centre = self.space.clipped(
                tuple([th + s for th, s in zip(centre, step, strict=True)])
            )
        return LeastSquaresGradientState(
            k=state.k + 1,
            centre=centre,
            regressed=state.regressed + 1,
            moments=moments,
            mean_step=mean_step,
            mean_length=mean_length,
            step_scale=recover_after_safe(state.step_scale),
            best_point=best_point,
            best_cost=best_cost,
        )

    def recommend(self, state: LeastSquaresGradientState) -> Point:
        """The centre of the search, without dither."""
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

    Gauss elimination of the moments of (1, x, l); eliminating the first row centres the rest. The
    slope along a direction without variation is zero.

    Args:
        moments: Upper triangle by rows of the weighted moments of (1, x_1 ... x_n, l).
        parameters: n.
    """
    rows, first = [], 0
    for length in range(parameters + 2, 1, -1):
        rows.append(list(moments[first : first + length]))  # from the diagonal to the last column
        first += length
    pivot_min = [1e-12 * row[0] for row in rows]
    for j, pivot_row in enumerate(rows):
        if pivot_row[0] <= pivot_min[j]:
            pivot_row[0] = math.inf  # eliminates nothing, and its slope becomes zero
        for i in range(j + 1, parameters + 1):
            factor = pivot_row[i - j] / pivot_row[0]
            rows[i] = [a - factor * b for a, b in zip(rows[i], pivot_row[i - j :], strict=True)]
    solution: list[float] = []
    for row in reversed(rows[1:]):
        explained = sum([a * b for a, b in zip(row[1:-1], solution, strict=True)])
        solution.insert(0, (row[-1] - explained) / row[0])
    return tuple(solution)
