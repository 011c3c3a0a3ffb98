"""The table that every study of several tunings shows: a row for each, its gains, its ending."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from estune.core.gains import GAIN_NAMES, Gains
from estune.support.quantity_text import axis_label

NOTHING = "-"
"""Cell without a value."""


class StudyRow(NamedTuple):
    """One tuning of a study.

    Attributes:
        label: What was tuned, or by which tuner.
        figures: Its figures as text, as the table's own heads name them.
        ending: How it ended, in a few words.
        good: Whether that is good; None is neither.
        reason: Why, in a sentence; may be empty.
    """

    label: str
    figures: tuple[str, ...]
    gains: Gains | None
    ending: str
    good: bool | None = None
    reason: str = ""

    @property
    def gain_cells(self) -> tuple[str, ...]:
        """The gains as text."""
        if self.gains is None:
            return (NOTHING,) * len(GAIN_NAMES)
        return tuple(f"{value:.4g}" for value in self.gains.as_tuple())


@dataclass(frozen=True, slots=True)
class StudyTable:
    """The tunings of a study.

    Attributes:
        what: Head of the labels, such as reel or tuner.
        gain_units: Unit of each gain by name, as of a rig's signals.
    """

    what: str
    figures: tuple[str, ...]
    gain_units: Mapping[str, str]
    rows: Sequence[StudyRow]

    @property
    def gain_heads(self) -> tuple[str, ...]:
        """Heads of the gains, with their units."""
        short = {"setpoint_filter_s": "filter"}
        return tuple(axis_label(short.get(n, n), unit) for n, unit in self.gain_units.items())

    @property
    def heads(self) -> tuple[str, ...]:
        """Heads of all columns."""
        return (self.what, *self.figures, *self.gain_heads, "ending")

    def cells(self) -> list[tuple[str, ...]]:
        """The rows as text, in the columns of `heads`."""
        return [(r.label, *r.figures, *r.gain_cells, r.ending) for r in self.rows]
