"""Trials of a run as rows of a page's table, and records as curves."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from estune.core.quantities import FloatArray
from estune.run.journal import JournalEntry
from estune.run.phase import Phase
from estune.run.tally import was_safe, was_unsafe
from estune.support.quantity_text import axis_label
from estune.trial import RigDescription, TrialRecord

HISTORY_MAX = 4000
"""Trials of the past that a page is sent: of more, the best and the worst of each stretch."""
POINTS_MAX = 1500
"""Points of a curve."""
DONE, UNSAFE, VOID = 0, 1, 2
PHASES = tuple(Phase)


def row(entry: JournalEntry, eta_max: float) -> tuple[float, ...]:
    """Number, cost, kind, phase and gains of a trial."""
    kind = DONE if was_safe(entry, eta_max) else UNSAFE if was_unsafe(entry, eta_max) else VOID
    return (entry.number, entry.cost, kind, PHASES.index(entry.phase), *entry.gain_values)


def thinned(entries: Sequence[JournalEntry]) -> Sequence[JournalEntry]:
    """At most about `HISTORY_MAX` trials: the best and worst of each stretch, and the last."""
    if len(entries) <= HISTORY_MAX:
        return entries
    size = math.ceil(2 * len(entries) / HISTORY_MAX)
    kept: list[JournalEntry] = []
    for begin in range(0, len(entries), size):
        stretch = sorted(entries[begin : begin + size], key=_rank)
        kept += sorted({stretch[0], stretch[-1]})
    return kept if kept[-1] == entries[-1] else [*kept, entries[-1]]


def _rank(entry: JournalEntry) -> float:
    return entry.cost if math.isfinite(entry.cost) else math.inf


def curve(record: TrialRecord, rig: RigDescription) -> dict[str, Any]:
    """Time, setpoint, measurement and command of a record, thinned to `POINTS_MAX`."""
    columns = {
        "t": record.time_s,
        "r": record.setpoint_N,
        "y": record.tension_N,
        "u": record.current_A * rig.newtons_per_ampere,
    }
    return {name: points(column) for name, column in columns.items()}


def points(values: FloatArray) -> list[float]:
    """At most `POINTS_MAX` values with six digits of the largest."""
    shown = values[:: max(1, math.ceil(values.size / POINTS_MAX))]
    largest = float(np.abs(shown[np.isfinite(shown)]).max(initial=1e-300))
    return list(np.round(shown, 5 - math.floor(math.log10(largest))).tolist())


def gain_labels(rig: RigDescription) -> list[str]:
    """Names of the gains with their units, in the order of `GAIN_NAMES`."""
    return [
        axis_label(name.removesuffix("_s").replace("_", " "), unit)
        for name, unit in rig.gain_units.items()
    ]
