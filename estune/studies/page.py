"""The report page of a study of several tunings."""

from collections.abc import Sequence

from estune.studies.table import StudyTable
from estune.support.html_page import Block, Cell, Page, Paragraph, Section, Status, Table

_COLUMNS_MAX = 8
"""Columns of a table that a page of 72 characters holds; gains beyond them get a table of their
own."""


def study_page(
    title: str,
    heading: Status,
    blocks: Sequence[Block],
    table: StudyTable,
    *,
    sections: Sequence[Section] = (),
    procedure: str = "",
) -> Page:
    """The page of a study: its outcome, its figures, its tunings, and how they were made."""
    last = (Section("Procedure", (Paragraph(procedure),)),) if procedure else ()
    return Page(title, heading, (*blocks, *page_tables(table)), (*sections, *last))


def page_tables(table: StudyTable) -> tuple[Table, ...]:
    """The tunings as one table, or as two where it is too wide; nothing without a tuning."""
    if not table.rows:
        return ()
    endings = [Status(row.ending, row.good, row.reason) for row in table.rows]
    pairs = list(zip(table.rows, endings, strict=True))
    figures, gains = len(table.figures), len(table.gain_heads)
    if len(table.heads) <= _COLUMNS_MAX:
        rows: list[tuple[Cell, ...]] = [
            (row.label, *row.figures, *row.gain_cells, ending) for row, ending in pairs
        ]
        return (Table(table.heads, rows, range(1, 1 + figures + gains)),)
    return (
        Table(
            (table.what, *table.figures, "ending"),
            [(row.label, *row.figures, ending) for row, ending in pairs],
            range(1, 1 + figures),
        ),
        Table(
            (table.what, *table.gain_heads),
            [(row.label, *row.gain_cells) for row in table.rows],
            range(1, 1 + gains),
        ),
    )
