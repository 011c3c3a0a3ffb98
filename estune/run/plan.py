"""Plan of a run: everything that determines its trials."""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.setting import Setting, check_settings, documented
from estune.errors import InvalidInput
from estune.loop_model.optimum import RobustnessLimits
from estune.trial.profiles import StepProfile
from estune.tuners import Tuner
from estune.tuners.interface import (
    ConvergenceEstimate,
    EndingTuner,
    PredictingTuner,
    RecordUsingTuner,
)

TRIALS, REPEATS = 120, 2
"""Defaults of the greatest number of search trials and of repeats."""

TOLERANCE = 0.02
"""Default of the remaining improvement at which a search ends, relative to the cost."""

CONSECUTIVE_SETTLED = 4
"""Consecutive trials with a remaining improvement below the tolerance that end the search."""

PRECISION = 0.1
"""Default of the half-width of the interval of the improvement, as a share of it."""

CONFIRMATION_REPEATS_MAX = 10
"""Maximum repeats of each gains in a confirmation, unless the plan asks for more."""

SHOWING_MAX = 4
"""Most trials after the confirmation, to show that the confirmed gains keep the limits. On the 27
plants of `experiments.batch` with noise of 1 % of the step one trial showed them for four of the
six whose confirmation did not; for the other two 19 and more than 50 were foretold."""

EXCITATIONS, EXCITATIONS_MAX = 2, 5
"""Most excitations of a run: one at the initial gains, where these move the effort enough to be of
use, and one at better ones; and where the price of caution is known and they lower it."""

CAUTION_TRIALS = 10
"""Most trials of a run, its confirmation included, up to which further excitations lower the price
of caution."""


@documented
@dataclass(frozen=True, kw_only=True)
class Search:
    """Settings of a search for gains.

    Raises:
        InvalidInput: a value is out of its range.
    """

    trials: Annotated[int, Setting("Maximum number of search trials", least=1)] = TRIALS
    repeats: Annotated[
        int,
        Setting(
            "Least repeats of the initial and of the tuned gains in the confirmation, and of the "
            "initial gains before a search that does not identify the loop",
            least=1,
        ),
    ] = REPEATS
    tolerance: Annotated[
        float,
        Setting(
            "Remaining improvement, relative to the cost, at which the search ends, if the tuner "
            "estimates it; 0 makes it use all its trials",
            share=True,
            least=0.0,
            below=1.0,
        ),
    ] = TOLERANCE
    precision: Annotated[
        float,
        Setting(
            "Half-width of the interval of the improvement, as a share of it, at which the "
            "repeats of the confirmation end",
            share=True,
            above=0.0,
            below=1.0,
        ),
    ] = PRECISION
    eta_max: Annotated[
        float | None,
        Setting(
            "Cost above which a trial is unsafe",
            otherwise="three times the initial cost",
            above=0.0,
        ),
    ] = None

    def __post_init__(self) -> None:
        check_settings(self)


@documented
@dataclass(frozen=True)
class Plan(Search):
    """Everything that determines the trials of a run.

    Attributes:
        run: Name of the run; its trial ids begin with it.
        tuner: The tuner with its settings; its search space is centred on `start`.
        ask_first: Whether the operator must approve gains outside the region shown to be safe.
        start_source: Where initial gains come from that were not tried on the rig; the first
            record refuses them if their loop is not robust.
        limits: Limits of robustness by which the result is judged; None, as in runs of earlier
            versions, judges none.
        forced: Whether ill-posed trials are tuned by all the same.

    Raises:
        InvalidInput: a value is out of its range, the tuner does not predict which gains are
            safe, or the settling time is longer than the trial.
    """

    run: str
    tuner: Tuner[Any]
    start: Gains
    step: StepProfile
    cost: StepCost
    ask_first: bool = False
    start_source: str = ""
    limits: RobustnessLimits | None = None
    forced: bool = False

    def __post_init__(self) -> None:
        Search.__post_init__(self)
        if self.ask_first and not isinstance(self.tuner, PredictingTuner):
            raise InvalidInput(
                f"tuner {self.tuner.name} does not predict which gains are safe, as approval "
                "requires; use safe_bayesian"
            )
        if self.step.loop != "closed":
            raise InvalidInput(
                "the step is of an open loop, which tunes no controller; a drive without a gauge "
                "has no other: tune a rig, a reel or a linear_plant of what the loop measures"
            )
        after_s = self.step.duration_s - self.step.step_at_s
        if self.cost.settling_time_s > after_s:
            raise InvalidInput(
                f"settling time {self.cost.settling_time_s:g} s is longer than the {after_s:g} s "
                "after the step; make the trial longer, or choose a shorter settling time"
            )

    @property
    def max_trials(self) -> int:
        """Maximum number of trials, void ones excluded."""
        excitations, showing = (EXCITATIONS_MAX, SHOWING_MAX) if self.uses_records else (0, 0)
        choices = 2 * self.repeats * (1 + excitations)  # one more after each excitation
        confirmation = 2 * max(CONFIRMATION_REPEATS_MAX, self.repeats)
        searched = self.baseline_trials + excitations + self.trials
        return searched + choices + confirmation + showing

    @cached_property
    def uses_records(self) -> bool:
        """Whether the tuner identifies the loop from the records."""
        return isinstance(self.tuner, RecordUsingTuner)

    @property
    def needs_records(self) -> bool:
        """Whether the session needs the signals of a trial."""
        return self.uses_records or bool(self.start_source)

    @property
    def baseline_trials(self) -> int:
        """Trials of the initial gains before the search: one record identifies the loop."""
        return 1 if self.uses_records else self.repeats

    def settled_trials(self, tuner_state: Any) -> int:
        """Consecutive trials with little improvement left that end the search.

        One does where the identified loop predicts the costs: the confirmation tries what it
        recommends.
        """
        return 1 if self.is_predicted(tuner_state) else CONSECUTIVE_SETTLED

    def is_predicted(self, tuner_state: Any) -> bool:
        """Whether an identified loop predicts the costs.

        If not, repeats choose between the recommendation of a search and its best trial.
        """
        tuner = self.tuner
        return isinstance(tuner, RecordUsingTuner) and tuner.is_predicted(tuner_state)

    def would_repeat(self, tuner_state: Any) -> bool:
        """Whether the next trial would tell what an earlier one told."""
        tuner = self.tuner
        return (
            self.tolerance > 0.0
            and isinstance(tuner, RecordUsingTuner)
            and tuner.would_repeat(tuner_state, self.tolerance)
        )

    def may_end(self, tuner_state: Any) -> bool:
        """Whether the search may end by its tolerance."""
        tuner, tolerance = self.tuner, self.tolerance
        if not (tolerance and isinstance(tuner, EndingTuner)):
            return tolerance > 0.0
        return tuner.may_end(tuner_state, tolerance)

    def convergence(self, tuner_state: Any) -> ConvergenceEstimate | None:
        """Convergence of the search; None if the tuner has no estimate (yet)."""
        tuner = self.tuner
        return tuner.convergence(tuner_state) if isinstance(tuner, PredictingTuner) else None
