"""Library interface: tune a target, resume a run, load a run."""

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.response import CostFunction
from estune.core.setting import Setting, declared, keywords
from estune.errors import EstuneError, InvalidInput, JournalError, RigError
from estune.loop_model.optimum import RobustnessLimits
from estune.run import archived_run, loop, progress
from estune.run.approval import ApprovalCallback
from estune.run.behaviour import behaviour_profiles
from estune.run.journal import RECORDS_LEAST, RUNS, Journal
from estune.run.labels import write_numbers
from estune.run.loop import ProgressListener, Stopped
from estune.run.plan import Search
from estune.run.planning import (
    description_from_json,
    description_to_json,
    make_plan,
    plan_from_json,
    plan_to_json,
)
from estune.run.start import KnownStart, StartRule
from estune.run.targets import open_target
from estune.run.tuning_run import TuningRun
from estune.trial import Rig, RigDescription
from estune.trial.profiles import StepProfile
from estune.tuners import DEFAULT_TUNER, Tuner

if TYPE_CHECKING:
    from estune.remote.security import Security
    from estune.run.results.result import TuneResult
else:
    Security = Any  # slow to import


@dataclass(frozen=True, kw_only=True)
class TuneOptions(Search):
    """What a tuning is asked for."""

    tuner: Annotated[
        str | Tuner[Any], Setting("Name of a tuner, or a tuner", otherwise=DEFAULT_TUNER)
    ] = DEFAULT_TUNER
    start: Annotated[
        Gains | KnownStart | StartRule | Literal["model"] | None,
        Setting(
            'Initial gains; "model" for the optimum of the rig\'s own linear model, or from a law '
            "or an earlier run by `estune.start_from`",
            otherwise="the rig's live ones",
        ),
    ] = None
    bounds: Annotated[
        Mapping[str, tuple[float, float]] | None,
        Setting(
            "Lowest and highest value of gains, by name (P, I, D, setpoint_filter_s)",
            otherwise="the initial value over and times 10 000 with `model_based`, 100 with other "
            "tuners",
        ),
    ] = None
    step: Annotated[
        StepProfile | None, Setting("The step trial", otherwise="as the rig suggests")
    ] = None
    cost: Annotated[
        StepCost | str | CostFunction | None,
        Setting(
            'The cost of a trial. A name of `estune.core.cost.PRESETS` ("itae", "ise", '
            '"rejection", "tracking_and_rejection"), or a function of a `StepResponse`',
            otherwise="(35) with a control-move penalty and the settling time that the rig "
            "suggests",
        ),
    ] = None
    run: Annotated[str | None, Setting("Name of the run", otherwise="the time of day")] = None
    folder: Annotated[str | Path, Setting("Folder of runs")] = RUNS
    journal: Annotated[
        bool, Setting("Whether to store the run on disk, so that it can be resumed")
    ] = True
    records: Annotated[
        int | None,
        Setting(
            "Number of records that the run keeps on disk, the latest and those of repeats. Gains "
            "and costs are kept for ever",
            otherwise="all",
            least=RECORDS_LEAST,
        ),
    ] = None
    rig: Annotated[str | None, Setting("Name of the rig, if several answer at the endpoint")] = (
        None
    )
    security: Annotated[
        Security | None,
        Setting("Credentials, if the rig requires authentication; see `estune.remote.security`"),
    ] = None
    patience_s: Annotated[
        float | None,
        Setting(
            "How long to wait for the rig at an endpoint to appear, and where it stops replying",
            "s",
            otherwise="3 s and 30 s",
            above=0.0,
        ),
    ] = None
    watch: Annotated[
        ProgressListener | Literal["auto"] | None,
        Setting('Callback after each trial; "auto" shows progress, None nothing'),
    ] = "auto"
    ask: Annotated[
        ApprovalCallback | None,
        Setting(
            'Approval callback for gains outside the region shown to be safe; returns "yes", '
            '"no" or "always"'
        ),
    ] = None
    limits: Annotated[
        RobustnessLimits | None,
        Setting(
            "Limits of sensitivity, overshoot and phase margin that the tuner model_based keeps. "
            "Whatever the tuner, a result with Ms above 2.5 is not robust, unless the sensitivity "
            "has no limit",
            otherwise="1.6, 5 % and none",
        ),
    ] = None
    dead_time_s: Annotated[
        float | None,
        Setting("Dead time of a linear system or a function", "s", otherwise="none", least=0.0),
    ] = None
    sampling_Hz: Annotated[
        float | None,
        Setting(
            "Rate of the controller of a linear system or a function",
            "Hz",
            otherwise="200 samples in its settling time",
            above=0.0,
        ),
    ] = None
    force: Annotated[
        bool,
        Setting(
            "Whether to tune by ill-posed trials all the same: noise makes up more than a tenth "
            "of the cost, or the settling time is shorter than ten samples"
        ),
    ] = False
    tracking: Annotated[
        bool,
        Setting(
            "Whether to run a slow triangle and a rest after the tuning, at the initial and the "
            "tuned gains; what they show stands beside the cost"
        ),
    ] = False


@keywords(TuneOptions)
def tune(target: Any, options: TuneOptions) -> "TuneResult":
    """Tunes the PIDF gains of a rig by step trials.

    Trials use temporary gains: the rig restores its live gains after each. The tuned gains are in
    the result; only `estune apply` or `Rig.apply` makes them live.

    Args:
        target: An endpoint ("tcp/127.0.0.1:7447"), a plant ("reel.toml", "plants:reference_reel"
            or an object), a linear system of python-control or SciPy, a function `step(state,
            effort, dt_s) -> (state, measurement)`, both at its end, or a rig.

    Raises:
        InvalidInput: a value is not usable, or the rig gives no model to start from.
        RigError: the rig cannot be reached or refuses.
        JournalError: the run cannot be written.
        UnsafeStart: the initial gains are unsafe.
        Stopped: interrupted (a KeyboardInterrupt); the rig is back at its live gains.

    Example:
        >>> import estune, plants
        >>> result = estune.tune(plants.reference_reel(), trials=40, journal=False, watch=None)
        >>> result.success
        True
    """
    where = options.rig, options.security, options.patience_s
    own: dict[str, Any] = {"dead_time_s": options.dead_time_s, "sampling_Hz": options.sampling_Hz}
    start = options.start if isinstance(options.start, Gains) else None
    with open_target(target, *where, **own, gains=start) as the_rig:
        description = the_rig.describe()
        name = options.run or datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
        if not name.replace("-", "").replace("_", "").isalnum():
            raise InvalidInput(f"run name {name!r} may hold only letters, digits, - and _")
        plan = make_plan(
            *(description, name),
            tuner=options.tuner,
            start=options.start,
            bounds=options.bounds,
            step=options.step,
            cost=options.cost,
            limits=options.limits,
            ask_first=options.ask is not None,
            forced=options.force,
            **{member.name: getattr(options, member.name) for member in declared(Search)},
        )
        # Before the journal is begun: a run that is refused leaves no folder behind. The profiles
        # of the behaviour too, which would else be refused after all trials.
        description.limits.check(plan.step)
        if options.tracking:
            behaviour_profiles(description)
        book = None
        if options.journal:
            folder = Path(options.folder) / name
            if not options.run:
                folder = _claimed(folder)
                plan = replace(plan, run=folder.name)
            facts = {
                "plan": plan_to_json(plan),
                "rig": description_to_json(description),
                "target": target if isinstance(target, str) else None,
                "rig_name": options.rig,
                "system": own,
                "created_at": datetime.now().astimezone().isoformat(timespec="seconds"),
                "status": "running",
                "records_max": options.records,
                "tracking": options.tracking,
            }
            book = Journal.create(folder, facts)
        tuning_ = loop.start(plan, description, book)
        try:
            return _run(tuning_, the_rig, options.watch, options.ask, tracking=options.tracking)
        except (InvalidInput, RigError):
            if book is not None and not tuning_.entries and _replies(the_rig):
                book.discard()  # it was refused before its first trial
            raise


def resume(
    run_folder: str | Path,
    target: Any = None,
    *,
    trials: int | None = None,
    security: Security | None = None,
    patience_s: float | None = None,
    watch: ProgressListener | Literal["auto"] | None = "auto",
    ask: ApprovalCallback | None = None,
) -> "TuneResult":
    """Continues a run that was stopped, with the same proposals as an uninterrupted run.

    Args:
        run_folder: The run's folder.
        target: Present address of its rig; the earlier one by default.
        trials: Another maximum number of search trials, with which a finished search goes on.
        security: As in `tune`.
        patience_s: As in `tune`.
        watch: As in `tune`.
        ask: As in `tune`; required if the run was begun with it.

    Raises:
        InvalidInput: the run was made on an object, to be given as target, needs an approval
            callback, or took as many trials already.
        JournalError: the run cannot be read, or another process is writing it.
        RigError: the rig cannot be reached, or is not the one the run was made on.
    """
    journal = Journal.open(Path(run_folder), write=True)
    try:
        tuning_ = loop.replay(*_stored(journal), journal)
        target = journal.fact("target") if target is None else target
        if target is None:
            raise InvalidInput(
                f"{run_folder} was made on an object; pass it: estune.resume(folder, rig)"
            )
        has_own = hasattr(target, "rig") or hasattr(target, "describe")
        own = {} if has_own else journal.fact("system") or {}
        with open_target(
            target, journal.fact("rig_name"), security, patience_s, **own, gains=tuning_.plan.start
        ) as rig:
            check_same_rig(tuning_.description, rig.describe())
            if trials is not None:
                loop.extend(tuning_, trials)
            wanted = bool(journal.fact("tracking"))
            return _run(tuning_, rig, watch, ask, tracking=wanted)
    finally:
        journal.close()


def load(run_folder: str | Path) -> "TuneResult":
    """The result of a run on disk, finished or not; no rig is needed.

    A finished run can be loaded even if its tuner is of another version.

    Raises:
        JournalError: the run cannot be read.
    """
    from estune.run.results import result  # noqa: PLC0415  it loads SciPy

    with Journal.open(Path(run_folder)) as journal:
        if not archived_run.is_stored(journal):
            with contextlib.suppress(JournalError):  # of another version
                return result.from_tuning(loop.replay(*_stored(journal), journal))
        return result.from_tuning(archived_run.load_finished(journal))


def _run(
    tuning_: TuningRun,
    rig: Rig,
    watch: ProgressListener | Literal["auto"] | None,
    ask: ApprovalCallback | None,
    *,
    tracking: bool,
) -> "TuneResult":
    from estune.run.results import result  # noqa: PLC0415  it loads SciPy

    with (
        _journal_ending(tuning_),
        progress.watching(watch, tuning_, asking=ask is not None) as listeners,
    ):
        loop.run(tuning_, rig, listeners, ask)
        made = result.from_tuning(tuning_)
        if tracking and made.verdict.complete:
            made.measure_behaviour(rig, tuning_.journal)
    if made.folder is not None:
        with contextlib.suppress(InvalidInput):  # a list without them is no reason to fail
            write_numbers(made.folder, made.listed_numbers)
    return made


@contextlib.contextmanager
def _journal_ending(tuning_: TuningRun) -> Iterator[None]:
    """Writes the ending of a run to its journal, and closes it."""
    journal = tuning_.journal
    facts: dict[str, Any] = {}
    try:
        yield
        facts = archived_run.finished(tuning_)
    except Stopped:
        facts = {"status": "stopped"}
        raise
    except EstuneError as error:
        facts = {"status": f"failed: {error}"}
        raise
    except BaseException as error:
        facts = {"status": f"failed: {type(error).__name__}"}
        raise
    finally:
        if journal is not None:
            with contextlib.suppress(EstuneError):  # an exception is being raised already
                journal.note(**facts)
            journal.close()


def _replies(rig: Rig) -> bool:
    """Whether a rig can be asked; if not, its first trial may have been run all the same."""
    try:
        rig.describe()
    except EstuneError:
        return False
    return True


def _stored(journal: Journal) -> tuple[Any, RigDescription]:
    return plan_from_json(journal.fact("plan")), description_from_json(journal.fact("rig"))


def check_same_rig(then: RigDescription, now: RigDescription) -> None:
    """Refuses to resume a run on another rig than its own.

    Raises:
        RigError: the rig differs.
    """
    for what in ("name", "controller", "newtons_per_ampere", "cable_length_m"):
        if getattr(then, what) != getattr(now, what):
            raise RigError(
                f"{what} of the run's rig is {getattr(then, what)}, of this rig "
                f"{getattr(now, what)}; connect the rig of the run, or begin a new run"
            )


def _claimed(folder: Path) -> Path:
    """A new folder of this name or a numbered one, made for a run.

    Making it is what takes the name: of two tunings that begin in one second both find it free.
    """
    one, number = folder, 1
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        while True:
            try:
                one.mkdir()
            except FileExistsError:
                number += 1
                one = folder.with_name(f"{folder.name}-{number}")
            else:
                return one
    except OSError:  # the journal tells it, with its remedy
        return one
