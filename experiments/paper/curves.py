"""Styles of the curves of one figure."""

from typing import Any

from estune.support.plot_style import BLUE, GREEN, PURPLE, VERMILION

FOUR: tuple[dict[str, Any], ...] = (
    {"color": BLUE, "linestyle": "-", "linewidth": 1.2},
    {"color": GREEN, "linestyle": (0, (5, 1.2)), "linewidth": 1.2},
    {"color": PURPLE, "linestyle": (0, (1.5, 0.9)), "linewidth": 1.2},
    {"color": VERMILION, "linestyle": (0, (6, 1.5, 1.5, 1.5)), "linewidth": 1.2},
)
"""Styles of four curves; the dashes distinguish them in grey."""
