"""Newton's method on a machine: a curved model of the cost, and the trial that tells most of it.

Every trial is kept, and the logarithm of the cost is modelled over those of the parameters: first
by a wide model that knows little (`surface`), then by a cubic about the centre (`polynomial`).
With mean mu and standard deviation s of the model, each trial is asked for at the lower confidence
bound (Srinivas et al., Information-Theoretic Regret Bounds for Gaussian Process Optimization, IEEE
Trans. Information Theory 58, 2012),

    x(k) = argmin mu(x) - kappa s(x)       within reach of the centre, where it looks safe
    c(k) = argmin mu(x)                    the centre, which is what is recommended

so that it dithers by itself: along each direction as far as what is not known there may be worth,
which is little where the cost is steep, and less with every trial. A point looks safe where
mu + 2.5 s is at most `safe_ratio` times the start's cost and so many times the centre's, and the
margin foretold, less 2.5 s, at least `constraint_margin_min`. The reach shrinks after an unsafe trial and
recovers, see `guard`. What the costs of all loops have in common is known before the first trial,
see `experience`.

A plateau looks like an optimum to whoever looks no further than noise demands. Before the search
says that little is left, it looks `2 n` times further away once, up and down each axis of the
model, as far as looks safe, and once it has settled it strides along what seems to do nothing,
see `strides`. Where it finds less cost by that, the better place becomes the centre, and it looks
anew.
"""

import math
from dataclasses import dataclass
from statistics import median
from typing import Literal, NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.tuners.acquisition import Model, TrustRegion, minimise_confidence_bound, newton_step
from estune.tuners.interface import ConvergenceEstimate, CostPrediction
from estune.tuners.gaussian_process import fit_gaussian_process
from estune.tuners.local_cubic import FLAT, NOISE_EXPECTED, LocalCubicModel, fit_local_cubic
from estune.tuners.loop_prior import cost_prior
from estune.tuners.low_discrepancy import simplex
from estune.tuners.observation import COST_LIMIT, Observation, log_cost, usable_margin
from estune.tuners.plateau_scan import CAREFUL, PlateauScan, may_be_flat, next_scan_point
from estune.tuners.remaining_improvement import expected_gain, sample_quadratics
from estune.tuners.search_space import Coordinates, Point, SearchSpace
from estune.tuners.settings import check_above_zero, check_logarithmic
from estune.tuners.step_control import best_after, recover_after_safe, shrink_after_unsafe

UNSAFE = 1.0 + math.log(COST_LIMIT)
"""What a censored trial is remembered by; no cost reaches it."""

LOG_COST_MAX = math.log(2.25)
"""Costs count as at most 2.25 times the start's: how bad is bad says little of what is good."""

CLIFF = 1.25
"""And as at most this much above the least in their logarithm, as beyond the edge of stability."""

LITTLE = 0.05
"""Where less than this share of the cost is expected to be left, it is time to look further."""

SETTLED = 0.0125
"""Where less is expected to be left, the centre is firm enough to stride away from it."""

UNTRIED = 0.25
"""No less is said to be left before it has taken strides along what seems to do nothing."""

FURTHEST = 1.5
"""How far from the centre an outlook believes its model, in logarithms."""


def clip_log_costs(costs: FloatArray) -> FloatArray:
    """Logarithms of costs over the start's, those drawn down that are only known to be bad."""
    return np.minimum(costs, min(LOG_COST_MAX, float(np.sort(costs)[:3].mean()) + CLIFF))


class SafeBayesianState(NamedTuple):
    """Where the search stands before trial k; points are coordinates from the start on."""

    k: int
    tried: tuple[float, ...]  # every point, one after the other
    costs: tuple[float, ...]  # logarithms; UNSAFE where the trial was censored
    margins: tuple[float, ...]  # at most one
    centre: Coordinates
    curvature: tuple[float, ...]  # about the centre, by rows; empty before there is one
    noise: float  # standard deviation of one trial's cost, relative to it
    proposal: Point
    looks: int  # directions looked along further away, of 4 n
    strides: int  # made along the last of them; zero where there are none
    level: float | None  # logarithm of the cost of the first trials; None until they are made
    step_scale: float
    best_point: Point
    best_cost: float | None


@dataclass(frozen=True, slots=True)
class SafeBayesianTuner:
    """Models the cost and asks for the trial that promises most.

    Attributes:
        space: What is tuned, on a logarithmic scale.
        initial_radius: Size of the first design about the start, in logarithms for one parameter;
            it grows with the root of their number.
        global_radius: How far from the centre a trial may lie while the model is wide, in logarithms.
        local_radius: The same once it is near.
        local_rise: By how much the cost may be expected to rise there, relative to it.
        global_trials: Trials from which on the model is near, for each parameter.
        global_exploration: kappa while the model is wide.
        local_exploration: kappa once it is near.
        final_exploration: kappa once it has looked beyond plateaus: what is then left to gain is
            little, and a wider dither finds it sooner.
        safe_ratio: Cost over that of the start up to which a point counts as safe.
        global_safe_ratio: The same over the cost at the centre, while the model is wide.
        local_safe_ratio: The same once it is near: far from it the model then knows little.
        probe_radius: How far it looks for what lies beyond a plateau, in logarithms.
        probe_rise: By how much the cost may be expected to rise there, relative to it.
        constraint_margin_min: Share of every limit that is to be left, 0 to 1.
        memory: Trials that are kept; older ones are forgotten.
        name: What the tuner is called.

    Raises:
        InvalidInput: a setting is out of its range, or the scale is not logarithmic.
    """

    space: SearchSpace
    initial_radius: float = 0.15
    global_radius: float = 0.65
    local_radius: float = 0.5
    local_rise: float = 0.08
    global_trials: int = 7
    global_exploration: float = 2.2
    local_exploration: float = 2.5
    final_exploration: float = 5.0
    safe_ratio: float = 1.3
    global_safe_ratio: float = 1.65
    local_safe_ratio: float = 1.4
    probe_radius: float = 1.0
    probe_rise: float = 0.1
    constraint_margin_min: float = 0.1
    memory: int = 400
    name: Literal["safe_bayesian"] = "safe_bayesian"

    def __post_init__(self) -> None:
        check_logarithmic("safe_bayesian", self.space)
        for what in (
            *("initial_radius", "global_radius", "local_radius", "local_rise", "global_trials"),
            *(
                "global_exploration",
                "local_exploration",
                "final_exploration",
                "safe_ratio",
                "global_safe_ratio",
                "local_safe_ratio",
                "memory",
            ),
            *("probe_radius", "probe_rise"),
        ):
            check_above_zero("safe_bayesian", what, getattr(self, what))
        if not 0.0 <= self.constraint_margin_min < 1.0:
            raise InvalidInput(
                f"safe_bayesian: constraint_margin_min is {self.constraint_margin_min}; it must lie from 0 to below 1"
            )
        least = 4 * (len(self.space.names) + 1)
        if self.memory < least:
            raise InvalidInput(
                f"safe_bayesian: memory is {self.memory} trials; {len(self.space.names)} parameters need "
                f"at least {least}"
            )

    def start(self) -> SafeBayesianState:
        """The state before the first trial."""
        return SafeBayesianState(
            k=0,
            tried=(),
            costs=(),
            margins=(),
            centre=(0.0,) * len(self.space.names),
            curvature=(),
            noise=NOISE_EXPECTED,
            proposal=self._initial_design(0, 1.0),
            looks=0,
            strides=0,
            level=None,
            step_scale=1.0,
            best_point=self.space.start,
            best_cost=None,
        )

    def ask(self, state: SafeBayesianState) -> Point:
        """The point of the next trial, within the bounds."""
        return state.proposal

    def tell(self, state: SafeBayesianState, observation: Observation) -> SafeBayesianState:
        """The state after the trial last asked for.

        Raises:
            InvalidInput: the cost is not finite although the observation is not censored, or the
                margin is not a number.
        """
        n = len(self.space.names)
        best_point, best_cost = state.best_point, state.best_cost
        if observation.censored:
            cost, step_scale = UNSAFE, shrink_after_unsafe(state.step_scale)
        else:
            cost, step_scale = log_cost(observation), recover_after_safe(state.step_scale)
            best_point, best_cost = best_after(state, state.proposal, observation)
        state = state._replace(
            k=state.k + 1,
            tried=(*state.tried, *self._from_start(state.proposal))[-n * self.memory :],
            costs=(*state.costs, cost)[-self.memory :],
            margins=(*state.margins, usable_margin(observation))[-self.memory :],
            step_scale=step_scale,
            best_point=best_point,
            best_cost=best_cost,
        )
        if state.k <= n or best_cost is None:
            return state._replace(proposal=self._initial_design(state.k, step_scale))
        if state.level is None:
            safe = [cost for cost in state.costs if cost < UNSAFE]
            state = state._replace(level=median(safe))
        return (
            self._propose_global(state)
            if state.k <= self.global_trials * n
            else self._propose_local(state)
        )

    def recommend(self, state: SafeBayesianState) -> Point:
        """The centre of the search."""
        return self._point(np.array(state.centre))

    def convergence(self, state: SafeBayesianState) -> ConvergenceEstimate | None:
        """Where the search stands; None until it has looked further away."""
        n = len(self.space.names)
        if state.looks < 2 * n:
            return None
        reach = self._reach(np.array(state.centre), FURTHEST, 0.0)
        left = sample_quadratics(self._model(state), reach)
        low, high = np.quantile(left.least, (0.025, 0.975), axis=0)
        # Where the model ends, a direction counts as flat.
        low = np.where(low < reach.centre - 0.8 * FURTHEST, reach.low, low)
        high = np.where(high > reach.centre + 0.8 * FURTHEST, reach.high, high)
        remaining = -math.expm1(-float(np.quantile(left.gain, 0.95)))
        strode = state.looks == 4 * n and state.strides == 0
        return ConvergenceEstimate(
            noise=state.noise,
            remaining_improvement=remaining if strode else max(remaining, UNTRIED),
            expected_improvement=-math.expm1(-float(np.mean(left.gain))),
            intervals=tuple(zip(self._point(low), self._point(high), strict=True)),
        )

    def predict(self, state: SafeBayesianState, point: Point) -> CostPrediction:
        """What is expected of a point; nothing before there is a safe trial."""
        place = np.array([self._from_start(point)])
        safe = [cost < UNSAFE for cost in state.costs]
        known = np.reshape(state.tried, (len(safe), place.size))[safe]
        known = np.concatenate((known, np.zeros_like(place)))  # the start is known to be safe
        explored = bool(np.min(np.linalg.norm(known - place, axis=1)) <= self.local_radius)
        if state.level is None:
            return CostPrediction(cost=math.nan, low=0.0, high=math.inf, explored=explored)
        model: Model = self._model(state)
        if not state.curvature:
            model = fit_gaussian_process(
                *self._observations(state), state.noise, cost_prior(self.space.directions)
            )
        mean, spread = model.expected(place)
        low, mid, high = (
            math.exp(state.level + float(mean[0, 0]) + z * float(spread[0]))
            for z in (-1.96, 0.0, 1.96)
        )
        return CostPrediction(cost=mid, low=low, high=high, explored=explored)

    def _propose_global(self, state: SafeBayesianState) -> SafeBayesianState:
        """The next proposal and centre by the wide model."""
        points, values = self._observations(state)
        model = fit_gaussian_process(
            points, values, state.noise, cost_prior(self.space.directions)
        )
        smoothed = model.smoothed(values)
        best = int(np.argmin(smoothed))
        dearest = float(smoothed[best]) + math.log(self.global_safe_ratio)
        reach = self._reach(points[best], state.step_scale * self.global_radius, dearest)
        first = points[best : best + 1]
        centre = minimise_confidence_bound(model, reach, first, 0.0, state.k)
        asked = minimise_confidence_bound(model, reach, first, self.global_exploration, state.k)
        return state._replace(centre=tuple(centre.tolist()), proposal=self._point(asked))

    def _propose_local(self, state: SafeBayesianState) -> SafeBayesianState:
        """The next proposal and centre by the model about the centre."""
        model = self._model(state)
        if self._strides(state, model).found_lower_cost:
            found = np.reshape(state.tried[-2 * len(state.centre) :], (2, -1))
            found = found[int(np.argmin(state.costs[-2:]))]
            state = state._replace(centre=tuple(found.tolist()), curvature=(), looks=0, strides=0)
            model = self._model(state)
        values, axes = np.linalg.eigh(model.curvature)
        values = np.maximum(values, FLAT)
        rise = state.step_scale**2 * self.local_rise
        dearest = model.level + math.log(self.local_safe_ratio)
        reach = self._reach(model.centre, state.step_scale * self.local_radius, dearest)
        reach = reach._replace(axes=axes * np.sqrt(2.0 * rise / values))
        centre = reach.bounded(model.centre + newton_step(model.slope, values, axes, reach.radius))
        if model.coefficients.shape[1] > 1:  # a limit is near: the step must keep its distance
            centre = minimise_confidence_bound(
                model, reach, np.stack((centre, model.centre)), 0.0, state.k
            )
        state = state._replace(
            centre=tuple(centre.tolist()),
            curvature=tuple(((axes * values) @ axes.T).ravel().tolist()),
            noise=model.noise,
        )
        reach = reach._replace(centre=centre)
        looks, gain = 2 * len(centre), expected_gain(model, values, axes, reach)
        if 0 < state.looks < looks or (state.looks == 0 and gain < LITTLE):
            asked = self._probe_axis(state.looks, model, reach, values, axes)
            return state._replace(looks=state.looks + 1, proposal=self._point(asked))
        # What holds a centre at a bound is often a slope so slight that it never settles.
        settled = SETTLED if reach.is_inside(centre) else LITTLE
        if state.looks > looks or (state.looks == looks and gain < settled):
            state, further = self._scan_plateau(state, model, reach)
            if further is not None:
                return state._replace(proposal=self._point(further))
        curiosity = self.final_exploration if state.looks >= looks else self.local_exploration
        asked = minimise_confidence_bound(model, reach, centre[np.newaxis], curiosity, state.k)
        return state._replace(proposal=self._point(asked))

    def _probe_axis(
        self,
        number: int,
        model: LocalCubicModel,
        reach: TrustRegion,
        values: FloatArray,
        axes: FloatArray,
    ) -> FloatArray:
        """A point far away along one axis of the model, nearer by halves until it looks safe."""
        axis, sign = divmod(number, 2)
        far = min(self.probe_radius, math.sqrt(2.0 * self.probe_rise / float(values[axis])))
        away = (1.0 - 2.0 * sign) * far * axes[:, axis]
        points = reach.bounded(reach.centre + np.outer((1.0, 0.5, 0.25, 0.0), away))
        safe = reach.constraint_violation(*model.expected(points)) <= 0.0
        chosen: FloatArray = points[int(np.argmax(safe)) if safe.any() else -1]
        return chosen

    def _scan_plateau(
        self, state: SafeBayesianState, model: LocalCubicModel, reach: TrustRegion
    ) -> tuple[SafeBayesianState, FloatArray | None]:
        """The next stride along a parameter that may do nothing; None after the last one."""
        n = len(state.centre)
        if state.strides > 0:
            made, along = state.strides, state.looks - 1 - 2 * n
            point = next_scan_point(along, made, np.array(state.tried[-n:]), reach)
            near_limit = state.margins[-1] < 2.0 * self.constraint_margin_min
            ended = near_limit or self._strides(state, model).rose
            if point is not None and not ended and (made >= CAREFUL or may_be_flat(model, point)):
                return state._replace(strides=made + 1), point
        for looks in range(state.looks, 4 * n):
            point = next_scan_point(looks - 2 * n, 0, reach.centre, reach)
            if point is not None and may_be_flat(model, point) and reach.is_safe(model, point):
                return state._replace(looks=looks + 1, strides=1), point
        return state._replace(looks=4 * n, strides=0), None

    def _strides(self, state: SafeBayesianState, model: LocalCubicModel) -> PlateauScan:
        """What the strides along the present direction have cost."""
        costs = state.costs[len(state.costs) - state.strides :]
        return PlateauScan(costs, model.level + (state.level or 0.0), model.noise)

    def _model(self, state: SafeBayesianState) -> LocalCubicModel:
        """The model about the centre."""
        points, values = self._observations(state)
        known = cost_prior(self.space.directions).curvature
        curvature = np.reshape(state.curvature, known.shape) if state.curvature else known
        centre = np.array(state.centre)
        return fit_local_cubic(centre, curvature, points, values, noise=state.noise, known=known)

    def _observations(self, state: SafeBayesianState) -> tuple[FloatArray, FloatArray]:
        """Where trials were, and what they told: cost, and margin where any was near a limit."""
        points = np.reshape(state.tried, (len(state.costs), len(self.space.names)))
        costs = clip_log_costs(np.array(state.costs) - state.level)
        if min(state.margins) < 1.0:
            return points, np.stack((costs, np.array(state.margins)), axis=1)
        return points, costs[:, np.newaxis]

    def _reach(self, centre: FloatArray, radius: float, dearest: float) -> TrustRegion:
        """A ball about the centre, where costs are safe up to this logarithm."""
        start = np.array(self.space.coordinates(self.space.start))
        return TrustRegion(
            centre=centre,
            axes=radius * np.eye(len(centre)),
            radius=radius,
            low=np.array(self.space.coordinates_low) - start,
            high=np.array(self.space.coordinates_high) - start,
            log_cost_max=min(math.log(self.safe_ratio), dearest),
            margin=self.constraint_margin_min,
        )

    def _initial_design(self, k: int, step_scale: float) -> Point:
        """A corner of the first design, the nearer to the start the more of it was unsafe."""
        n = len(self.space.names)
        return self._point(step_scale * self.initial_radius * math.sqrt(n) * simplex(n)[k % (n + 1)])

    def _from_start(self, point: Point) -> Coordinates:
        """Coordinates of a point, from the start on."""
        start = self.space.coordinates(self.space.start)
        return tuple([c - s for c, s in zip(self.space.coordinates(point), start, strict=True)])

    def _point(self, from_start: FloatArray) -> Point:
        """The point at coordinates from the start on, rounded, within the bounds.

        Six digits are more than any gain needs, and few enough that the last bits of a matrix
        product, which differ from one machine to the next, do not show: a run can be resumed
        on another one.
        """
        start = self.space.coordinates(self.space.start)
        exact = self.space.point(
            tuple([s + c for s, c in zip(start, from_start.tolist(), strict=True)])
        )
        rows = zip(exact, self.space.low, self.space.high, strict=True)
        return tuple([min(max(float(f"{value:.6g}"), low), high) for value, low, high in rows])
