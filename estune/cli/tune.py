"""`estune tune` and `estune resume`."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Group, Parameter

from estune import api
from estune.cli import output
from estune.cli.approval_prompt import terminal_approval
from estune.cli.runs import find_run
from estune.cli.values import numbers_from, ranges_from, security_from, share_from
from estune.core.cost import StepCost
from estune.core.gains import GAIN_NAMES, Gains
from estune.errors import InvalidInput
from estune.run.journal import Journal
from estune.run.plan import MOVE_WEIGHT, model_start
from estune.run.result import RunEnding, TuneResult
from estune.run.session import TOLERANCE
from estune.run.targets import is_endpoint, open_target
from estune.trial import Rig, RigDescription
from estune.trial.profiles import StepProfile
from estune.tuners import DEFAULT_TUNER, TUNERS, tuner_class

_STEP = Group("The step trial", sort_key=1)
_COST = Group("The cost of a trial, (35)", sort_key=2)


def _check_tuner(_kind: Any, name: str) -> None:
    tuner_class(name)


TunerName = Annotated[
    str,
    Parameter(
        validator=_check_tuner,
        help=f"How gains are proposed: {', '.join(TUNERS)}; or module:Class of your own tuner.",
    ),
]


@Parameter(name="*", group=_STEP)
@dataclass(frozen=True, kw_only=True)
class StepOptions:
    """The step trial; what is left out is what the rig suggests.

    Attributes:
        preload_N: Tension held before the step, N.
        step_N: Size of the step, N; negative steps down.
        step_at_s: Time of the step from the start of the trial, s.
        duration_s: Length of the whole trial, s.
    """

    preload_N: Annotated[float | None, Parameter(name="--preload-N")] = None
    step_N: Annotated[float | None, Parameter(name="--step-N")] = None
    step_at_s: float | None = None
    duration_s: float | None = None


@Parameter(name="*", group=_COST)
@dataclass(frozen=True, kw_only=True)
class CostOptions:
    """How a trial is scored; what is left out is the usual.

    Attributes:
        settling_time_s: Settling time asked for, s; the one the rig suggests by default.
        weight: Weight over the transient: as the paper prints it, or rising as its prose says.
        time_unit: Unit of the time weight: seconds as printed, or the settling time.
        move_weight: Price on jumps of the effort; 0.2 by default, 0 is none, as printed.
    """

    settling_time_s: float | None = None
    weight: Literal["printed", "rising"] | None = None
    time_unit: Literal["second", "settling_time"] | None = None
    move_weight: float | None = None


_NO_STEP, _NO_COST = StepOptions(), CostOptions()


def tune(
    target: str,
    /,
    *,
    tuner: TunerName = DEFAULT_TUNER,
    trials: int = 120,
    tolerance: str = f"{TOLERANCE:.0%}",
    repeats: int = 3,
    eta_max: float | None = None,
    ask: Annotated[bool, Parameter(negative=(), show_default=False)] = False,
    warm_start: Annotated[bool, Parameter(negative=(), show_default=False)] = False,
    start: Annotated[tuple[str, ...], Parameter(negative=(), show_default=False)] = (),
    bounds: Annotated[tuple[str, ...], Parameter(negative=(), show_default=False)] = (),
    rig: str | None = None,
    security: Path | None = None,
    run: str | None = None,
    folder: Path = Path(api.RUNS),
    quiet: Annotated[bool, Parameter(negative=(), show_default=False)] = False,
    step: StepOptions = _NO_STEP,
    cost: CostOptions = _NO_COST,
) -> int:
    """Tune a rig by step trials.

    It ends with 0 if the gains found are better than the start, and with 7 if they are not beyond
    the scatter of repeats.

    Args:
        target: Where the rig is: an endpoint such as tcp/127.0.0.1:7447, a model file such as
            reel.toml, or module:attribute such as plants:reference_reel.
        tuner: How gains are proposed.
        trials: Greatest number of search trials.
        tolerance: The search ends once no more than this share of the cost is left to gain, as 1%
            or 0.01, by a tuner that can tell; 0 makes it use all its trials.
        repeats: Trials of the start gains before the search, and at the least of the start and of
            the gains found after it.
        eta_max: Cost above which a trial counts as unsafe; three times the start's by default.
        ask: Ask here before gains are tried that lie beyond what safe trials have shown to be
            safe.
        warm_start: Begin from the gains that the rig's own linear model suggests.
        start: A gain to begin from instead of the rig's or its model's, as P=0.5; repeat for
            more.
        bounds: Least and greatest value of a gain, as P=0.1:10; repeat for more. The gains are P,
            I, D and setpoint_filter_s.
        rig: Name of the rig, where several answer at the endpoint.
        security: File that says who this is, where the rig asks; see docs/security.md.
        run: Name of the run; the time of day by default.
        folder: Folder that runs are kept in.
        quiet: Show no progress.
        step: The step trial.
        cost: How a trial is scored.
    """
    who = security_from(security)
    reach = partial(open_target, target, rig, who)
    chosen = _chosen(reach, numbers_from(start), step, cost, warm_start=warm_start)
    result = api.tune(
        target,
        tuner=tuner,
        trials=trials,
        tolerance=share_from("tolerance", tolerance),
        repeats=repeats,
        eta_max=eta_max,
        start=chosen.start,
        bounds=ranges_from(bounds) or None,
        step=chosen.step,
        cost=chosen.cost,
        rig=rig,
        security=who,
        run=run,
        folder=folder,
        watch=None if quiet else "auto",
        ask=terminal_approval() if ask else None,
    )
    return finish(result, target)


def resume(
    run: str,
    /,
    *,
    target: str | None = None,
    security: Path | None = None,
    folder: Path = Path(api.RUNS),
    quiet: Annotated[bool, Parameter(negative=(), show_default=False)] = False,
) -> int:
    """Go on with a run that was stopped or cut off.

    Args:
        run: The run: its name, or its folder.
        target: Where its rig is now; by default where it was.
        security: File that says who this is, where the rig asks; see docs/security.md.
        folder: Folder that runs are kept in.
        quiet: Show no progress.
    """
    path = find_run(run, folder)
    with Journal.open(path) as journal:
        where = target or journal.fact("target")
        ask = terminal_approval() if journal.fact("plan")["ask_first"] else None
    who = security_from(security)
    watch: Literal["auto"] | None = None if quiet else "auto"
    return finish(api.resume(path, where, security=who, watch=watch, ask=ask), where)


def finish(result: TuneResult, target: str | None, more: Mapping[str, str] | None = None) -> int:
    """Prints a result, saves its figure, and says what to type next, and `more` below that.

    Returns:
        The exit code that tells how the run ended.
    """
    output.show_result(result)
    facts: dict[str, object] = {"run": result.folder}
    figure = output.save_figure(result)
    if figure:
        facts["figure"] = figure
    if result.ending is RunEnding.TUNED and is_endpoint(target):
        facts["make live"] = f"estune apply {result.folder} {target}"
    facts["trials"] = f"estune export {result.folder} --csv"
    output.show_next({**facts, **(more or {})})
    return result.ending.exit_code


@dataclass(frozen=True)
class _Chosen:
    """What the user settled; None where the library's own default holds."""

    start: Gains | None
    step: StepProfile | None
    cost: StepCost | None


def _chosen(
    reach: Callable[[], AbstractContextManager[Rig]],
    start: Mapping[str, float],
    step: StepOptions,
    cost: CostOptions,
    *,
    warm_start: bool,
) -> _Chosen:
    """Fills in what the user left open by asking the rig, if there is anything to fill in."""
    unknown = set(start) - set(GAIN_NAMES)
    if unknown:
        raise InvalidInput(
            f"there is no gain {', '.join(sorted(unknown))}; the gains are {', '.join(GAIN_NAMES)}"
        )
    if not start and not warm_start and step == _NO_STEP and cost == _NO_COST:
        return _Chosen(None, None, None)
    with reach() as the_rig:
        suggested: RigDescription = the_rig.describe()
    usual = StepCost(suggested.settling_time_s, move_weight=MOVE_WEIGHT)
    return _Chosen(
        replace(model_start(suggested) if warm_start else suggested.gains, **start),
        replace(suggested.step, **_given(step)),
        replace(usual, **_given(cost)),
    )


def _given(options: StepOptions | CostOptions) -> dict[str, Any]:
    values = {field.name: getattr(options, field.name) for field in fields(options)}
    return {name: value for name, value in values.items() if value is not None}
