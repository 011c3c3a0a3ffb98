"""Root search under noise: how far to detune a reel for its cost to equal a target.

The path is the loop gain K of the standard form, `K (1 + 1/(Ti s) + Td s)`: P, I and D shrink by
one factor and their ratios stay. Effort, its noise and overshoot fall along it, and the gain
margin grows by the same factor.

With u = ln(K_tuned/K) >= 0 and the target eta*, the first trials go outward, doubling u, until one
costs more than eta*. The others stay near the root of the parabola fitted to all of them,

    ln eta(u) = a + b u + c u^2,    u* = 2 g/(b + sqrt(b^2 + 4 c g)) with g = ln eta* - a,

the crossing where the cost rises. The fit weights trials by their distance from the root.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.comparison import interval_factor
from estune.core.gains import Gains
from estune.core.quantities import check_positive
from estune.errors import InvalidInput
from estune.tuners.interface import ConvergenceEstimate, CostPrediction
from estune.tuners.observation import Observation, log_cost
from estune.tuners.search_space import Point, SearchSpace
from estune.tuners.settings import check_logarithmic

DETUNING_MAX = 20.0
"""Greatest reduction factor of the loop gain."""

FIRST_STEP = 0.1
"""Distance u of the first trial from the start; the next doubles it."""

DITHER = 0.2
"""Distance of trials to either side of the root, relative to it; reduced as they become many.
It keeps the slope observable; the smaller it is, the less the shape of the curve matters."""

WEIGHT_WIDTH = 0.25
"""Distance from the root, relative to it, at which a trial has a quarter of the weight."""

COEFFICIENTS = 3


def detuning_path(gains: Gains) -> SearchSpace:
    """The search space of detuned gains: the loop gain K, at most that of the tuned gains."""
    K, Ti, Td = gains.to_standard()
    fixed = {"Ti": Ti, "Td": Td, "setpoint_filter_s": gains.setpoint_filter_s}
    return SearchSpace(
        names=("K",),
        start=(K,),
        low=(K / DETUNING_MAX,),
        high=(K,),
        form="standard",
        fixed=tuple((name, value) for name, value in fixed.items() if math.isfinite(value)),
    )


class TargetCostState(NamedTuple):
    """The trials on the path before trial k."""

    k: int
    distances: tuple[float, ...]  # u of the safe trials
    logs: tuple[float, ...]  # logarithms of their costs
    nearest_unsafe: float  # least u of an unsafe trial; infinite without one
    best_point: Point  # the recommended point
    best_cost: float | None  # the cost expected there


class _Fit(NamedTuple):
    """The parabola near a distance r: ln eta = a + b (u - r) + c (u - r)^2."""

    a: float
    b: float
    c: float
    variance: float  # of a
    noise: float  # of one trial's logarithm
    degrees: float  # of freedom


@dataclass(frozen=True, slots=True)
class TargetCostTuner:
    """A tuner, in the sense of `estune.tuners`, that seeks a target cost instead of the least.

    Attributes:
        space: A path of one parameter on a logarithmic scale that begins at its upper bound; see
            `detuning_path`.

    Raises:
        InvalidInput: the target is not above zero, or the space is not such a path.
    """

    space: SearchSpace
    target: float
    name: Literal["level_seeker"] = "level_seeker"

    def __post_init__(self) -> None:
        check_logarithmic("level_seeker", self.space)
        check_positive("level_seeker: target", self.target)
        if len(self.space.names) != 1 or self.space.start != self.space.high:
            raise InvalidInput(
                f"level_seeker: the space tunes {', '.join(self.space.names)} from "
                f"{self.space.start}; give a path of one parameter that begins at its upper bound"
            )

    def __str__(self) -> str:
        return f"{self.name} of cost {self.target:.6g} from {self.space.gains(self.space.start)}"

    def start(self) -> TargetCostState:
        """The state before the first trial."""
        return TargetCostState(0, (), (), math.inf, self.space.start, None)

    def ask(self, state: TargetCostState) -> Point:
        """The next point of the path."""
        return self._point(self._next(state))

    def tell(self, state: TargetCostState, observation: Observation) -> TargetCostState:
        """The state after the trial last asked for.

        Raises:
            InvalidInput: the cost is not finite although the observation is not censored.
        """
        u, k = self._next(state), state.k + 1
        if observation.censored:
            return state._replace(k=k, nearest_unsafe=min(u, state.nearest_unsafe))
        after = state._replace(
            k=k,
            distances=(*state.distances, u),
            logs=(*state.logs, log_cost(observation)),
        )
        root = self._root(after)
        fit = _fit(after.distances, after.logs, root)
        expected = math.exp(after.logs[-1] if fit is None else fit.a)
        return after._replace(best_point=self._point(root), best_cost=expected)

    def recommend(self, state: TargetCostState) -> Point:
        """The point with the expected cost nearest the target."""
        return state.best_point

    def convergence(self, state: TargetCostState) -> ConvergenceEstimate | None:
        """The 95 % bound of the cost's error at the root, in place of an improvement."""
        if not state.logs:
            return None
        u = self._root(state)
        fit = _fit(state.distances, state.logs, u)
        if fit is None or not self._bracketed(state):
            return None
        error = math.sqrt(fit.variance)
        bound = interval_factor(fit.degrees) * error
        sides = bound / max(abs(fit.b), 1e-9)
        interval = self._point(u + sides)[0], self._point(u - sides)[0]
        return ConvergenceEstimate(fit.noise, bound, error, (interval,))

    def predict(self, state: TargetCostState, point: Point) -> CostPrediction:
        """The cost at a point by the parabola; an unlimited interval without one."""
        u = self.space.coordinate_bounds[1][0] - self.space.coordinates(point)[0]
        explored = bool(state.distances) and u <= max(state.distances)
        fit = _fit(state.distances, state.logs, u)
        if fit is None:
            return CostPrediction(math.nan, 0.0, math.inf, explored)
        half = interval_factor(fit.degrees) * math.sqrt(fit.variance)
        # Of few trials the interval may be of any width, and exp overflows from 710 on.
        ends = math.exp(fit.a - half), math.exp(fit.a + half) if half < 1e2 else math.inf
        return CostPrediction(math.exp(fit.a), *ends, explored)

    def _next(self, state: TargetCostState) -> float:
        if not state.logs:
            return 0.0 if state.k == 0 else self._within(FIRST_STEP / 2.0**state.k, state)
        if not self._bracketed(state) or len(set(state.distances)) < COEFFICIENTS:
            return self._within(max(FIRST_STEP, 2.0 * max(state.distances)), state)
        root = self._root(state)
        near = sum(abs(u - root) <= 1.5 * DITHER * root for u in state.distances)
        aside = DITHER / math.sqrt(1 + near) * (1.0 if state.k % 2 else -1.0)
        return self._within(root * (1.0 + aside), state)

    def _within(self, u: float, state: TargetCostState) -> float:
        """The distance limited to the path, and to half way to the nearest unsafe trial."""
        far = max(state.distances, default=0.0)
        return max(0.0, min(u, self._length, (far + state.nearest_unsafe) / 2.0))

    def _bracketed(self, state: TargetCostState) -> bool:
        """Whether the farthest trials cost more than the target, or lie at the end of the path."""
        far = max(state.distances)
        logs = [log for u, log in zip(state.distances, state.logs, strict=True) if u == far]
        return sum(logs) / len(logs) >= math.log(self.target) or far >= self._length

    def _root(self, state: TargetCostState) -> float:
        """The distance at which the expected cost crosses the target, or is nearest to it."""
        far = max(state.distances)
        root = far
        for _ in range(2):  # the second fit has the weights of the first one's root
            fit = _fit(state.distances, state.logs, root)
            if fit is None:
                return far if state.logs[-1] < math.log(self.target) else min(state.distances)
            root = min(max(0.0, root + _crossing(fit, math.log(self.target))), far)
        return root

    def _point(self, u: float) -> Point:
        return self.space.point((self.space.coordinate_bounds[1][0] - u,))

    @property
    def _length(self) -> float:
        (low,), (high,) = self.space.coordinate_bounds
        return high - low


def _crossing(fit: _Fit, log_target: float) -> float:
    """Position at which the parabola rises through the target; of its minimum if all above it.

    Infinite where it never rises to the target.
    """
    g = log_target - fit.a
    square = fit.b**2 + 4.0 * fit.c * g
    if square < 0.0:
        return -fit.b / (2.0 * fit.c) if fit.c > 0.0 else math.inf
    root = math.sqrt(square)
    # Two forms of one root: each avoids the cancellation that the other has.
    if fit.b >= 0.0:
        return 2.0 * g / (fit.b + root) if fit.b + root > 0.0 else math.inf
    return (root - fit.b) / (2.0 * fit.c) if fit.c != 0.0 else -math.inf


@lru_cache(maxsize=64)
def _fit(distances: tuple[float, ...], logs: tuple[float, ...], near: float) -> _Fit | None:
    """The parabola weighted about a distance; None with fewer than three distinct distances."""
    if len(set(distances)) < COEFFICIENTS:
        return None
    u: NDArray[np.float64] = np.array(distances) - near
    width = WEIGHT_WIDTH * max(near, FIRST_STEP)
    weights = 1.0 / (1.0 + (u / width) ** 2) ** 2
    rows = np.vander(u, COEFFICIENTS, increasing=True)
    inverse = np.linalg.pinv(rows.T @ (weights[:, None] * rows))
    a, b, c = inverse @ (rows.T @ (weights * logs))
    residuals = np.array(logs) - rows @ (a, b, c)
    degrees = float(weights.sum()) - COEFFICIENTS
    if degrees < 1.0:
        return _Fit(float(a), float(b), float(c), math.inf, math.nan, 1.0)
    variance = float(weights @ residuals**2) / degrees  # of one trial
    factor = inverse @ (rows.T @ (weights[:, None] ** 2 * rows)) @ inverse
    return _Fit(
        float(a), float(b), float(c), variance * float(factor[0, 0]), math.sqrt(variance), degrees
    )
