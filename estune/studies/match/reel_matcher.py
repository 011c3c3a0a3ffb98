"""What is done with one reel: reached, tuned on its own, brought to the target, made live.

Every trial goes through `estune.api.tune`: a reel's own tuning is one run, its matching another
with a `TargetCostTuner` as the tuner, so that both are journalled, guarded by eta_max, and resumed
where they were cut off. A reel that something is wrong with has a record that says so.
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
from estune.run.journal import FILE_NAME
from estune.run.loop import ProgressListener
from estune.run.plan import DEFAULT_TUNER
from estune.run.result import RunEnding, TuneResult
from estune.run.session import UNSAFE_RATIO, Phase
from estune.run.targets import open_target
from estune.studies.match.cost_estimate import level_of
from estune.studies.match.outcome import MatchOutcome, ReelMatch, classify, unreachable_message
from estune.studies.match.target_cost_tuner import TargetCostTuner, detuning_path
from estune.trial import RigDescription
from estune.trial.profiles import StepProfile

if TYPE_CHECKING:
    from estune.remote.security import Security

LEVEL_SHARE = 0.25
"""The search for the level ends once its error is surely within this share of the tolerance; the
rest is for the interval of the repeats."""

Told = Callable[[str], None]
"""Told in a line what is done next."""


@dataclass(frozen=True, slots=True)
class Settings:
    """How reels are matched.

    Attributes:
        tolerance: How far from the target a reel may be, relative to it.
        tuner: The tuner of each reel's own tuning, by name.
        trials: Greatest number of search trials of each reel's own tuning.
        match_trials: Trials that look for the target on each reel.
        repeats: Repeats of the tuned and of the matched gains.

    Raises:
        InvalidInput: the tolerance is not between 0 and 1, or a count is too small.
    """

    tolerance: float = 0.02
    tuner: str = DEFAULT_TUNER
    trials: int = 120
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
    """A reel under way.

    Attributes:
        target: Where it is.
        record: Its record so far.
        about: What its rig says of itself; None if it was not reached.
    """

    target: Any
    record: ReelMatch
    about: RigDescription | None = None

    def with_record(self, **changed: Any) -> "ReelProgress":
        """The same with another record."""
        return replace(self, record=replace(self.record, **changed))

    @property
    def lost(self) -> bool:
        """Whether nothing more can be done with it."""
        return self.record.standing in (MatchOutcome.FAILED, MatchOutcome.OUT_OF_REACH)


@dataclass(frozen=True, slots=True)
class ReelMatcher:
    """What is done with a reel, and what that needs.

    Attributes:
        settings: How reels are matched.
        folder: Where runs are kept, or None.
        security: Who this is, where a rig asks.
        watch: Told of each trial.
        tell: Told what is done next.
    """

    settings: Settings
    folder: Path | None
    security: "Security | None"
    watch: ProgressListener | Literal["auto"] | None
    tell: Told

    def reached(self, label: str, target: Any) -> ReelProgress:
        """A reel and what its rig says of itself."""
        record = ReelMatch(label, MatchOutcome.NOT_SHOWN, "")
        try:
            with open_target(target, security=self.security) as rig:
                about = rig.describe()
        except EstuneError as error:
            return ReelProgress(
                target, replace(record, standing=MatchOutcome.FAILED, reason=str(error))
            )
        record = replace(record, rig=about.name, cable_length_m=about.cable_length_m)
        return ReelProgress(target, record, about)

    def tuned(self, reel: ReelProgress, step: StepProfile, cost: StepCost) -> ReelProgress:
        """The reel with its own tuning."""
        if reel.lost:
            return reel
        options: dict[str, Any] = {
            "tuner": self.settings.tuner,
            "trials": self.settings.trials,
        }
        found = self._run(reel, "tune", {**options, "step": step, "cost": cost})
        if isinstance(found, EstuneError):
            return reel.with_record(standing=MatchOutcome.FAILED, reason=f"not tuned: {found}")
        return reel.with_record(
            tuned=found.gains,
            tuned_level=level_of(_repeats(found, found.gains)),
            trials=len(found.entries),
        )

    def matched(
        self, reel: ReelProgress, target: float, step: StepProfile, cost: StepCost
    ) -> ReelProgress:
        """The reel brought to the target, and judged."""
        tuned, level = reel.record.tuned, reel.record.tuned_level
        if reel.lost or tuned is None or level is None:
            return reel
        if level.low > target * (1.0 + self.settings.tolerance):
            return reel.with_record(
                standing=MatchOutcome.OUT_OF_REACH, reason=unreachable_message(level, target)
            )
        seeker = TargetCostTuner(detuning_path(tuned), target)
        options: dict[str, Any] = {
            "tuner": seeker,
            "trials": self.settings.match_trials,
            "start": tuned,
            "eta_max": UNSAFE_RATIO * target,
            "tolerance": LEVEL_SHARE * self.settings.tolerance,
        }
        # The target is in the name, so that the same tunings serve another target too.
        stage = f"match-{target:.5g}".replace(".", "_")
        found = self._run(reel, stage, {**options, "step": step, "cost": cost})
        if isinstance(found, EstuneError):
            return reel.with_record(standing=MatchOutcome.FAILED, reason=f"not matched: {found}")
        gains = seeker.space.gains(seeker.recommend(found.session.tuner_state))
        # This run's repeats of the tuned gains had no part in choosing them.
        level, fresh = (level_of(_repeats(found, g)) for g in (tuned, gains))
        if gains == tuned and fresh.low > target:
            standing, reason = MatchOutcome.OUT_OF_REACH, unreachable_message(fresh, target)
        else:
            standing, reason = classify(fresh, target, self.settings.tolerance)
        return reel.with_record(
            standing=standing,
            reason=reason,
            tuned_level=level,
            gains=gains,
            level=fresh,
            trials=reel.record.trials + len(found.entries),
        )

    def applied(self, reel: ReelProgress) -> ReelProgress:
        """The reel with its matched gains live, if it passed."""
        gains = reel.record.gains
        if not reel.record.passed or gains is None:
            return reel
        try:
            with open_target(reel.target, security=self.security) as rig:
                rig.apply(gains)
        except EstuneError as error:
            return reel.with_record(
                reason=f"{reel.record.reason}; its gains are not live: {error}"
            )
        return reel.with_record(live=True)

    def _run(
        self, reel: ReelProgress, stage: str, options: dict[str, Any]
    ) -> TuneResult | EstuneError:
        """One run on the reel, or why there is none: begun, gone on with, or read, as it stands.

        Raises:
            InvalidInput: it was begun with other settings.
        """
        options = {**options, "repeats": self.settings.repeats}
        name = f"{stage}-{reel.record.label}"
        common: dict[str, Any] = {"security": self.security, "watch": self.watch}
        path = None
        if self.folder is not None:
            name = f"{self.folder.name}-{name}"
            if (self.folder / name / FILE_NAME).is_file():
                path = self.folder / name
        doing = "matching" if isinstance(options["tuner"], TargetCostTuner) else "tuning"
        try:
            if path is None:
                self.tell(f"{reel.record.label}: {doing}")
                place: dict[str, Any] = {
                    "run": name,
                    "journal": self.folder is not None,
                    "folder": self.folder,
                }
                return api.tune(reel.target, **options, **common, **place)
            found = api.load(path)
            _check_same(path, found, options)
            if found.ending is RunEnding.STOPPED:
                self.tell(f"{reel.record.label}: {doing} goes on")
                found = api.resume(path, reel.target, **common)
        except _OtherSettings:
            raise
        except EstuneError as error:
            return error
        return found


class _OtherSettings(InvalidInput):
    """A matching on disk is not the one asked for."""


def _check_same(path: Path, found: TuneResult, options: Mapping[str, Any]) -> None:
    for name, value in options.items():
        made = getattr(found.plan, name)
        if name == "tuner" and isinstance(value, str):
            made = made.name
        if made != value:
            raise _OtherSettings(
                f"{path} was begun with {name} {made}, not {value}; say the same to go on with "
                "it, or give another folder"
            )


def _repeats(found: TuneResult, gains: Gains) -> list[float]:
    """Costs of a run's repeats of some gains; infinite where one was unsafe.

    Those after the search where there are any: they are nearer in time to what follows.
    """
    for phase in (Phase.CONFIRM, Phase.BASELINE):
        costs = [
            e.cost if math.isfinite(e.cost) else math.inf
            for e in found.entries
            if e.phase is phase and e.gains == gains and e.outcome and not e.outcome.is_void
        ]
        if costs:
            return costs
    return [math.inf]
