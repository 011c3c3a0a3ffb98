"""Figures of where a residual is: by block, by variable, by frequency."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from estune.support.plot_style import (
    BLUE,
    GREEN,
    GREY,
    LIGHT,
    PURPLE,
    VERMILION,
    WIDTH_in,
    finish,
    new_figure,
)
from plants.diagnosis.residual.localisation import (
    Block,
    ResidualDependence,
    ResidualLocation,
)

NOISE: dict[str, Any] = {"color": GREY, "linewidth": 1.0, "linestyle": (0, (4, 2))}
_BLOCK_COLOURS = (VERMILION, PURPLE, GREEN, BLUE)


def draw_shares(ax: Axes, where: ResidualLocation) -> Axes:
    """Share of each block's residual that follows each variable."""
    names = list(dict.fromkeys(v.name for b in where.blocks for v in b.views))
    best = {n: max(v.share for b in where.blocks for v in b.views if v.name == n) for n in names}
    names.sort(key=lambda name: best[name])
    height = 0.8 / max(len(where.blocks), 1)
    for n, (block, colour) in enumerate(zip(where.blocks, _BLOCK_COLOURS, strict=False)):
        shares = {view.name: view.share for view in block.views}
        at = np.arange(len(names)) + 0.4 - height * (n + 0.5)
        values = [100.0 * shares.get(name, 0.0) for name in names]
        label = f"{block.name}, {block.ratio:.3g} times noise"
        ax.barh(at, values, height=0.9 * height, color=colour, label=label, zorder=2)
    ax.set_yticks(np.arange(len(names)), names)
    ax.set_xlim(0.0, 100.0)
    finish(ax, "", "share of the residual explained, %")
    ax.grid(visible=False, axis="y")
    # The bars are shortest below.
    ax.legend(loc="lower right", fontsize=8, frameon=False, handlelength=1.2)
    return ax


def block_figure(block: Block) -> Figure:
    """A block's residual over each variable, the one it follows first, and its spectrum."""
    first = block.regime
    others = [view for view in block.views if view is not first]
    columns, wide = 3, 0 if first is None else 2
    places = [divmod(n, columns) for n in range(wide, wide + 1 + len(others))]
    rows = places[-1][0] + 1
    figure = new_figure(WIDTH_in, 1.75 * rows)
    grid = figure.add_gridspec(rows, columns)
    if first is not None:
        draw_view(figure.add_subplot(grid[0, :wide]), block, first)
    draw_block_spectrum(figure.add_subplot(grid[places[0]]), block)
    for place, view in zip(places[1:], others, strict=True):
        draw_view(figure.add_subplot(grid[place]), block, view)
    return figure


def draw_block_spectrum(ax: Axes, block: Block) -> Axes:
    """Spectrum of a block's residual above that of the noise."""
    positive = block.frequency_Hz > 0.0
    frequency = block.frequency_Hz[positive]
    ax.plot(frequency, np.sqrt(block.power[positive]), color=VERMILION, linewidth=1.0)
    ax.plot(frequency, np.sqrt(block.noise_power[positive]), **NOISE)
    ax.set_xscale("log")
    ax.set_yscale("log")
    if block.low_Hz < block.high_Hz:
        ax.axvspan(block.low_Hz, block.high_Hz, color=LIGHT, alpha=0.6, linewidth=0, zorder=0)
    ax.set_title(f"spectrum: {block.band}".rstrip(": "), fontsize=8, loc="left")
    finish(ax, f"residual, {block.unit}/√Hz", "Hz")
    return _small(ax)


def draw_view(ax: Axes, block: Block, view: ResidualDependence) -> Axes:
    """The mean residual of a block over one variable."""
    if view.name == "velocity sign":
        place = np.sign(np.round(view.at))
        ax.bar(place, view.mean, width=0.5, color=VERMILION, zorder=2)
        ax.set_xticks([-1, 0, 1], ["v < 0", "at rest", "v > 0"])
        ax.set_xlim(-1.5, 1.5)
    else:
        # A variable that is crossed with the sign starts over for each sign.
        starts = np.flatnonzero(np.diff(view.at) < 0.0) + 1
        parts = list(zip(np.split(view.at, starts), np.split(view.mean, starts), strict=True))
        for (at, mean), look in zip(parts, _signs(len(parts)), strict=False):
            ax.plot(at, mean, "o-", markersize=2.6, linewidth=1.0, **look)
        if view.name == "frequency":
            ax.set_xscale("log")
        if len(parts) > 1:
            ax.legend(fontsize=7, frameon=False, handlelength=1.2)
    ax.axhspan(-block.noise_rms, block.noise_rms, color=LIGHT, alpha=0.6, linewidth=0, zorder=0)
    name = view.name.replace("velocity sign and", "sign and")
    ax.set_title(f"{name}: {100.0 * view.share:.0f} %", fontsize=8, loc="left")
    within = f"{view.unit}, in {view.detail}" if view.detail else view.unit
    finish(ax, f"residual, {block.unit}", within or " ")
    return _small(ax)


def _signs(parts: int) -> list[dict[str, Any]]:
    """Looks of the curves of a view that is crossed with the sign of the velocity."""
    if parts == 1:
        return [{"color": VERMILION}]
    looks = [{"color": BLUE, "label": "v < 0"}, {"color": VERMILION, "label": "v > 0"}]
    return looks if parts == 2 else [looks[0], {"color": GREY, "label": "at rest"}, looks[1]]


def _small(ax: Axes) -> Axes:
    """Labels for one of many small axes."""
    for label in (ax.xaxis.label, ax.yaxis.label):
        label.set_fontsize(8)
    return ax
