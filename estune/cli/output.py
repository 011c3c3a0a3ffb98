"""Output of commands: the before/after table, other tables, JSON."""

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from estune.recordings.issue import DataIssue
    from estune.run.results.result import TuneResult
    from estune.studies.table import StudyTable


FIGURE_NAME = "figure.png"
_WORDS = 24
"""Characters of a cell above which it may be wrapped between words."""
_WIDEST = 10_000
"""Width of a pipe and of a table as it is measured, characters: more than any has."""


def console() -> Console:
    """Console for results; in a pipe, lines are not cut to the width of a terminal."""
    out = Console(highlight=False)
    if not out.is_terminal:
        out.width = _WIDEST
    return out


def show_line(text: str, style: str = "") -> None:
    """Prints a line, however long."""
    console().print(Text(text, style=style), soft_wrap=True)


def show_outcome(text: str, *, good: bool | None) -> None:
    """Prints how it ended, green or yellow."""
    show_line(text, "bold green" if good else "bold yellow")


def show_issue(level: str, sentence: str) -> None:
    """Prints an issue of data: in red where they are refused, else in yellow."""
    colour = "red" if level == "refused" else "yellow"
    console().print(Text.assemble((f"{level}  ", colour), sentence), soft_wrap=True)


def show_result(result: "TuneResult") -> None:
    """Prints how a run ended, its before/after table and its warnings."""
    show_outcome(result.heading(), good=result.ending.good)
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0))
    table.add_column("", style="dim")
    table.add_column("start", justify="right")
    if result.tuned:
        table.add_column("tuned", justify="right", style="bold")
    for row in result.rows():
        table.add_row(*(row if result.tuned else row[:2]))
    console().print(table)
    for remark in result.remarks():
        show_line(remark)


def show_doubts(issues: Iterable["DataIssue"]) -> None:
    """Prints what all that follows depends on, each once."""
    for sentence in dict.fromkeys(i.sentence for i in issues if i.level == "doubt"):
        show_issue("doubt", sentence)


def save_figure(result: "TuneResult") -> Path | None:
    """Draws the figure of a run into its folder; None for a run without a folder or a trial."""
    if result.folder is None or not result.entries:
        return None
    from estune.support import plot_style  # noqa: PLC0415  slow to import
    from estune.support.whole_file import replace_file  # noqa: PLC0415  of no use to most commands

    path = result.folder / FIGURE_NAME
    with plot_style.simplified():
        replace_file(path, plot_style.to_png(result.figure()))
    return path


def show_next(facts: Mapping[str, object]) -> None:
    """Prints a short list of names and values: paths, and the next commands."""
    console().print(facts_text(facts), soft_wrap=True)


def facts_text(facts: Mapping[str, object]) -> Text:
    """Names and values, a line each."""
    width = max(map(len, facts))
    lines = (Text.assemble((f"{n:<{width}}", "dim"), f"  {value}") for n, value in facts.items())
    return Text("\n").join(lines)


def show_table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    """Prints a plain table; where a terminal is too narrow for it, each row as a list."""
    heads, cells = tuple(columns), [tuple(row) for row in rows]
    out = console()
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for number, head in enumerate(heads):
        is_text = any(" " in row[number] and len(row[number]) > _WORDS for row in cells)
        table.add_column(head, header_style="dim", no_wrap=not is_text)
    for row in cells:
        table.add_row(*(Text(cell) for cell in row))
    if Measurement.get(out, out.options.update(width=_WIDEST), table).minimum <= out.width:
        out.print(table)
        return
    for row in cells:
        show_next({head: cell for head, cell in zip(heads, row, strict=True) if cell})
        print()


def show_study(table: "StudyTable") -> None:
    """Prints the tunings of a study, and the reasons of their endings."""
    show_table(table.heads, table.cells())
    for row in table.rows:
        if row.reason:
            show_line(f"{row.label}: {row.reason}")


def local_time(at: str) -> str:
    """A time of day, ISO 8601 with offset, as that of this place."""
    return f"{datetime.fromisoformat(at).astimezone():%Y-%m-%d %H:%M:%S}"


def print_json(value: Any) -> None:
    """Prints a value as JSON; numbers that are not finite become null."""
    print(json.dumps(plain(value), indent=2, allow_nan=False))


def print_json_line(value: Any) -> None:
    """Prints a value as JSON in one line, at once: for a reader that follows."""
    print(json.dumps(plain(value), allow_nan=False), flush=True)


def plain(value: Any) -> Any:
    """A value in the types of JSON."""
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        value = value._asdict()
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value
