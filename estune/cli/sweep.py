"""`estune sweep`: tunings over cable lengths, and the law of gains over length."""

import json
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from estune.cli import output
from estune.cli.values import Flag, Quiet, check_folder_exists, command_line
from estune.errors import EstuneError, InvalidInput
from estune.run.loop import Stopped
from estune.run.progress import duration
from estune.studies.law.law import LISTED_MAX
from estune.studies.law.tuned import CELLS
from estune.studies.sweep import sweep as sweeping
from estune.studies.sweep.cells import Cell, expand_cells
from estune.studies.sweep.design import read_design
from estune.studies.sweep.exclusions import exclusion_sentences
from estune.studies.sweep.result import SweepResult
from estune.support.whole_file import write_file

EXAMPLE = Path(sweeping.__file__).with_name("example.toml")
REPORT, LAW = "report.html", "law.json"
"""Files in the folder of the sweep beside its store."""


def sweep(
    design: Path | None = None,
    /,
    *,
    folder: Path | None = None,
    jobs: int | None = None,
    dask: str | None = None,
    report: Path | None = None,
    dry_run: Flag = False,
    quiet: Quiet = False,
    json: Flag = False,
    example: Flag = False,
) -> None:
    """Tune at every length, tension, tuner, seed and rig of a file, and fit the gains over length.

    Each tuning is stored as soon as it is done; called again, the sweep continues with those that
    are missing or failed.

    Args:
        design: The sweep's file (TOML), such as: rigs = ["reel.toml"], lengths_m = [0.5, 1.4].
        folder: Folder of the sweep; sweeps/NAME by default, named as its file.
        jobs: Processes for models; one per core by default.
        dask: Run models on the Dask cluster whose scheduler is at this address, such as
            tcp://127.0.0.1:8786.
        report: File of the report page; report.html in the folder of the sweep by default.
        dry_run: Only check the limits and list what would be commanded; nothing moves.
        json: Print the laws as JSON.
        example: Print a complete file, of a simulated reel, and exit.

    Raises:
        InvalidInput: something in the file does not fit.
    """
    if example:
        print(EXAMPLE.read_text("utf-8"), end="")
        return
    if design is None:
        raise InvalidInput("give the sweep's file; for one to begin from, use --example")
    check_folder_exists("--report", report)
    if dry_run:
        _show_plan(expand_cells(read_design(design)))
        return
    again = command_line("sweep", design, folder=folder)
    try:
        result = sweeping.sweep(
            design, folder=folder, jobs=jobs, dask=dask, watch=None if quiet else "auto"
        )
    except KeyboardInterrupt as stop:
        if isinstance(stop, Stopped):  # of one cell's run
            stop.again = ""
        kept = f"estune: every finished tuning is stored; continue with: {again}"
        print(kept, file=sys.stderr, flush=True)
        raise
    if len(result.failed) == len(result.outcomes):
        first = result.failed[0]
        raise EstuneError(f"every cell failed; {first.cell.label}: {first.message}")
    written = _write(result, report or result.folder / REPORT)
    if json:
        output.print_json(_as_json(result))
    else:
        _show(result)
        output.show_next({**written, "again": again})


def _show_plan(cells: Sequence[Cell]) -> None:
    """Prints a row for each rig, length, tension and tuner, and the totals."""
    groups: dict[tuple[str, float, float, str], list[Cell]] = defaultdict(list)
    for cell in cells:
        groups[cell.rig.label, cell.length_m, cell.tension_N, cell.tuner].append(cell)
    rows = []
    for (rig, length, tension, tuner), group in groups.items():
        step, cost = group[0].step, group[0].cost
        trials = sum(cell.most_trials for cell in group)
        rows.append(
            (
                *(
                    rig,
                    f"{length:g} m",
                    group[0].signals.measured(tension, 6),
                    tuner,
                    f"{len(group)}",
                ),
                group[0].signals.step_text(step),
                *(f"{step.duration_s:g} s", f"{cost.settling_time_s:.3g} s", f"{trials}"),
            )
        )
    output.show_table(
        ("rig", "length", "tension", "tuner", "seeds", "step", "trial", "settling", "trials"),
        rows,
    )
    moving_s: dict[str, float] = defaultdict(float)
    for cell in cells:
        if not cell.rig.is_model:
            moving_s[cell.rig.label] += cell.most_trials * cell.step.duration_s
    total = sum(cell.most_trials for cell in cells)
    facts: dict[str, object] = {
        "tunings": len(cells),
        "trials": f"at most {total}, each within its rig's limits",
    }
    for rig, seconds in moving_s.items():
        facts[rig] = f"at most {duration(seconds)} of trials, one at a time"
    output.show_next({**facts, "nothing moved": "this was a dry run"})


def _show(result: SweepResult) -> None:
    output.show_outcome(result.heading(), good=not result.excluded)
    for series in result.series:
        law = series.law_or_reason()
        if isinstance(law, str):
            output.show_line(f"{series.label}: no law: {law}", "yellow")
        else:
            output.show_line(f"{series.label}: {law.sentence}.")
    excluded = result.excluded
    lines = [
        f"{'failed' if outcome.failed else 'left out'}: {outcome.cell.label}: {outcome.excluded}"
        for outcome in excluded[:LISTED_MAX]
    ]
    if len(excluded) > LISTED_MAX:
        counted = exclusion_sentences(result.outcomes)
        lines = [f"left out: {sentence}; see {CELLS}" for sentence in counted]
    for line in lines:
        output.show_line(line, "yellow")


def _as_json(result: SweepResult) -> dict[str, object]:
    laws: dict[str, object] = {}
    for series in result.series:
        try:
            laws[series.label] = series.law().to_json()
        except InvalidInput as error:
            laws[series.label] = {"error": str(error)}
    return {
        "tunings": len(result.outcomes),
        "failed": {outcome.cell.label: outcome.message for outcome in result.failed},
        "laws": laws,
    }


def _write(result: SweepResult, report: Path) -> dict[str, object]:
    """Writes the report, and cells and laws into the sweep's folder."""
    from estune.studies.sweep.report import page  # noqa: PLC0415  draws: slow to import
    from estune.support.html_page import write  # noqa: PLC0415  as above

    folder = result.folder
    write(page(result), report)
    laws = json.dumps(output.plain(_as_json(result)), indent=2, allow_nan=False)
    write_file(folder / LAW, laws.encode())
    return {"report": report, "cells": folder / CELLS, "laws": folder / LAW}
