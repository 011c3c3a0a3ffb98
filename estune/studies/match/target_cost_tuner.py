"""Finds, under noise, how much gentler the tuned gains must be for the cost to reach a level.

The path is the loop gain K of the standard form, `K (1 + 1/(Ti s) + Td s)`: P, I and D shrink by
one factor and their ratios stay. Of the one-parameter paths away from the optimum it is the best
conditioned: the cost rises most steeply along it, so that trials tell most exactly where the level
is met, and effort, noise in the effort and overshoot all fall on the way, while the gain margin
grows by the same factor. `experiments/equal_transparency.py` has it beside the setpoint filter
alone and the integrator alone.

With u = ln(K_tuned/K) >= 0 and the target eta*, the trials first go outward, doubling u, until one
costs more than eta*; then they stay near the root of the parabola through what was seen,

    ln eta(u) = a + b u + c u^2,    u* = 2 g/(b + sqrt(b^2 + 4 c g)) with g = ln eta* - a,

which is the crossing where the cost rises. The fit weights trials by how near they are.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.tuners.convergence import ConvergenceEstimate, CostPrediction
from estune.tuners.observation import Observation, log_cost
from estune.tuners.search_space import Point, SearchSpace
from estune.tuners.settings import check_above_zero, check_logarithmic

GENTLEST = 20.0
"""The loop gain may shrink by this factor, no further."""

FIRST_STEP = 0.1
"""Distance u of the first trial away from the start; the next doubles it."""

DITHER = 0.2
"""How far trials lie to either side of the root, as a share of it, less as they become many: they
keep the slope known, and the nearer they are, the less the shape of the curve matters."""

DISTANT = 0.25
"""Trials that lie from the root by this share of it have a quarter of the weight in the fit."""

COEFFICIENTS = 3


def detuning_path(gains: Gains) -> SearchSpace:
    """The path from tuned gains towards gentler ones: the loop gain K, at most what it is now.

    Args:
        gains: The tuned gains.
    """
    K, Ti, Td = gains.to_standard()
    held = {"Ti": Ti, "Td": Td, "setpoint_filter_s": gains.setpoint_filter_s}
    return SearchSpace(
        names=("K",),
        start=(K,),
        low=(K / GENTLEST,),
        high=(K,),
        form="standard",
        fixed=tuple((name, value) for name, value in held.items() if math.isfinite(value)),
    )


class LevelSeekerState(NamedTuple):
    """What was seen on the path before trial k."""

    k: int
    distances: tuple[float, ...]  # u of the safe trials
    logs: tuple[float, ...]  # logarithms of their costs
    nearest_unsafe: float  # least u of an unsafe trial; infinite until there was one
    best_point: Point  # what is recommended now
    best_cost: float | None  # the cost expected there


class _Fit(NamedTuple):
    """The parabola near a distance r: ln eta = a + b (u - r) + c (u - r)^2."""

    a: float
    b: float
    c: float
    variance: float  # of a
    noise: float  # of one trial's logarithm
    freedom: float


@dataclass(frozen=True, slots=True)
class TargetCostTuner:
    """A tuner, in the sense of `estune.tuners`, that looks for a level and not for the least.

    Attributes:
        space: A path of one parameter on a logarithmic scale that begins at its upper bound; see
            `gentler_path`.
        target: The cost eta* to be met.
        name: What the tuner is called.

    Raises:
        InvalidInput: the target is not above zero, or the space is not such a path.
    """

    space: SearchSpace
    target: float
    name: Literal["level_seeker"] = "level_seeker"

    def __post_init__(self) -> None:
        check_logarithmic("level_seeker", self.space)
        check_above_zero("level_seeker", "target", self.target)
        if len(self.space.names) != 1 or self.space.start != self.space.high:
            raise InvalidInput(
                f"level_seeker: the space tunes {', '.join(self.space.names)} from "
                f"{self.space.start}; give a path of one parameter that begins at its upper bound"
            )

    def __str__(self) -> str:
        return f"{self.name} of cost {self.target:.6g} from {self.space.gains(self.space.start)}"

    def start(self) -> LevelSeekerState:
        """The state before the first trial."""
        return LevelSeekerState(0, (), (), math.inf, self.space.start, None)

    def ask(self, state: LevelSeekerState) -> Point:
        """The next point of the path."""
        return self._point(self._next(state))

    def tell(self, state: LevelSeekerState, observation: Observation) -> LevelSeekerState:
        """The state after the trial last asked for.

        Raises:
            InvalidInput: the cost is not finite although the observation is not censored.
        """
        u, k = self._next(state), state.k + 1
        if observation.censored:
            return state._replace(k=k, nearest_unsafe=min(u, state.nearest_unsafe))
        told = state._replace(
            k=k,
            distances=(*state.distances, u),
            logs=(*state.logs, log_cost(observation)),
        )
        found = self._root(told)
        fit = _fitted(told.distances, told.logs, found)
        expected = math.exp(told.logs[-1] if fit is None else fit.a)
        return told._replace(best_point=self._point(found), best_cost=expected)

    def recommend(self, state: LevelSeekerState) -> Point:
        """Where the cost is expected to be nearest the target."""
        return state.best_point

    def outlook(self, state: LevelSeekerState) -> ConvergenceEstimate | None:
        """How well the level is met: `remaining` is the 95 % bound of the cost's error there."""
        fit = _fitted(state.distances, state.logs, self._root(state)) if state.logs else None
        if fit is None or not self._bracketed(state):
            return None
        error = math.sqrt(fit.variance)
        reach = _quantile(fit.freedom) * error
        sides = reach / max(abs(fit.b), 1e-9)
        u = self._root(state)
        interval = self._point(u + sides)[0], self._point(u - sides)[0]
        return ConvergenceEstimate(fit.noise, reach, error, (interval,))

    def forecast(self, state: LevelSeekerState, point: Point) -> CostPrediction:
        """What the parabola says of a point; nothing before there is one."""
        u = self.space.coordinates_high[0] - self.space.coordinates(point)[0]
        explored = bool(state.distances) and u <= max(state.distances)
        fit = _fitted(state.distances, state.logs, u)
        if fit is None:
            return CostPrediction(math.nan, 0.0, math.inf, explored)
        reach = _quantile(fit.freedom) * math.sqrt(fit.variance)
        ends = math.exp(fit.a - reach), math.exp(fit.a + reach) if reach < 1e2 else math.inf
        return CostPrediction(math.exp(fit.a), *ends, explored)

    def _next(self, state: LevelSeekerState) -> float:
        """Distance of the next trial."""
        if not state.logs:
            return 0.0 if state.k == 0 else self._within(FIRST_STEP / 2.0**state.k, state)
        if not self._bracketed(state) or len(set(state.distances)) < COEFFICIENTS:
            return self._within(max(FIRST_STEP, 2.0 * max(state.distances)), state)
        root = self._root(state)
        near = sum(abs(u - root) <= 1.5 * DITHER * root for u in state.distances)
        aside = DITHER / math.sqrt(1 + near) * (1.0 if state.k % 2 else -1.0)
        return self._within(root * (1.0 + aside), state)

    def _within(self, u: float, state: LevelSeekerState) -> float:
        """The distance held within the path, and half way to what was unsafe."""
        far = max(state.distances, default=0.0)
        return max(0.0, min(u, self._reach, (far + state.nearest_unsafe) / 2.0))

    def _bracketed(self, state: LevelSeekerState) -> bool:
        """Whether the farthest trials cost more than the target, or none may go farther."""
        far = max(state.distances)
        at = [cost for u, cost in zip(state.distances, state.logs, strict=True) if u == far]
        return sum(at) / len(at) >= math.log(self.target) or far >= self._reach

    def _root(self, state: LevelSeekerState) -> float:
        """The distance at which the cost is expected to cross the target, or come nearest."""
        far = max(state.distances)
        found = far
        for _ in range(2):  # once from afar, once with the weights of the place found
            fit = _fitted(state.distances, state.logs, found)
            if fit is None:
                return far if state.logs[-1] < math.log(self.target) else min(state.distances)
            found = min(max(0.0, found + _crossing(fit, math.log(self.target))), far)
        return found

    def _point(self, u: float) -> Point:
        return self.space.point((self.space.coordinates_high[0] - u,))

    @property
    def _reach(self) -> float:
        return self.space.coordinates_high[0] - self.space.coordinates_low[0]


def _quantile(freedom: float) -> float:
    """Student's t of a 95 % interval."""
    from scipy.special import stdtrit  # noqa: PLC0415  slow to import

    return float(stdtrit(freedom, 0.975))


def _crossing(fit: _Fit, level: float) -> float:
    """Where the parabola rises through the level; its lowest point where it is all above it.

    Infinite where it never gets there.
    """
    gap = level - fit.a
    square = fit.b**2 + 4.0 * fit.c * gap
    if square < 0.0:
        return -fit.b / (2.0 * fit.c) if fit.c > 0.0 else math.inf
    root = math.sqrt(square)
    # Two forms of one root: each is exact where the other subtracts like from like.
    if fit.b >= 0.0:
        return 2.0 * gap / (fit.b + root) if fit.b + root > 0.0 else math.inf
    return (root - fit.b) / (2.0 * fit.c) if fit.c != 0.0 else -math.inf


@lru_cache(maxsize=64)
def _fitted(distances: tuple[float, ...], logs: tuple[float, ...], near: float) -> _Fit | None:
    """The weighted parabola near a distance; None with fewer than three different distances."""
    if len(set(distances)) < COEFFICIENTS:
        return None
    u: NDArray[np.float64] = np.array(distances) - near
    width = DISTANT * max(near, FIRST_STEP)
    weights = 1.0 / (1.0 + (u / width) ** 2) ** 2
    rows = np.vander(u, COEFFICIENTS, increasing=True)
    inverse = np.linalg.pinv(rows.T @ (weights[:, None] * rows))
    a, b, c = inverse @ (rows.T @ (weights * logs))
    residuals = np.array(logs) - rows @ (a, b, c)
    freedom = float(weights.sum()) - COEFFICIENTS
    if freedom < 1.0:
        return _Fit(float(a), float(b), float(c), math.inf, math.nan, 1.0)
    noise = float(weights @ residuals**2) / freedom
    spread = inverse @ (rows.T @ (weights[:, None] ** 2 * rows)) @ inverse
    return _Fit(
        float(a), float(b), float(c), noise * float(spread[0, 0]), math.sqrt(noise), freedom
    )
