"""`estune sweep`: tunings over cable lengths, and the law of gains over length."""

import json
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.text import Text

from estune.cli import output
from estune.errors import EstuneError, InvalidInput
from estune.run.progress import duration
from estune.studies.sweep import sweep as sweeping
from estune.studies.sweep.cell import Cell
from estune.studies.sweep.design import read_design
from estune.studies.sweep.expand import expand_cells
from estune.studies.sweep.result import SweepResult, write

_Flag = Parameter(negative=(), show_default=False)

REPORT, CELLS, LAW = "report.html", "cells.csv", "law.json"
"""What is written into the sweep's folder beside what it keeps."""


def sweep(
    design: Path,
    /,
    *,
    folder: Path | None = None,
    jobs: int | None = None,
    dask: str | None = None,
    dry_run: Annotated[bool, _Flag] = False,
    quiet: Annotated[bool, _Flag] = False,
    json: Annotated[bool, _Flag] = False,
) -> None:
    """Tune at every length, tension, tuner, seed and rig of a file, and give the law over length.

    Each tuning is kept as soon as it is done; called again, the sweep goes on with those that are
    missing or failed.

    Args:
        design: The sweep's file; see docs/sweep.md.
        folder: Where the sweep is kept; sweeps/NAME by default, called as its file.
        jobs: Processes for models; one for each core by default.
        dask: Run models on the Dask cluster whose scheduler is at this address, such as
            tcp://127.0.0.1:8786.
        dry_run: Only say what would be commanded, once limits are checked; nothing moves.
        quiet: Show no progress.
        json: Print the laws as JSON.

    Raises:
        InvalidInput: something in the file does not fit.
    """
    if dry_run:
        _show_plan(expand_cells(read_design(design)))
        return
    again = f"estune sweep {design}" + (f" --folder {folder}" if folder else "")
    try:
        result = sweeping.sweep(
            design, folder=folder, jobs=jobs, dask=dask, watch=None if quiet else "auto"
        )
    except KeyboardInterrupt:
        done = f"estune: every tuning that was done is kept; go on with: {again}"
        print(done, file=sys.stderr, flush=True)
        raise
    if len(result.failed) == len(result.outcomes):
        first = result.failed[0]
        raise EstuneError(f"every cell failed; {first.cell.label}: {first.message}")
    written = _write(result)
    if json:
        output.print_json(_as_json(result))
    else:
        _show(result)
        output.show_next({**written, "again": again})


def _show_plan(cells: Sequence[Cell]) -> None:
    """What would be commanded: a line for each rig, length, tension and tuner."""
    alike: dict[tuple[str, float, float, str], list[Cell]] = defaultdict(list)
    for cell in cells:
        alike[cell.rig.label, cell.length_m, cell.tension_N, cell.tuner].append(cell)
    rows = []
    for (rig, length, tension, tuner), some in alike.items():
        step, cost = some[0].step, some[0].cost
        trials = sum(cell.most_trials for cell in some)
        rows.append(
            (
                *(rig, f"{length:g} m", f"{tension:g} N", tuner, f"{len(some)}"),
                f"{step.preload_N:g} to {step.preload_N + step.step_N:g} N",
                *(f"{step.duration_s:g} s", f"{cost.settling_time_s:.3g} s", f"{trials}"),
            )
        )
    output.show_table(
        ("rig", "length", "tension", "tuner", "seeds", "step", "trial", "to settle", "trials"),
        rows,
    )
    moving_s: dict[str, float] = defaultdict(float)
    for cell in cells:
        if not cell.rig.is_model:
            moving_s[cell.rig.label] += cell.most_trials * cell.step.duration_s
    most = sum(cell.most_trials for cell in cells)
    facts: dict[str, object] = {
        "tunings": len(cells),
        "trials": f"at most {most}, each within its rig's limits",
    }
    for rig, seconds in moving_s.items():
        facts[rig] = f"at most {duration(seconds)} of trials, one at a time"
    output.show_next({**facts, "nothing moved": "this was a dry run"})


def _show(result: SweepResult) -> None:
    out = output.console()
    bad = bool(result.excluded)
    out.print(Text(result.heading(), style="bold yellow" if bad else "bold green"))
    for series in result.series:
        try:
            law = series.law()
        except InvalidInput as error:
            out.print(Text(f"{series.label}: no law: {error}", style="yellow"), soft_wrap=True)
            continue
        out.print(Text(f"{series.label}: {law.sentence}."), soft_wrap=True)
    for outcome in result.excluded:
        what = "failed" if outcome.failed else "left out"
        said = f"{what}: {outcome.cell.label}: {outcome.excluded}"
        out.print(Text(said, style="yellow"), soft_wrap=True)


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


def _write(result: SweepResult) -> dict[str, object]:
    """Writes report, cells and laws into the sweep's folder."""
    folder = result.folder
    result.write_report(folder / REPORT)
    write(folder / CELLS, result.to_frame().to_csv(index=False).encode())
    laws = json.dumps(output.plain(_as_json(result)), indent=2, allow_nan=False)
    write(folder / LAW, laws.encode())
    return {"report": folder / REPORT, "cells": folder / CELLS, "laws": folder / LAW}
