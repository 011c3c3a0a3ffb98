"""Results as HTML for notebooks: a coloured heading, tables, sentences and a figure."""

from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # slow to import
    from matplotlib.figure import Figure

Rows = Iterable[Sequence[str]]
"""Rows of a table, its head first."""


def card(
    heading: str,
    *,
    good: bool | None,
    tables: Iterable[Rows] = (),
    sentences: Iterable[str] = (),
    figure: "Figure | None" = None,
) -> str:
    """A result as HTML that is legible on light and dark pages.

    Args:
        heading: The result in one line, marked green, red or orange.
        good: Green if true, red if false, orange if None.
        sentences: Sentences below the tables.
        figure: A figure at the end, on white.
    """
    from estune.support import plot_style  # noqa: PLC0415  slow to import

    colours = {True: plot_style.GREEN, False: plot_style.VERMILION, None: plot_style.ORANGE}
    colour = colours[good]
    parts = [
        f'<p style="border-left:4px solid {colour};padding-left:8px"><b>{escape(heading)}</b></p>',
        *map(_table, tables),
        *(f"<p>{escape(sentence)}</p>" for sentence in sentences),
    ]
    if figure is not None:
        parts.append(
            f'<div style="background:#fff;width:fit-content">{plot_style.to_svg(figure)}</div>'
        )
    return f"<div>{''.join(parts)}</div>"


def _table(rows: Rows) -> str:
    head, *body = ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows]
    lines = [head.replace("td>", "th>"), *body]
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"
