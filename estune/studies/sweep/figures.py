"""The paper's Figs. 12, 13 and 14 of a sweep: cost and I over trials, gains over length."""

from collections.abc import Callable, Iterator, Sequence
from operator import attrgetter

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from estune.core.quantities import FloatArray
from estune.studies.law.law import GainLaw
from estune.studies.sweep.outcome import TRACE, CellOutcome, read_traces
from estune.support.lazy_sequence import LazySequence
from estune.support.plot_style import (
    BLACK,
    BLUE,
    GREY,
    LIGHT,
    VERMILION,
    WIDTH_in,
    finish,
    legend,
    new_figure,
    stacked,
)
from estune.support.quantity_text import axis_label

_COST, _UNSAFE = TRACE.index("cost"), TRACE.index("unsafe")
_SMOOTHED = 8
"""Trials in the running mean that removes the dither from a gain; of a search that ends within few
trials, which has no dither, a quarter of them."""
_LABELS = {"P": "P", "I": "I", "D": "D", "setpoint_filter_s": "setpoint filter"}
_CURVE_POINTS = 200
_MOST_IN_LEGEND = 10
_VECTORS_MAX = 2000
"""Points of a figure that are drawn one by one; more are drawn as an image."""
_PIXELS = 1000
"""Resolution of that image; it is 650 pixels wide."""


def draw_costs(outcomes: LazySequence[CellOutcome]) -> Figure:
    """Fig. 12: the cost of each search trial, one line a length: the median over its tunings."""
    figure, (ax,) = stacked(1, 3.0)
    for length, color, costs in _by_length(outcomes, _safe_costs):
        median = _median(costs)
        trial = np.arange(median.size)
        ax.plot(trial, median, ".-", color=color, label=f"{length:g} m", lw=1.1, ms=4.0)
    ax.set_yscale("log")
    _over_trials(ax, "cost η")
    return figure


def draw_integral(outcomes: LazySequence[CellOutcome]) -> Figure:
    """Fig. 13: the running mean of the integral gain over the search, one line a length."""
    figure, (ax,) = stacked(1, 3.0)
    column = TRACE.index("I")
    for length, color, gains in _by_length(outcomes, lambda search: search[:, column].copy()):
        width = min(_SMOOTHED, max(1, min(gain.size for gain in gains) // 4))
        median = _median([_running_mean(gain, width) for gain in gains])
        trial = np.arange(median.size) + width - 1
        ax.plot(trial, median, ".-", color=color, label=f"{length:g} m", lw=1.1, ms=4.0)
    _over_trials(ax, axis_label("I", outcomes[0].cell.signals.gain_units["I"]))
    return figure


def _over_trials(ax: Axes, label: str) -> None:
    ax.set_xlim(-0.2, max(float(ax.dataLim.x1), 1.0) + 0.2)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    finish(ax, label, "search trial; 0 is of the initial gains")
    _legend(ax)


def draw_law(law: GainLaw, name: str, excluded: Sequence[CellOutcome]) -> Figure:
    """Fig. 14: one gain over length, the law with its bands, and its residuals below."""
    figure = new_figure(WIDTH_in, 4.0)
    ax, below = figure.subplots(2, 1, sharex=True, height_ratios=[3.0, 1.0])
    fit = law.fits[name]
    length = np.linspace(*law.length_m, _CURVE_POINTS)
    band = law.band(name, length)
    ax.fill_between(
        length, band.new_low, band.new_high, color=LIGHT, alpha=0.6, lw=0.0,
        label="a further tuning, 95 %",
    )  # fmt: skip
    ax.fill_between(
        length, band.low, band.high, color=BLUE, alpha=0.25, lw=0.0, label="the law, 95 %"
    )
    ax.plot(length, band.gain, color=BLUE, lw=1.4, label=_curve_label(law, name))
    tuned, many = fit.points.length_m, fit.points.length_m.size > _VECTORS_MAX
    gains = _distinct(tuned, fit.points.gain)
    ax.plot(*gains, ".", color=BLACK, ms=5, label="tuned", rasterized=many)
    shown = [(o.cell.length_m, getattr(o.gains, name)) for o in excluded if o.gains is not None]
    if shown:
        ax.plot(*zip(*shown, strict=True), "x", color=VERMILION, ms=5, label="left out")
    finish(ax, axis_label(_LABELS[name], law.signals.gain_units[name]))
    legend(ax, columns=3)
    below.axhline(0.0, color=GREY, lw=0.8)
    residuals = _distinct(tuned, fit.fit.studentised)
    below.plot(*residuals, ".", color=BLACK, ms=4, rasterized=many)
    finish(below, "residual, sd", "cable length, m")
    return figure


def _distinct(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points without those that would be drawn on top of others."""
    if x.size <= _VECTORS_MAX:
        return x, y
    cells = [np.rint((v - v.min()) * (_PIXELS / (np.ptp(v) or 1.0))) for v in (x, y)]
    _, first = np.unique(cells[0] * (_PIXELS + 1) + cells[1], return_index=True)
    return x[first], y[first]


def _curve_label(law: GainLaw, name: str) -> str:
    low, high = law.tension_N
    at = f" at {law.signals.measured((low + high) / 2.0, 6)}" if low < high else ""
    return f"{law.fits[name].curve}{at}"


def _safe_costs(search: FloatArray) -> FloatArray:
    return np.where(search[:, _UNSAFE] == 0.0, search[:, _COST], np.nan)


def _by_length(
    outcomes: LazySequence[CellOutcome], column: Callable[[FloatArray], FloatArray]
) -> Iterator[tuple[float, str, list[FloatArray]]]:
    """Length, colour, and a column of each search there; the other columns are not kept.

    The first row of a search is the first trial of the initial gains.
    """
    at = outcomes.where(attrgetter("trials")).groups(attrgetter("cell.length_m"))
    # The colour map is distinguishable in grey; its palest end is not used.
    shares = np.linspace(0.0, 0.88, len(at))
    for length, share in zip(sorted(at), shares, strict=True):
        columns = (column(_from_start(trace)) for trace in read_traces(at[length]))
        searches = [values for values in columns if values.size]
        if searches:
            yield length, to_hex(mpl.colormaps["viridis"](share)), searches


def _from_start(trace: FloatArray) -> FloatArray:
    shown = trace[:, 0] == 1.0
    shown[:1] = True
    rows: FloatArray = trace[shown]
    return rows


def _median(rows: Sequence[FloatArray]) -> FloatArray:
    """Median over rows of unequal length, up to the median length."""
    columns = sorted(row.size for row in rows)[(len(rows) - 1) // 2]
    table = np.full((columns, len(rows)), np.nan)
    for place, row in zip(table.T, rows, strict=True):
        place[: row.size] = row[:columns]
    safe = (column[np.isfinite(column)] for column in table)
    return np.array([np.median(costs) if costs.size else np.nan for costs in safe])


def _running_mean(values: FloatArray, width: int) -> FloatArray:
    if values.size < width:
        return values[:0]
    return np.convolve(values, np.full(width, 1.0 / width), mode="valid")


def _legend(ax: Axes) -> None:
    """A legend of at most `_MOST_IN_LEGEND` lengths."""
    handles, labels = ax.get_legend_handles_labels()
    every = -(-len(labels) // _MOST_IN_LEGEND)
    ax.legend(
        handles[::every], labels[::every], loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=5,
        fontsize=8, frameon=False, handlelength=2.0, columnspacing=1.4, borderaxespad=0.2,
    )  # fmt: skip
