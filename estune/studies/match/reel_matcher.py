"""Stages of a matching for one reel: reach, tune, match, apply.

Every trial goes through `estune.api.tune`: a reel's own tuning is one run, its matching another
with a `TargetCostTuner`, so that both are journalled, guarded by eta_max and resumable. A reel
that fails has a record with the reason.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from estune import api
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.errors import EstuneError, InvalidInput
from estune.run.ending import RunEnding
from estune.run.journal import FILE_NAME
from estune.run.loop import ProgressListener
from estune.run.plan import TRIALS
from estune.run.results.result import TuneResult
from estune.run.tally import UNSAFE_RATIO
from estune.run.targets import open_target
from estune.studies.match.outcome import (
    CostEstimate,
    MatchOutcome,
    ReelMatch,
    classify,
    estimate_cost,
)
from estune.studies.match.target_cost_tuner import TargetCostTuner, detuning_path
from estune.trial import RigDescription
from estune.trial.profiles import StepProfile
from estune.tuners import DEFAULT_TUNER

if TYPE_CHECKING:
    from estune.remote.security import Security

SEARCH_SHARE = 0.25
"""The search for the target ends once the 95 % bound of its error is this share of the tolerance;
the rest is for the interval of the repeats."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of a matching.

    Attributes:
        tolerance: Largest deviation from the target, relative to it.
        tuner: Name of the tuner of each reel's own tuning.
        trials: Greatest number of search trials of each reel's own tuning.
        match_trials: Search trials for the target on each reel.
        repeats: Repeats of the tuned and of the matched gains.

    Raises:
        InvalidInput: the tolerance is not between 0 and 1, or a count is too small.
    """

    tolerance: float = 0.02
    tuner: str = DEFAULT_TUNER
    trials: int = TRIALS
    match_trials: int = 16
    repeats: int = 6

    def __post_init__(self) -> None:
        if not 0.0 < self.tolerance < 1.0:
            raise InvalidInput(f"tolerance is {self.tolerance}; it must lie between 0 and 1")
        for name, least in (("trials", 1), ("match_trials", 6), ("repeats", 3)):
            if getattr(self, name) < least:
                raise InvalidInput(
                    f"{name} is {getattr(self, name)}; a matching needs at least {least}"
                )


@dataclass(frozen=True, slots=True)
class ReelProgress:
    """One reel between two stages; its description is None if it was not reached."""

    target: Any
    record: ReelMatch
    description: RigDescription | None = None

    def with_record(self, **changes: Any) -> "ReelProgress":
        """The reel with changes of its record."""
        return replace(self, record=replace(self.record, **changes))

    def with_failure(self, reason: str) -> "ReelProgress":
        """The reel as failed."""
        return self.with_record(outcome=MatchOutcome.FAILED, reason=reason)

    @property
    def failed(self) -> bool:
        """Whether the further stages skip it."""
        return self.record.outcome in (MatchOutcome.FAILED, MatchOutcome.OUT_OF_REACH)


@dataclass(frozen=True, slots=True)
class ReelMatcher:
    """The stages, with the arguments of `match` that they share."""

    settings: Settings
    folder: Path | None
    security: "Security | None"
    patience_s: float | None
    watch: ProgressListener | Literal["auto"] | None
    log: Callable[[str], None]

    def reached(self, label: str, target: Any) -> ReelProgress:
        """A reel with its rig's description."""
        reel = ReelProgress(target, ReelMatch(label, MatchOutcome.NOT_SHOWN, ""))
        try:
            with open_target(target, None, self.security, self.patience_s) as rig:
                description = rig.describe()
        except EstuneError as error:
            return reel.with_failure(str(error))
        name, length = description.name, description.cable_length_m
        return replace(reel, description=description).with_record(rig=name, cable_length_m=length)

    def tuned(self, reel: ReelProgress, step: StepProfile, cost: StepCost) -> ReelProgress:
        """The reel after its own tuning."""
        if reel.failed:
            return reel
        options: dict[str, Any] = {"tuner": self.settings.tuner, "trials": self.settings.trials}
        result = self._run(reel, "tune", {**options, "step": step, "cost": cost})
        if isinstance(result, EstuneError):
            return reel.with_failure(f"not tuned: {result}")
        return reel.with_record(
            tuned=result.gains,
            tuned_cost=_cost_of(result, result.gains),
            trials=len(result.entries),
        )

    def matched(
        self, reel: ReelProgress, target: float, step: StepProfile, cost: StepCost
    ) -> ReelProgress:
        """The reel after the search for the target, with its outcome."""
        tuned, tuned_cost = reel.record.tuned, reel.record.tuned_cost
        if reel.failed or tuned is None or tuned_cost is None:
            return reel
        if tuned_cost.low > target * (1.0 + self.settings.tolerance):
            return reel.with_record(
                outcome=MatchOutcome.OUT_OF_REACH, reason=_out_of_reach(tuned_cost, target)
            )
        tuner = TargetCostTuner(detuning_path(tuned), target)
        options: dict[str, Any] = {
            "tuner": tuner,
            "trials": self.settings.match_trials,
            "start": tuned,
            "eta_max": UNSAFE_RATIO * target,
            "tolerance": SEARCH_SHARE * self.settings.tolerance,
        }
        # The target is in the name, so that the same tunings serve another target too.
        stage = f"match-{target:.5g}".replace(".", "_")
        result = self._run(reel, stage, {**options, "step": step, "cost": cost})
        if isinstance(result, EstuneError):
            return reel.with_failure(f"not matched: {result}")
        gains = result.session.recommendation
        # This run's repeats of the tuned gains were not used to choose them.
        tuned_cost, matched_cost = _cost_of(result, tuned), _cost_of(result, gains)
        outcome, reason = classify(matched_cost, target, self.settings.tolerance)
        if gains == tuned and matched_cost.low > target:
            outcome, reason = MatchOutcome.OUT_OF_REACH, _out_of_reach(matched_cost, target)
        return reel.with_record(
            outcome=outcome,
            reason=reason,
            tuned_cost=tuned_cost,
            gains=gains,
            cost=matched_cost,
            trials=reel.record.trials + len(result.entries),
        )

    def applied(self, reel: ReelProgress) -> ReelProgress:
        """The reel with its matched gains live, if it passed."""
        gains = reel.record.gains
        if not reel.record.passed or gains is None:
            return reel
        try:
            with open_target(reel.target, None, self.security, self.patience_s) as rig:
                rig.apply(gains)
        except EstuneError as error:
            return reel.with_record(
                reason=f"{reel.record.reason}; its gains are not live: {error}"
            )
        return reel.with_record(live=True)

    def _run(
        self, reel: ReelProgress, stage: str, options: dict[str, Any]
    ) -> TuneResult | EstuneError:
        """One run on the reel, started, resumed or loaded; or the error that prevented it.

        Raises:
            InvalidInput: the run on disk has other settings.
        """
        options = {**options, "repeats": self.settings.repeats}
        name = f"{stage}-{reel.record.label}"
        shared = ("security", "patience_s", "watch")
        common: dict[str, Any] = {name: getattr(self, name) for name in shared}
        path = None
        if self.folder is not None:
            name = f"{self.folder.name}-{name}"
            if (self.folder / name / FILE_NAME).is_file():
                path = self.folder / name
        activity = "matching" if isinstance(options["tuner"], TargetCostTuner) else "tuning"
        try:
            if path is None:
                self.log(f"{reel.record.label}: {activity}")
                common |= {"run": name, "journal": self.folder is not None, "folder": self.folder}
                return api.tune(reel.target, **options, **common)
            result = api.load(path)
            _check_settings(path, result, options)
            if result.ending is RunEnding.STOPPED:
                self.log(f"{reel.record.label}: {activity} continued")
                result = api.resume(path, reel.target, **common)
        except _OtherSettings:
            raise
        except EstuneError as error:
            return error
        return result


class _OtherSettings(InvalidInput):
    """A run on disk has other settings."""


def _check_settings(path: Path, result: TuneResult, options: Mapping[str, Any]) -> None:
    for name, value in options.items():
        stored = getattr(result.plan, name)
        if name == "tuner" and isinstance(value, str):
            stored = stored.name
        if stored != value:
            raise _OtherSettings(
                f"{path} was begun with {name} {stored}, not {value}; give the same settings to "
                "continue it, or another folder"
            )


def _cost_of(result: TuneResult, gains: Gains) -> CostEstimate:
    """The cost of some gains by a run's confirmation, else that of the initial gains before it."""
    repeats, session = result.session.confirmation, result.session
    costs = dict(zip(repeats.gains, repeats.costs, strict=True)) if repeats else {}
    baseline = session.baseline if gains == session.plan.start else ()
    return estimate_cost(costs.get(gains) or baseline or [math.inf])


def _out_of_reach(cost: CostEstimate, target: float) -> str:
    return (
        f"its tuned gains cost {cost}, above the target {target:.4g}; raise eta, or repair the "
        "reel"
    )
