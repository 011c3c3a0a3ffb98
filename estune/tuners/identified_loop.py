"""Model-based search: the loop identified from the records predicts the cost of any gains.

After each trial a linear model of the loop is fitted to the last records (`estune.loop_model`).
The next trial is the optimum of the cost it predicts,

    x(k) = argmin m(x),     m the logarithm of the predicted cost,

within limits of sensitivity and overshoot and a box about the best trial. Where the model leaves
a misfit, a surface of what the trials measured beyond its predictions is added to them
(`residual_surface`). Where the predictions fail, the fallback tuner proposes, which is told every
trial. The improvement that remains is estimated by draws from the posterior of the model. Measured
costs decide what is kept.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from estune.core.quantities import check_positive
from estune.loop_model.excitation import UnknownLoop
from estune.loop_model.fitting import fit_loop, fit_with_excitations
from estune.loop_model.half_widths import HalfWidths, half_widths
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.optimum import TOLERANCE, RobustnessLimits
from estune.loop_model.prediction import Prediction, StepTrial
from estune.loop_model.records import LoopRecord
from estune.tuners.identified_loop_state import IdentifiedLoopState
from estune.tuners.interface import ConvergenceEstimate, CostPrediction
from estune.tuners.model_convergence import model_convergence
from estune.tuners.observation import Observation, log_cost
from estune.tuners.points_by_loop import furthest_stable, with_other_derivative
from estune.tuners.predictions import ComparedTrial, difference, log_of_cost, measured_overshoot
from estune.tuners.safe_bayesian import SafeBayesianTuner
from estune.tuners.search_space import Coordinates, Point, SearchSpace
from estune.tuners.searched_loop import SearchedLoop
from estune.tuners.settings import check_logarithmic

MISFIT_MAX = 0.02
"""Misfit above which the fallback proposes. Up to it searches on plants outside the class (play,
disturbance, stiffening) end near the optimum; a reel with friction in its eyelet, 3 %, ends 23 %
above it by the model."""

PREDICTION_FAILED = 0.5
"""Median error of the last three predictions of the log cost from which the fallback proposes."""

ITERATIONS = 40
FIRST_ITERATIONS = 12
CLOSE_FROM = 2
"""Iterations of the search for the optimum, and those before the second record, when the optimum
is still further away than a trial may go."""

SCATTERED = 16
"""Low-discrepancy points of which the best is one more start of the search for the optimum."""

FORESEEN = 0.1
"""Error of the last prediction of the log cost below which the last optimum is enough to start
from, but after an excitation, which shows the loop anew."""


@dataclass(frozen=True, slots=True)
class IdentifiedLoopTuner:
    """Proposes the optimum of the identified loop within limits of sensitivity and overshoot.

    Attributes:
        space: The tuned parameters, on a logarithmic scale.
        trial: The step trial; without it the fallback tuner does all the search.
        limits: Limits of sensitivity, overshoot and phase margin.
        reach: Greatest distance of a trial from the best one in each logarithm.
        memory: Records that are fitted.

    Raises:
        InvalidInput: a setting is out of its range, or the scale is not logarithmic.
    """

    space: SearchSpace
    trial: StepTrial | None = None
    limits: RobustnessLimits = field(default_factory=RobustnessLimits)
    reach: float = 2.5
    memory: int = 10
    name: Literal["model_based"] = "model_based"

    def __post_init__(self) -> None:
        check_logarithmic(self.name, self.space)
        check_positive(f"{self.name}: reach", self.reach)
        check_positive(f"{self.name}: memory", self.memory)

    def for_trial(
        self, trial: StepTrial, limits: RobustnessLimits | None
    ) -> "IdentifiedLoopTuner":
        """The tuner for a step trial; without limits with its own."""
        return replace(self, trial=trial, limits=limits or self.limits)

    def start(self) -> IdentifiedLoopState:
        """The state before the first trial."""
        fallback, first = self._fallback.start(), self.space.coordinates(self.space.start)
        return IdentifiedLoopState(fallback, fallback.proposal, first, first, self.space.start)

    def ask(self, state: IdentifiedLoopState) -> Point:
        """The point of the next trial."""
        return state.proposal

    def tell_start(
        self, state: IdentifiedLoopState, observation: Observation
    ) -> IdentifiedLoopState:
        """The state after a trial of the initial gains."""
        return self.tell(state._replace(proposal=self.space.start), observation)

    def is_predicted(self, state: IdentifiedLoopState) -> bool:
        """Whether the identified loop proposes, not the fallback."""
        return state.fit is not None and not state.fallen_back

    def unknown_loop(self, state: IdentifiedLoopState) -> UnknownLoop | None:
        """The loop at the next point, where more excitation would tell more of it."""
        if state.fit is None or self.trial is None or not state.fit.responds:
            return None
        unknown = UnknownLoop(
            fit=state.fit,
            records=(*state.records, *state.excitations),
            gains=self.space.gains(state.proposal),
            tried=self.space.gains(self.space.point(state.base)),
            controller=self.trial.controller,
            price=state.caution,
        )
        return None if unknown.is_known else unknown

    def tell_excitation(
        self, state: IdentifiedLoopState, record: LoopRecord
    ) -> IdentifiedLoopState:
        """The state after a trial that excites the loop, which has no cost."""
        rate, asked_s = self._scales
        found = (*state.excitations, record)
        fit, kept = fit_with_excitations(state.records, found, rate, asked_s, state.fit)
        return self._decided(self._with_fit(state._replace(excitations=kept), fit), excited=True)

    def tell(self, state: IdentifiedLoopState, observation: Observation) -> IdentifiedLoopState:
        """The state after the trial last asked for."""
        point = state.proposal
        told = observation._replace(margin=self._overshoot_margin(observation))
        fallback = self._fallback.tell(state.fallback._replace(proposal=point), told)
        state = state._replace(
            fallback=fallback,
            step_scale=fallback.step_scale,
            best_point=fallback.best_point,
            best_cost=fallback.best_cost,
        )
        if observation.record is not None and self.trial is not None:
            state = self._learn(state, point, observation, observation.record)
        return self._decided(state)

    def _decided(
        self, state: IdentifiedLoopState, *, excited: bool = False
    ) -> IdentifiedLoopState:
        """The state with the next trial: the model's, or the fallback's where that fails."""
        recent = [abs(trial.error) for trial in state.trials[-3:]]
        failed = len(recent) == 3 and float(np.median(recent)) > PREDICTION_FAILED  # not with NaN
        if state.fit is None or state.best_cost is None or failed:
            return self._fall_back(state)
        if state.fit.model_misfit > MISFIT_MAX:
            return self._fall_back(state)
        # From a tried point that a model calls unstable the search would go to far smaller gains.
        held = math.isfinite(self._loop(state, state.fit).predicted(state.base).cost)
        if not (held or state.fit.is_white):
            return self._fall_back(state)
        foreseen = abs(state.trials[-1].error) < FORESEEN and not excited  # not with NaN
        return self._propose(state, state.fit, foreseen=foreseen)

    def _overshoot_margin(self, observation: Observation) -> float:
        """Constraint margin for the fallback: its least where the overshoot is at its limit.

        The fallback cannot know Ms, but each record shows its overshoot.
        """
        most, record = self.limits.max_overshoot, observation.record
        if most is None or record is None or self.trial is None or observation.censored:
            return observation.margin
        least = self._fallback.constraint_margin_min
        share = measured_overshoot(record, self.trial) / most
        return min(observation.margin, 1.0 - (1.0 - least) * share)

    def recommend(self, state: IdentifiedLoopState) -> Point:
        """The optimum of the model, corrected by the measured costs."""
        return self.space.point(state.centre)

    def convergence(self, state: IdentifiedLoopState) -> ConvergenceEstimate | None:
        """The state of convergence; None while too little is known."""
        if state.fallen_back:
            return self._fallback.convergence(state.fallback)
        return state.estimate

    def may_end(self, state: IdentifiedLoopState, tolerance: float) -> bool:
        """Whether the remaining improvement may be below the tolerance."""
        return not state.fallen_back or self._fallback.may_end(state.fallback, tolerance)

    def would_repeat(self, state: IdentifiedLoopState, tolerance: float) -> bool:
        """Whether the model predicts of the next trial what it predicts of one that was run."""
        if state.fit is None or state.fallen_back:
            return False
        loop, run = self._loop(state, state.fit), state.trials[-self.memory :]
        following = loop.predicted(self.space.coordinates(state.proposal))
        return any(difference(loop.predicted(one.x), following) < tolerance for one in run)

    def predict(self, state: IdentifiedLoopState, point: Point) -> CostPrediction:
        """The predicted cost of a point, by the fallback's model of the cost."""
        return self._fallback.predict(state.fallback, point)

    @property
    def _fallback(self) -> SafeBayesianTuner:
        return SafeBayesianTuner(self.space)

    def _fall_back(self, state: IdentifiedLoopState) -> IdentifiedLoopState:
        tuner = self._fallback
        return state._replace(
            proposal=self._stable(state, tuner.ask(state.fallback)),
            centre=self.space.coordinates(tuner.recommend(state.fallback)),
            caution=None,
            estimate=None,
            fallen_back=True,
        )

    def _stable(self, state: IdentifiedLoopState, proposal: Point) -> Point:
        """The furthest stable point on the way to a proposal; that itself without a model."""
        fit = state.fit
        if fit is None or not fit.responds:
            return proposal
        settings, limit = self._trial.controller, self.limits.max_sensitivity
        return furthest_stable(self.space, (state.base, proposal), fit.model, settings, limit)

    def _learn(
        self,
        state: IdentifiedLoopState,
        point: Point,
        observation: Observation,
        record: LoopRecord,
    ) -> IdentifiedLoopState:
        """The state with the model fitted to one more record, of an unsafe trial too."""
        x, last = self.space.coordinates(point), state.fit
        predicted = log_of_cost(self._loop(state, last).predicted(x)) if last else math.nan
        state = state._replace(records=(*state.records, record)[-self.memory :])
        if not observation.censored:
            cost, overshoot = log_cost(observation), measured_overshoot(record, self._trial)
            run = ComparedTrial(x, cost, overshoot, cost - predicted)
            state = state._replace(trials=(*state.trials, run))
        records = (*state.records, *state.excitations)
        return self._with_fit(state, fit_loop(records, *self._scales, state.fit))

    @property
    def _trial(self) -> StepTrial:
        assert self.trial is not None  # noqa: S101  there is a record, so there was a trial
        return self.trial

    @property
    def _scales(self) -> tuple[float, float]:
        """Sampling rate and settling time asked for."""
        return self._trial.controller.sampling_Hz, self._trial.cost.settling_time_s

    def _loop(self, state: IdentifiedLoopState, fit: LoopFit) -> SearchedLoop:
        """A fit with what its trials measured beyond it, and the region about the best of them."""
        return SearchedLoop(
            fit=fit,
            space=self.space,
            trial=replace(self._trial, rest_effort=state.records[-1].rest_effort),
            limits=self.limits,
            surface=state.surface,
            base=state.base,
            reach=self.reach * state.step_scale,
        )

    def _with_fit(self, state: IdentifiedLoopState, fit: LoopFit) -> IdentifiedLoopState:
        """The state with a model fitted to its records."""
        state = state._replace(fit=fit, surface=None)
        last = state.trials[-self.memory :]
        if not last:
            return state
        loop = self._loop(state, fit).with_surface(last, state.trials)
        # The least measured cost may be luck, and would hold the search back where little changes.
        recent = {one.x: loop.predicted(one.x) for one in last}
        return state._replace(
            surface=loop.surface,
            base=min(recent, key=lambda x: recent[x].cost),
            **self._best_kept(state, recent),
        )

    def _best_kept(
        self, state: IdentifiedLoopState, recent: Mapping[Coordinates, Prediction]
    ) -> dict[str, Any]:
        """The trial of least cost within the limits; the best of all where none kept them."""
        costs = {one.x: one.log_cost for one in state.trials}
        kept = [x for x, p in recent.items() if self.limits.excess(p).max() < TOLERANCE]
        if not kept:
            return {}
        best = min(kept, key=costs.__getitem__)
        return {"best_point": self.space.point(best), "best_cost": math.exp(costs[best])}

    def _propose(
        self, state: IdentifiedLoopState, fit: LoopFit, *, foreseen: bool
    ) -> IdentifiedLoopState:
        """The next trial and the centre by the model."""
        loop, known = self._loop(state, fit), len(state.trials) >= CLOSE_FROM
        search = loop.search(fit.model, HalfWidths.none() if known else None)
        best = np.array(state.base)
        optimum = search.minimise(
            [np.array(state.centre), best, *search.ends(best)],
            iterations=ITERATIONS if known else FIRST_ITERATIONS,
            scattered=0 if foreseen else SCATTERED,
            apart=()
            if foreseen
            else with_other_derivative(self.space, state.centre, self._scales[1]),
        )
        if not math.isfinite(optimum.prediction.cost):
            return self._fall_back(state)
        caution = estimate = None
        if known:
            least = log_of_cost(optimum.prediction)
            gains = self.space.gains(self.space.point(tuple(optimum.coordinates.tolist())))
            records = (*state.records, *state.excitations)
            beside = half_widths(fit, records, loop.trial, gains)
            optimum = loop.search(fit.model, beside).minimise([optimum.coordinates])
            # Where the reach holds the optimum back the next one is another loop.
            held = loop.holds_back(optimum)
            caution = 0.0 if held else log_of_cost(optimum.prediction) - least
            seed = len(state.trials)
            estimate = model_convergence(loop, optimum, beside, state.trials, seed)
        centre = tuple(optimum.coordinates.tolist())
        return state._replace(
            centre=centre,
            caution=caution,
            proposal=self.space.point(centre),
            estimate=estimate,
            fallen_back=False,
        )
