"""Command line and output of an experiment: its figures, and which targets it meets.

Every experiment has `--json` and `--quick`. It prints a table, and in its last lines each target
with its value and its limit; with `--json` it prints one object instead, {"figures": {name:
value}, "targets": {name: {"value", "limit", "met"}}}. Its exit code is 0 if every target is met,
else 1.
"""

import argparse
import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple


class Target(NamedTuple):
    """A figure with its required limit, in the figure's own unit.

    Attributes:
        value: The measured value; None if it could not be measured.
        limit: The limit; lower and upper if there are two.
        met: Whether the value is within the limit.
    """

    value: float | None
    limit: float | tuple[float, float]
    met: bool


def at_most(value: float | None, limit: float) -> Target:
    """A figure with an upper limit; None and NaN miss it."""
    return Target(value, limit, value is not None and bool(value <= limit))


def at_least(value: float | None, limit: float) -> Target:
    """A figure with a lower limit; None and NaN miss it."""
    return Target(value, limit, value is not None and bool(value >= limit))


def between(value: float | None, low: float, high: float) -> Target:
    """A figure with two limits; None and NaN miss them."""
    return Target(value, (low, high), value is not None and bool(low <= value <= high))


def command_line(about: str | None, *, quick: str, out: str = "") -> argparse.ArgumentParser:
    """Parser of the options of every experiment; an experiment may add its own.

    Args:
        about: Docstring of the experiment; its first line is the description.
        quick: What the short form leaves out.
        out: What the experiment writes into the folder of `--out`; without it no such option.
    """
    parser = argparse.ArgumentParser(description=(about or "").partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    parser.add_argument("--quick", action="store_true", help=quick)
    if out:
        text = f"folder for {out}; default: out, in the current directory"
        parser.add_argument("--out", type=Path, default=Path("out"), metavar="FOLDER", help=text)
    return parser


def print_figures(figures: Mapping[str, Any]) -> None:
    """Prints single figures line by line, and figures by name, again by name, as a table.

    A list of figures by name is a table, too.
    """
    figures = {name: _by_number(value) for name, value in figures.items()}
    for name, value in figures.items():
        if not isinstance(value, Mapping):
            print(f"{name:40} {_text(value)}")
    for name, rows in figures.items():
        if isinstance(rows, Mapping) and rows:
            print(f"\n{name}")
            if not all(isinstance(row, Mapping) for row in rows.values()):
                print_figures({f"  {key}": value for key, value in rows.items()})
                continue
            columns = list(dict.fromkeys(column for row in rows.values() for column in row))
            cells = [[key, *(row.get(column) for column in columns)] for key, row in rows.items()]
            table = [["", *columns], *cells]
            widths = [max(map(len, map(_text, column))) for column in zip(*table, strict=True)]
            sides = ["<" if isinstance(cell, str) else ">" for cell in cells[0]]
            for row in table:
                places = zip(row, sides, widths, strict=True)
                line = "  ".join(f"{_text(cell):{side}{width}}" for cell, side, width in places)
                print(f"  {line}".rstrip())


def print_results(
    figures: Mapping[str, Any],
    targets: Mapping[str, Target],
    *,
    as_json: bool,
    tables: bool = False,
) -> int:
    """Prints one JSON object, or a line for each target.

    Args:
        figures: The figures by name; a figure may be a mapping of figures.
        targets: The targets by name.
        as_json: Whether to print the object.
        tables: Whether to print the figures above the targets, too.

    Returns:
        The exit code: 1 if a target is missed.
    """
    if tables and not as_json:
        print_figures(figures)
    if as_json:
        values = {name: target._asdict() for name, target in targets.items()}
        print(json.dumps(_finite({"figures": figures, "targets": values}), allow_nan=False))
    elif targets:
        print()
        for name, (value, limit, met) in targets.items():
            limits = " to ".join(map(_text, limit if isinstance(limit, tuple) else (limit,)))
            print(f"{'met' if met else 'MISSED':6} {name}: {_text(value)}, limit {limits}")
    return 0 if all(target.met for target in targets.values()) else 1


def tunings_by_seed(
    about: str | None,
    measure: Callable[[int], dict[str, Any]],
    targets_of: Callable[[Sequence[dict[str, Any]]], Mapping[str, Target]],
    *,
    count: int,
    quick: int,
) -> int:
    """Runs an experiment of one tuning for each seed.

    Args:
        about: Docstring of the experiment.
        measure: The row of a seed.
        targets_of: The targets, from all rows.
        count: Number of tunings.
        quick: That of the short form.

    Returns:
        The exit code: 1 if a target is missed.
    """
    parser = command_line(about, quick=f"{quick} tunings")
    parser.add_argument("--seed0", type=int, default=0, help="first seed: see seeds.md")
    parser.add_argument("--count", type=int, default=count, help="tunings")
    options = parser.parse_args()
    rows = list[dict[str, Any]]()
    for seed in range(options.seed0, options.seed0 + (quick if options.quick else options.count)):
        rows.append(measure(seed))
        print(rows[-1], file=sys.stderr, flush=True)
    return print_results({"rows": rows}, targets_of(rows), as_json=options.json, tables=True)


def _by_number(value: Any) -> Any:
    if isinstance(value, list) and value and all(isinstance(row, Mapping) for row in value):
        return {str(number): row for number, row in enumerate(value, 1)}
    return value


def _text(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_text(one)}" for name, one in value.items())
    if isinstance(value, list | tuple):
        return " ".join(map(_text, value[:9])) + " ..." * (len(value) > 9)
    if value is None:
        return "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _finite(value: Any) -> Any:
    """The value with None in place of numbers that JSON does not have."""
    if isinstance(value, Mapping):
        return {name: _finite(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
