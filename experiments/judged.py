"""How an experiment is called, and how it ends: what was measured, and which targets are met.

Every experiment has `--json` and `--quick`. Its last lines tell each target with its value and its
limit; with `--json` it prints one object instead, {"figures": {name: value}, "targets": {name:
{"value", "limit", "met"}}}. Its exit code is 0 where every target is met, else 1.
"""

import argparse
import contextlib
import io
import json
import math
import sys
from collections.abc import Mapping
from typing import Any, NamedTuple


class Target(NamedTuple):
    """A figure that has to be reached, in the figure's own unit.

    Attributes:
        value: What was measured; None where there was nothing to measure it by.
        limit: What is allowed; least and most, where there are two limits.
        met: Whether it is reached.
    """

    value: float | None
    limit: float | tuple[float, float]
    met: bool


def at_most(value: float | None, limit: float) -> Target:
    """A figure that may not be greater; one that is None or NaN misses it."""
    return Target(value, limit, value is not None and bool(value <= limit))


def at_least(value: float | None, limit: float) -> Target:
    """A figure that may not be less; one that is None or NaN misses it."""
    return Target(value, limit, value is not None and bool(value >= limit))


def between(value: float | None, least: float, most: float) -> Target:
    """A figure that may be neither less nor greater; one that is None or NaN misses it."""
    return Target(value, (least, most), value is not None and bool(least <= value <= most))


def command_line(about: str | None, *, quick: str) -> argparse.ArgumentParser:
    """The options of every experiment, to which it may add its own.

    Args:
        about: Docstring of the experiment, of which the first line is shown.
        quick: What its short form leaves out.
    """
    parser = argparse.ArgumentParser(description=(about or "").partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    parser.add_argument("--quick", action="store_true", help=quick)
    return parser


def tables(*, hidden: bool) -> contextlib.AbstractContextManager[object]:
    """For an experiment that prints its tables while it measures: hidden, they go nowhere."""
    return contextlib.redirect_stdout(io.StringIO() if hidden else sys.stdout)


def tell(figures: Mapping[str, Any], targets: Mapping[str, Target], *, as_json: bool) -> int:
    """Prints what came out: one JSON object, or a line for each target.

    Returns:
        The exit code: 1 where a target is missed.
    """
    if as_json:
        judged = {name: target._asdict() for name, target in targets.items()}
        print(json.dumps(_finite({"figures": figures, "targets": judged}), allow_nan=False))
    elif targets:
        print()
        for name, (value, limit, met) in targets.items():
            allowed = " to ".join(map(_written, limit if isinstance(limit, tuple) else (limit,)))
            print(f"{'met' if met else 'MISSED':6} {name}: {_written(value)}, limit {allowed}")
    return 0 if all(target.met for target in targets.values()) else 1


def _written(number: float | None) -> str:
    return "none" if number is None else f"{number:.4g}"


def _finite(value: Any) -> Any:
    """The same with None for what is not finite, which JSON has no number for."""
    if isinstance(value, Mapping):
        return {name: _finite(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
