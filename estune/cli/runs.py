"""`estune list`, `estune show` and `estune export`: runs on disk."""

import math
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

import estune
from estune.cli import output
from estune.cli.values import Flag, Json, Quiet, RunName, RunsFolder, command_line
from estune.errors import EstuneError, InvalidInput, JournalError
from estune.run.ending import RunEnding
from estune.run.journal import FILE_NAME, RUNS, Journal, being_written
from estune.run.labels import ListedNumbers, read_labels, read_numbers
from estune.run.phase import Phase
from estune.support.quantity_text import time_text

if TYPE_CHECKING:
    from estune.recordings.record_files import RecordFormat
    from estune.run.results.result import TuneResult

REPORT_NAME = "report.html"
_COLUMNS: dict[str, Callable[[dict[str, Any]], str]] = {
    "run": lambda row: str(row["run"]),
    "begun": lambda row: output.local_time(row["created_at"]) if row["created_at"] else "-",
    "rig": lambda row: _cell(row["rig"]),
    "trials": lambda row: _cell(row["trials"]),
    "state": lambda row: _state_and_reason(row)[0],
    "rise": lambda row: "-" if row["rise_time_s"] is None else time_text(row["rise_time_s"]),
    "overshoot": lambda row: "-" if row["overshoot"] is None else f"{row['overshoot']:.1%}",
    "Ms": lambda row: "-" if row["Ms"] is None else f"{row['Ms']:.2f}",
    "start cost": lambda row: _cell(row["start_cost"]),
    "cost": lambda row: _cell(row["cost"]),
    "tags": lambda row: ", ".join(row["tags"]),
}
"""Columns of the list of runs."""


def list_runs(folder: RunsFolder = Path(RUNS), *, json: Json = False) -> None:
    """List the runs of a folder, newest first."""
    rows = [_summary(path.parent) for path in sorted(folder.glob(f"*/{FILE_NAME}"))]
    rows.sort(key=_begun, reverse=True)
    if json:
        output.print_json(rows)
    elif not rows:
        print(f"no runs in {folder}; make one with: estune tune TARGET")
    else:
        output.show_table(_COLUMNS, ([show(row) for show in _COLUMNS.values()] for row in rows))
        for row in rows:
            if reason := _state_and_reason(row)[1]:
                output.show_line(f"{row['run']}: {reason}")


def show(
    run: RunName,
    /,
    *,
    folder: RunsFolder = Path(RUNS),
    trials: Flag = False,
    forms: Flag = False,
    json: Json = False,
) -> None:
    """Show the result of a run.

    Args:
        run: The run: its name, or its folder.
        trials: Show every trial too.
        forms: Show the gains as Kp, Ti and Td, in series and parallel form, and per sample too.
    """
    path = find_run(run, folder)
    result = estune.load(path)
    state = _state(path, result)
    if json:
        output.print_json(result_facts(result, trials=trials) | {"state": state})
        return
    output.show_result(result)
    if trials:
        from estune.core.gains import GAIN_NAMES  # noqa: PLC0415  slow to import

        frame = result.to_frame()[["number", "phase", *GAIN_NAMES, "cost", "best_cost", "outcome"]]
        heads = ("trial", "phase", "P", "I", "D", "filter_s", "cost", "best", "outcome")
        output.show_table(heads, (map(_cell, row) for row in frame.itertuples(index=False)))
    if forms:
        settings = result.rig.controller
        rows = ((f.name, _values(f.values), f.equation) for f in result.forms)
        output.show_table(("form", "gains to use", "equation"), rows)
        print(
            f"derivative on the measurement, filter {settings.derivative_filter_s:g} s; setpoint "
            f"filter {result.gains.setpoint_filter_s:.6g} s; rate {settings.sampling_Hz:g} Hz"
        )
    facts: dict[str, object] = {"run": path}
    if state == "running":
        facts["still running"] = f"follow it with: {command_line('watch', path)}"
    elif result.ending is RunEnding.STOPPED:
        facts["not running"] = f"continue it with: {command_line('resume', path)}"
    output.show_next(facts)


def report(
    run: RunName,
    /,
    *,
    out: Path | None = None,
    folder: RunsFolder = Path(RUNS),
) -> None:
    """Write the report of a run as one HTML page that works offline and prints well.

    Args:
        run: The run: its name, or its folder.
        out: The page; report.html in the run's own folder by default.
    """
    path = find_run(run, folder)
    output.show_next({"report": estune.load(path).report(out or path / REPORT_NAME)})


def export(
    run: RunName,
    /,
    *,
    csv: Flag = False,
    parquet: Flag = False,
    mcap: Flag = False,
    per_trial: Flag = False,
    out: Path | None = None,
    folder: RunsFolder = Path(RUNS),
    quiet: Quiet = False,
) -> None:
    """Write a run's trial records as files, Parquet unless CSV is chosen.

    Args:
        run: The run: its name, or its folder.
        csv: Write samples.csv with the samples of all trials, and trials.csv with a row for each.
        parquet: Write samples.parquet and trials.parquet.
        mcap: Write TRIAL.mcap for each trial, which PlotJuggler, Foxglove and Lichtblick open.
        per_trial: Write a file for each trial instead: TRIAL.csv with the columns and TRIAL.json
            with everything else, or TRIAL.parquet.
        out: Folder for the files; csv, parquet or mcap in the run's own folder by default.
    """
    from estune.run.progress import counting  # noqa: PLC0415  slow to import
    from estune.run.results.export import export_run, export_trials  # noqa: PLC0415  slow to import

    if csv + parquet + mcap > 1:
        raise InvalidInput(
            "the form of the files is not clear; give one of --csv, --parquet, --mcap"
        )
    form: RecordFormat = "csv" if csv else "mcap" if mcap else "parquet"
    per_trial = per_trial or mcap
    path = find_run(run, folder)
    target = out or path / form
    with counting("trials", quiet=quiet) as on_trial:
        written = (export_trials if per_trial else export_run)(path, target, form, on_trial)
    what = f"{len(written)} trials" if per_trial else " and ".join(file.name for file in written)
    print(f"{what} written to {target}")


def find_run(run: str, folder: Path) -> Path:
    """The folder of a run given by its name or its path.

    Raises:
        JournalError: there is no such run.
    """
    for path in (Path(run), folder / run):
        if (path / FILE_NAME).is_file():
            return path
    from estune.remote.zenoh.endpoints import intended_endpoint  # noqa: PLC0415  slow to import

    intended = intended_endpoint(run)
    if intended:
        raise JournalError(f"there is no run {run}; did you mean {intended}?")
    raise JournalError(
        f"there is no run {run}, neither as a folder nor in {folder}; "
        "list the runs with: estune list"
    )


def _state_and_reason(row: dict[str, Any]) -> tuple[str, str]:
    """State of a run in a word or two, and its reason if it has one."""
    state, _, reason = str(row["state"]).partition(":")
    return state, reason.strip()


def _summary(path: Path) -> dict[str, Any]:
    """Row of a run in the list; its state is the reason, if the run cannot be read.

    No model is identified for it: the numbers of a finished run stand beside its journal, and of
    another one only trials and the cost of the initial gains are known.
    """
    listed, row = read_numbers(path), dict.fromkeys(("created_at", "rig", "trials", "status"))
    state = "stopped"
    try:
        with Journal.open(path) as journal:
            entries = [entry for entry in journal.entries() if entry.outcome is not None]
            row |= {name: journal.fact(name) for name in ("created_at", "status")}
            row |= {"rig": journal.fact("rig")["name"], "trials": len(entries)}
        if row["status"] == "running" and being_written(path):
            state = "running"
        elif row["status"] != "finished":
            costs = [entry.cost for entry in entries if entry.phase is Phase.BASELINE]
            known = list(filter(math.isfinite, costs))
            listed = ListedNumbers(start_cost=fmean(known) if known else None)
        else:
            listed = listed if listed.ending else estune.load(path).listed_numbers
            state = str(listed.ending)
    except EstuneError as error:
        state = f"unreadable: {error}"
    numbers = {name: x for name, x in listed._asdict().items() if name != "ending"}
    return {"run": path.name, **row, **numbers, **read_labels(path)._asdict(), "state": state}


def _begun(row: dict[str, Any]) -> datetime:
    """When a run began; of one that cannot be read, the earliest time there is."""
    at = row["created_at"]
    return datetime.fromisoformat(at) if at else datetime.min.replace(tzinfo=UTC)


def _state(path: Path, result: "TuneResult") -> str:
    """The end of a run in words, or that a process is still at work on it."""
    with Journal.open(path) as journal:
        is_open = journal.fact("status") == "running"
    return "running" if is_open and being_written(path) else str(result.ending)


def result_facts(result: "TuneResult", *, trials: bool = False) -> dict[str, Any]:
    """The JSON form of a result."""
    names = ("ending", "success", "message", "folder", "gains", "start_gains", "improvement")
    shown = {name: output.plain(getattr(result, name)) for name in (*names, "unsafe", "findings")}
    shown["limits"] = {
        "asked": output.plain(result.plan.limits),
        **({} if result.limits is None else output.plain(result.limits)),
    }
    shown |= {"declined": result.verdict.declined, "search_end": result.session.search_end}
    for name in ("start", "tuned"):
        performance = output.plain(getattr(result, name))
        if performance is not None:
            del performance["record"], performance["gains"]
        shown[name] = performance
    shown["forms"] = output.plain(result.forms)
    shown.update(rig=result.rig.name, trials_run=result.nfev)
    shown["behaviour"] = output.plain(result.behaviour)
    shown["load_rejection"] = {
        name: at and {"load": at.load, "peak": at.peak, "vanished_s": at.vanished_s}
        for name, at in result.rejections.items()
    }
    if trials:
        shown["trials"] = result.to_frame().to_dict(orient="records")
    return shown


def _values(values: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.6g}" for name, value in values.items())


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}" if math.isfinite(value) else "-"
    return "-" if value is None else str(value)
