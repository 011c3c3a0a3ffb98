"""Issues found in recorded data."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estune.errors import InvalidInput

LISTED = 6
"""Refusals that a message lists."""

Level = Literal["refused", "warning", "doubt"]


@dataclass(frozen=True, slots=True)
class DataIssue:
    """Something that is wrong with a record, or looks wrong.

    Attributes:
        level: `refused` where the record is left out because of it, `doubt` where all that is said
            of the record depends on it, which is said first, else `warning`.
        sentence: What is wrong and what to do, one sentence without full stop.
        column: The column, or empty where it is about the whole record.
        row: The first data row it is about, counted from 1, or None.
        source: The file, or the record's name; empty as long as it is not known.
    """

    level: Level
    sentence: str
    column: str = ""
    row: int | None = None
    source: str = ""

    def __str__(self) -> str:
        """File, row and column in front of the sentence."""
        row = "" if self.row is None else f", row {self.row}"
        column = f", column {self.column}" if self.column else ""
        return f"{self.source}{row}{column}: {self.sentence}"

    def among(self, rows: NDArray[np.intp]) -> "DataIssue":
        """The same of the rows, counted from 0, that its rows are; its own counts these alone.

        A row was named by its number after others had been left out, and looked for in vain.
        """
        return self if self.row is None else replace(self, row=int(rows[self.row - 1]) + 1)


def refusals(issues: Iterable[DataIssue]) -> str:
    """The refusals among some issues, the first of them in full; empty where there is none.

    What is wrong with many files alike, as the name of a column, is said once.
    """
    alike: dict[DataIssue, list[str]] = {}
    for issue in issues:
        if issue.level == "refused":
            alike.setdefault(replace(issue, source=""), []).append(issue.source)
    said = [str(replace(issue, source=_first(sources, ", "))) for issue, sources in alike.items()]
    return _first(said, "; ")


def _first(texts: list[str], separator: str) -> str:
    more = f"{separator}and {len(texts) - LISTED} more" if len(texts) > LISTED else ""
    return separator.join(texts[:LISTED]) + more


class Unusable(InvalidInput):
    """A record cannot be used because of an issue."""

    def __init__(self, sentence: str, column: str = "", row: int | None = None) -> None:
        super().__init__(sentence)
        self.issue = DataIssue("refused", sentence, column, row)

    def among(self, rows: NDArray[np.intp]) -> "Unusable":
        """The same of the rows that its rows are, as `DataIssue.among`."""
        there = self.issue.among(rows)
        return Unusable(there.sentence, there.column, there.row)
