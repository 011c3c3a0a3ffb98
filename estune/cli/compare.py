"""`estune compare`: tuners on one plant or rig, side by side."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from estune.cli import output
from estune.cli.interruption import continued_by_same_command
from estune.cli.options import (
    NO_COST,
    NO_LIMITS,
    NO_SEARCH,
    NO_STEP,
    CostOptions,
    LimitOptions,
    SearchOptions,
    StepOptions,
)
from estune.cli.tune import tuning_choices
from estune.cli.values import (
    Flag,
    Quiet,
    RigName,
    SecurityFile,
    Values,
    ranges_from,
    security_from,
)
from estune.studies.compare import comparison
from estune.studies.compare.comparison import COMPARED, Comparison
from estune.support.whole_file import write_file

PAGE, FIGURE, TABLE = "comparison.html", "comparison.png", "comparison.csv"
"""Files in the folder of a comparison."""


def compare(
    target: str,
    /,
    *,
    tuners: Annotated[str, Parameter(show_default=False)] = ",".join(COMPARED),
    start: Values = (),
    bounds: Values = (),
    rig: RigName = None,
    security: SecurityFile = None,
    patience: float | None = None,
    folder: Path | None = None,
    json: Flag = False,
    quiet: Quiet = False,
    search: SearchOptions = NO_SEARCH,
    step: StepOptions = NO_STEP,
    cost: CostOptions = NO_COST,
    limits: LimitOptions = NO_LIMITS,
) -> None:
    """Tune one plant or rig by several tuners, and show cost, gains and unsafe trials of each.

    Args:
        target: The rig: an endpoint such as tcp/127.0.0.1:7447, a model file such as reel.toml,
            or module:attribute such as plants:reference_reel.
        tuners: Names of tuners, with commas between them; by default model_based, safe_bayesian,
            least_squares_gradient and otis.
        start: As of estune tune; the start of every tuner.
        bounds: As of estune tune.
        patience: How long to wait for the rig to appear, and where it stops
            replying, s; 3 s and 30 s by default.
        folder: Folder for the runs, the page, the figure and the table; comparisons/TIME by
            default. An interrupted comparison continues with the same command and this folder.
        json: Print the outcome as JSON.
        search: The search of each tuner.
        step: The step trial.
        cost: The cost of a trial.
        limits: Limits by which all results are judged, and which model_based keeps.
    """
    credentials = security_from(security)
    where = folder or comparison.free_folder()
    with continued_by_same_command(where, folder):
        made = comparison.compare(
            target,
            [name.strip() for name in tuners.split(",")],
            **search.given,
            bounds=ranges_from(bounds) or None,
            **tuning_choices(target, rig, credentials, start, step, cost, limits),
            rig=rig,
            security=credentials,
            patience_s=patience,
            folder=where,
            watch=None if quiet else "auto",
        )
    files = _write(made)
    if json:
        output.print_json(made.to_json())
        return
    from estune.studies.compare.report import table  # noqa: PLC0415  draws

    output.show_study(table(made.results))
    output.show_next(files)


def _write(made: Comparison) -> dict[str, object]:
    """Writes page, figure and table into the folder of the comparison; the files by name."""
    from estune.studies.compare.report import cost_figure, page  # noqa: PLC0415  draws
    from estune.support.html_page import write  # noqa: PLC0415  as above
    from estune.support.plot_style import to_png  # noqa: PLC0415  as above

    table = made.to_frame().to_csv(index=False, lineterminator="\n")
    contents = {
        FIGURE: to_png(cost_figure(made.results)),
        TABLE: table.encode(),
    }
    for name, content in contents.items():
        write_file(made.folder / name, content)
    write(page(made), made.folder / PAGE)
    return {
        "page": made.folder / PAGE,
        "figure": made.folder / FIGURE,
        "table": made.folder / TABLE,
    }
