"""How the page's drawings look."""

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from estune.figures import BLUE, GREEN, PURPLE, VERMILION, new_figure

FOUR: tuple[dict[str, Any], ...] = (
    {"color": BLUE, "linestyle": "-", "linewidth": 1.2},
    {"color": GREEN, "linestyle": (0, (5, 1.2)), "linewidth": 1.2},
    {"color": PURPLE, "linestyle": (0, (1.5, 0.9)), "linewidth": 1.2},
    {"color": VERMILION, "linestyle": (0, (6, 1.5, 1.5, 1.5)), "linewidth": 1.2},
)
"""Looks of four curves in order; the dashes tell them apart in grey."""
WIDTH_in = 7.2


def stacked(rows: int, height_in: float) -> tuple[Figure, list[Axes]]:
    """A figure with axes above each other that share their abscissa."""
    figure = new_figure(WIDTH_in, height_in)
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)
    return figure, list(axes[:, 0])


def finish(ax: Axes, ordinate: str, abscissa: str = "") -> None:
    """Labels, a light grid, and no frame where nothing is read off."""
    ax.set_ylabel(ordinate, fontsize=9)
    if abscissa:
        ax.set_xlabel(abscissa, fontsize=9)
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=8)
    ax.grid(visible=True, color="#e6e6e6", linewidth=0.6)
    ax.set_axisbelow(True)


def legend(ax: Axes, columns: int = 4) -> None:
    """A legend above the axes."""
    ax.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, fontsize=8, frameon=False,
        handlelength=2.4, columnspacing=1.6, borderaxespad=0.2,
    )  # fmt: skip
