"""The figure of the batch: cost over the optimum, and Ms, of estune and of every rule."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from estune.support.plot_style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    VERMILION,
    WIDTH_in,
    finish,
    new_figure,
    to_png,
)
from experiments.batch.optimum import MAX_SENSITIVITY

STYLES = {
    "AMIGO": (VERMILION, "o"),
    "SIMC": (GREEN, "s"),
    "lambda": (ORANGE, "^"),
    "Tyreus-Luyben": (PURPLE, "v"),
    "Ziegler-Nichols": (GREY, "x"),
    "relay": (BLACK, "+"),
}
MOST = {"above_percent": 1000.0, "Ms": 5.0}
"""Right end of each panel: what is larger, or unstable, stands there."""

LEAST_percent = -20.0
"""Left end of the costs: a rule above the limits may cost less than the optimum within them."""


def draw(rows: Sequence[Mapping[str, Any]], folder: Path) -> None:
    """Writes batch.png: a line for each plant."""
    figure = new_figure(WIDTH_in, 1.0 + 0.19 * len(rows))
    panels = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    places = np.arange(len(rows))[::-1]
    for axes, key in zip(panels, MOST, strict=True):
        for name, (color, marker) in STYLES.items():
            at = [_shown(row["rules"].get(name), key) for row in rows]
            axes.plot(at, places, marker, color=color, ms=4.5, label=name, clip_on=False)
        own = [
            (_shown(run, key), place)
            for row, place in zip(rows, places, strict=True)
            for run in row["estune"]
        ]
        at, where = np.array(own).T
        axes.plot(at, where, "D", color=BLUE, ms=5.0, label="estune", clip_on=False)
        axes.axvline(0.0 if key == "above_percent" else MAX_SENSITIVITY, color=BLUE, lw=0.7)
    cost, Ms = panels
    cost.set_xscale("symlog", linthresh=1.0, linscale=0.4)
    cost.set_xlim(LEAST_percent, MOST["above_percent"])
    cost.set_xticks([-10.0, 0.0, 1.0, 10.0, 100.0, 1000.0], ["-10", "0", "1", "10", "100", "1000"])
    Ms.set_xlim(1.0, MOST["Ms"])
    cost.set_yticks(places, [row["plant"] for row in rows])
    finish(cost, "", "cost above the optimum, % (1000: or unstable)")
    finish(Ms, "", "Ms (5: more, or unstable)")
    cost.tick_params(axis="y", labelsize=7)
    handles, labels = cost.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=len(labels), fontsize=8, frameon=False,
        handletextpad=0.1, columnspacing=1.0,
    )  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "batch.png").write_bytes(to_png(figure))


def _shown(at: Mapping[str, Any] | None, key: str) -> float:
    """The value within its panel; NaN where there is none."""
    if at is None or key not in at:
        return math.nan
    value: float = at[key]
    return min(value, MOST[key]) if math.isfinite(value) else MOST[key]
