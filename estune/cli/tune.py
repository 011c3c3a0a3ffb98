"""`estune tune` and `estune resume`."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from estune import api
from estune.cli import output
from estune.cli.approval_prompt import terminal_approval
from estune.cli.interruption import continued_with_credentials, stopped_outside_trials
from estune.cli.options import (
    NO_COST,
    NO_LIMITS,
    NO_SEARCH,
    NO_STEP,
    CostOptions,
    LimitOptions,
    SearchOptions,
    StepOptions,
    TunerName,
)
from estune.cli.runs import find_run, result_facts
from estune.cli.values import (
    Flag,
    Quiet,
    RigName,
    RunName,
    RunsFolder,
    SecurityFile,
    Values,
    check_folder_exists,
    command_line,
    numbers_from,
    ranges_from,
    security_from,
)
from estune.core.gains import GAIN_NAMES
from estune.errors import InvalidInput
from estune.run.journal import RUNS, Journal
from estune.run.planning import known_start, suited_step
from estune.run.start import KnownStart
from estune.run.targets import is_endpoint, open_target
from estune.run.toml_tables import CostTable, StepTable
from estune.studies.law.start import start_from
from estune.support.toml_file import validate
from estune.trial import RigDescription
from estune.tuners import DEFAULT_TUNER

if TYPE_CHECKING:
    from estune.remote.security import Security
    from estune.run.results.result import TuneResult


def tune(
    target: str,
    /,
    *,
    tuner: TunerName = DEFAULT_TUNER,
    ask: Flag = False,
    force: Flag = False,
    tracking: Flag = False,
    start: Values = (),
    bounds: Values = (),
    rig: RigName = None,
    security: SecurityFile = None,
    patience: float | None = None,
    run: str | None = None,
    folder: RunsFolder = Path(RUNS),
    records: int | None = None,
    report: Path | None = None,
    quiet: Quiet = False,
    json: Flag = False,
    search: SearchOptions = NO_SEARCH,
    step: StepOptions = NO_STEP,
    cost: CostOptions = NO_COST,
    limits: LimitOptions = NO_LIMITS,
) -> int:
    """Tune a rig by step trials.

    Exits with code 0 if the improvement is statistically significant and the limits are shown to
    be kept, with 11 if they are not shown, with 12 if one is broken, with 7 without a significant
    improvement, and with 8 if the better gains are not robust.

    Args:
        target: The rig: an endpoint such as tcp/127.0.0.1:7447, a model file such as reel.toml,
            or module:attribute such as plants:reference_reel.
        tuner: Tuner.
        ask: Prompt before gains are tried that lie outside the region shown to be safe.
        force: Tune even if the trial is ill-posed: cost mostly noise, or too few samples.
        tracking: Run a slow triangle and a rest after the tuning, at the initial and at the tuned
            gains.
        start: Where the initial gains come from instead of the rig: model (the optimum of its own
            linear model), run:RUN, law:SWEEP or law:RUNS (the law over cable length of a sweep or
            of a folder of runs), records:LOGS (what estune suggest recommends by logs of the rig
            in service); or the initial value of a gain, as P=0.5. Repeat for more.
        bounds: Lowest and highest value of a gain, as P=0.1:10; repeat for more. The gains are P,
            I, D and setpoint_filter_s.
        patience: How long to wait for the rig to appear, and where it stops
            replying, s; 3 s and 30 s by default.
        run: Name of the run; the time of day by default.
        records: Number of records that the run keeps on disk, the latest and those of repeats; all
            by default. Gains and costs are kept for ever.
        report: Write a report of the run as one HTML page that works offline.
        json: Print the result as JSON.
        search: The search.
        step: The step trial.
        cost: The cost of a trial.
        limits: Limits by which the tuned gains are judged, and which model_based keeps.
    """
    check_folder_exists("--report", report)
    credentials = security_from(security)
    with continued_with_credentials(security), stopped_outside_trials():
        result = api.tune(
            target,
            tuner=tuner,
            **search.given,
            bounds=ranges_from(bounds) or None,
            **tuning_choices(target, rig, credentials, start, step, cost, limits),
            rig=rig,
            security=credentials,
            patience_s=patience,
            run=run,
            folder=folder,
            records=records,
            watch=None if quiet else "auto",
            ask=terminal_approval() if ask else None,
            force=force,
            tracking=tracking,
        )
    if json:
        return print_result(result, report)
    return finish(result, target, report=report, security=security)


def resume(
    run: RunName,
    /,
    *,
    target: str | None = None,
    trials: int | None = None,
    security: SecurityFile = None,
    patience: float | None = None,
    folder: RunsFolder = Path(RUNS),
    report: Path | None = None,
    quiet: Quiet = False,
    json: Flag = False,
) -> int:
    """Continue a run that was stopped or interrupted, or extend a finished search.

    Args:
        run: The run: its name, or its folder.
        target: Present address of its rig; the earlier one by default.
        trials: Another maximum number of search trials, with which a finished search goes on.
        patience: How long to wait for the rig to appear, and where it stops
            replying, s; 3 s and 30 s by default.
        report: Write a report of the run as one HTML page that works offline.
        json: Print the result as JSON.
    """
    check_folder_exists("--report", report)
    path = find_run(run, folder)
    with Journal.open(path) as journal:
        where = target or journal.fact("target")
        ask = terminal_approval() if journal.fact("plan")["ask_first"] else None
    credentials = security_from(security)
    watch: Literal["auto"] | None = None if quiet else "auto"
    with continued_with_credentials(security), stopped_outside_trials():
        result = api.resume(
            path,
            where,
            trials=trials,
            security=credentials,
            patience_s=patience,
            watch=watch,
            ask=ask,
        )
    if json:
        return print_result(result, report)
    return finish(result, where, report=report, security=security)


def print_result(result: "TuneResult", report: Path | None) -> int:
    """Prints a result as JSON, with its figure and report saved.

    Returns:
        The exit code of the run's ending.
    """
    figure = output.save_figure(result)
    files = {"figure": figure, "report": report and result.report(report)}
    output.print_json(result_facts(result) | files)
    return result.ending.exit_code


def finish(
    result: "TuneResult",
    target: str | None,
    more: Mapping[str, str] | None = None,
    report: Path | None = None,
    security: Path | None = None,
) -> int:
    """Prints a result, saves its figure and its report, and lists the next commands and `more`.

    Returns:
        The exit code of the run's ending.
    """
    output.show_result(result)
    facts: dict[str, object] = {"run": result.folder}
    figure = output.save_figure(result)
    if figure:
        facts["figure"] = figure
    if report is not None:
        facts["report"] = result.report(report)
    elif result.folder is not None:
        facts["report"] = command_line("report", result.folder)
    may_use_start = bool(result.plan.start_source) and not result.ending.is_tuned
    if (result.ending.is_offered or may_use_start) and is_endpoint(target):
        facts["make live"] = command_line("apply", result.folder, target, security=security)
    facts["trials"] = command_line("export", result.folder, "--csv")
    output.show_next({**facts, **(more or {})})
    return result.ending.exit_code


def tuning_choices(  # noqa: PLR0917  the order of the options
    target: str,
    rig_name: str | None,
    security: "Security",
    start: Values,
    step: StepOptions,
    cost: CostOptions,
    limit_options: LimitOptions,
) -> dict[str, Any]:
    """Arguments of `api.tune` that the rig's suggestions complete; the rig is asked if needed."""
    limits = limit_options.limits
    if not start and step == NO_STEP and cost == NO_COST:
        return {"limits": limits}
    sources = [
        text for text in start if text == "model" or text.startswith(("run:", "law:", "records:"))
    ]
    numbers = numbers_from(text for text in start if text not in sources)
    unknown = set(numbers) - set(GAIN_NAMES)
    if unknown:
        raise InvalidInput(
            f"there is no gain {', '.join(sorted(unknown))}; the gains are {', '.join(GAIN_NAMES)}"
        )
    if len(sources) > 1:
        raise InvalidInput("--start names more than one source of initial gains; name one")
    with open_target(target, rig_name, security) as the_rig:
        rig = the_rig.describe()
    trial = trial_of(rig, step, cost)
    if not sources:
        return {"start": replace(rig.gains, **numbers), "limits": limits, **trial}
    known = known_start(start_from(sources[0]), rig, trial["step"], trial["cost"], limits)
    source = ", ".join([known.source, *(f"{name}={value:g}" for name, value in numbers.items())])
    known = KnownStart(replace(known.gains, **numbers), source)
    return {"start": known, "limits": limits, **trial}


def trial_of(rig: RigDescription, step: StepOptions, cost: CostOptions) -> dict[str, Any]:
    """Step and cost of the options, completed by the rig's suggestions."""
    profile = validate(StepTable, step.given, "the step trial").of(rig)
    chosen = validate(CostTable, cost.given, "its cost").of(rig)
    return {"step": suited_step(profile, chosen, rig), "cost": chosen}
