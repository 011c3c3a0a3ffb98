"""Tunes a gain schedule on reels of several lengths, as one journalled run."""

import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from estune import api
from estune.core.comparison import Change, compare_costs
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.schedule import GainSchedule
from estune.errors import InvalidInput
from estune.run.journal import FILE_NAME
from estune.run.loop import ProgressListener
from estune.run.result import RunEnding, TuneResult
from estune.run.session import Phase
from estune.run.targets import open_target
from estune.studies.joint.reels import AlternatingReels
from estune.studies.joint.schedule_tuner import ScheduleTuner
from estune.trial.profiles import StepProfile
from estune.tuners import DEFAULT_TUNER

if TYPE_CHECKING:
    from estune.remote.security import Security


@dataclass(frozen=True, slots=True)
class TunedSchedule:
    """What a joint tuning came to.

    Attributes:
        schedule: The schedule found.
        before: Mean cost of the start at each length, by length in m.
        after: The same of the schedule, from trials that had no part in finding it; infinite where
            one was unsafe.
        improvement: The change of the cost, geometric mean over the lengths, with its interval.
        result: The run. What it says of gains, that the start stands, is so for any schedule: it
            knows of one set of gains only.
    """

    schedule: GainSchedule
    before: Mapping[float, float]
    after: Mapping[float, float]
    improvement: Change
    result: TuneResult

    @property
    def success(self) -> bool:
        """Whether the schedule was confirmed to beat the start."""
        return self.improvement.is_decrease


def tune_schedule(
    targets: Mapping[float, Any],
    *,
    straight: Sequence[str] = ("I",),
    tuner: str = DEFAULT_TUNER,
    trials: int = 120,
    repeats: int = 3,
    start: Gains | None = None,
    step: StepProfile | None = None,
    cost: StepCost | None = None,
    run: str = "schedule",
    folder: str | Path = api.RUNS,
    journal: bool = True,
    security: "Security | None" = None,
    watch: ProgressListener | Literal["auto"] | None = None,
) -> TunedSchedule:
    """Tunes a schedule directly, by trials on reels of several lengths in turn.

    The rigs keep their live gains. A run that was cut off goes on with the same call; a run that
    is complete is read.

    Args:
        targets: The reels as `estune.tune` takes them, by their cable length in m. Two, at the
            ends, are enough for straight gains.
        straight: Gains that may change with length, linearly; the others are the same everywhere.
        tuner: Name of the tuner.
        trials: Greatest number of search trials, over all lengths; each proposal takes one at
            every length.
        repeats: Trials of the start, and of the schedule found, at every length.
        start: Gains to begin from at every length; the first rig's live ones by default.
        step: The step trial; the one the first rig suggests by default.
        cost: How a trial is scored; by default (35) with a move penalty and the longest settling
            time a rig suggests.
        run: Name of the run.
        folder: Where runs are kept.
        journal: Whether to keep the run on disk.
        security: Who this is, where a rig asks.
        watch: Told of each trial; "auto" shows progress, None nothing.

    Raises:
        InvalidInput: a value is not usable, a rig says that its length is another, or the run on
            disk is not this one.
        RigError: a rig cannot be reached or refuses.
        UnsafeStart: the start is unsafe at one of the lengths.
        Stopped: interrupted (a KeyboardInterrupt); the rigs are back at their live gains.

    Example:
        >>> import estune, plants
        >>> reels = {length: plants.reference_reel(length) for length in (0.5, 1.4)}
        >>> found = estune.tune_schedule(reels, trials=60, journal=False)
        >>> found.success
        True
    """
    lengths = tuple(targets)
    rounds = trials // max(len(lengths), 1)
    if rounds < 1 or repeats < 2:
        raise InvalidInput(
            f"{trials} trials and {repeats} repeats over {len(lengths)} lengths: give one trial "
            "for each length at least, and two repeats"
        )
    with ExitStack() as stack:
        rigs = [stack.enter_context(open_target(t, security=security)) for t in targets.values()]
        for length, rig in zip(lengths, rigs, strict=True):
            said = rig.describe().cable_length_m
            if said is not None and not math.isclose(said, length, rel_tol=0.01):
                raise InvalidInput(
                    f"rig {rig.describe().name} says that its cable is {said:g} m long, not "
                    f"{length:g} m; give its own length"
                )
        reels = AlternatingReels(rigs)
        start = start or reels.describe().gains
        searched = rounds * len(lengths)
        joint = ScheduleTuner(start, lengths, tuple(straight), tuner, searched)
        path = Path(folder) / run
        if journal and (path / FILE_NAME).is_file():
            result = api.load(path)
            if result.plan.tuner != joint:
                raise InvalidInput(f"{path} is a run with other settings; give another run name")
            if result.ending is RunEnding.STOPPED:
                result = api.resume(path, reels, watch=watch)
        else:
            result = api.tune(
                reels,
                tuner=joint,
                trials=searched + repeats * len(lengths),
                repeats=repeats * len(lengths),
                start=start,
                step=step,
                cost=cost,
                run=run,
                folder=folder,
                journal=journal,
                watch=watch,
            )
    return _judged(result)


def _judged(result: TuneResult) -> TunedSchedule:
    """The schedule of a run, and its checks beside the start."""
    joint = result.plan.tuner
    if not isinstance(joint, ScheduleTuner):
        raise InvalidInput(f"the run was made by {joint.name}, which tunes no schedule")
    lengths = joint.length_m
    told = [e for e in result.entries if e.outcome and not e.outcome.is_void]
    begun = [e.cost for e in told if e.phase is Phase.BASELINE]
    checks = [e for e in told if e.phase is Phase.SEARCH][joint.search_trials :]
    ended = [e.cost if math.isfinite(e.cost) else math.inf for e in checks]
    point = joint.recommended(result.session.tuner_state)
    return TunedSchedule(
        schedule=joint.schedules.schedule(point, result.plan.step.preload_N),
        before=_by_length(lengths, begun),
        after=_by_length(lengths, ended),
        improvement=compare_costs(_blocks(begun, len(lengths)), _blocks(ended, len(lengths))),
        result=result,
    )


def _by_length(lengths: Sequence[float], costs: Sequence[float]) -> dict[float, float]:
    m = len(lengths)
    return {
        length: math.fsum(costs[n::m]) / len(costs[n::m])
        for n, length in enumerate(lengths)
        if costs[n::m]
    }


def _blocks(costs: Sequence[float], m: int) -> list[float]:
    """Geometric means of one round over the lengths each."""
    rounds = [costs[n : n + m] for n in range(0, len(costs) - m + 1, m)]
    return [math.exp(math.fsum(map(math.log, costs)) / m) for costs in rounds]
