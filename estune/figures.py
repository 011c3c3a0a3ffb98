"""The figures of a run: cost per trial, step response before and after, gains over the trials.

They are drawn on axes that are handed in, from the columns of `TuneResult.to_frame` and from trial
records, and never touch pyplot, so that a service can draw them too. Colours are of the Okabe-Ito
set, which stays apart for colour-blind readers; markers and dashes tell the same in grey.
"""

import math
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

from estune.core.gains import GAIN_NAMES, GAIN_UNITS, Gains
from estune.trial import StepProfile, TrialRecord

if TYPE_CHECKING:
    import pandas as pd

BLACK, GREY, LIGHT = "#222222", "#7a7a7a", "#d9d9d9"
BLUE, VERMILION, GREEN, ORANGE, PURPLE = "#0072b2", "#d55e00", "#009e73", "#e69f00", "#cc79a7"

PHASES = {
    "baseline": (ORANGE, "s", "start gains"),
    "search": (BLUE, "o", "search"),
    "confirm": (GREEN, "D", "confirmation"),
}
GAIN_LOOKS = {
    "P": (BLUE, "-", "P"),
    "I": (VERMILION, "-", "I"),
    "D": (GREEN, (0, (4, 1.2)), "D"),
    "setpoint_filter_s": (PURPLE, (0, (1.5, 0.8)), "filter"),
}

_STYLE: dict[str, Any] = {"fontsize": 9}
_LEGEND: dict[str, Any] = {
    "fontsize": 8,
    "frameon": False,
    "handlelength": 1.8,
    "columnspacing": 1.2,
}
_DECADE = 10.0


class ShownFigure(Figure):
    """A figure that a notebook displays by itself, without pyplot having been loaded."""

    def _repr_png_(self) -> bytes:
        return to_png(self)


class ShownAxes(Axes):
    """Axes that a notebook displays as their whole figure."""

    def _repr_png_(self) -> bytes:
        return to_png(self.get_figure(root=True) or ShownFigure())


def new_axes() -> Axes:
    """Axes on a figure of their own."""
    axes: Axes = new_figure(6.4, 3.2).add_subplot(axes_class=ShownAxes)
    return axes


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure that lays itself out."""
    figure = ShownFigure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def to_png(figure: Figure, dpi: float = 160.0) -> bytes:
    """The figure as PNG."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def to_svg(figure: Figure) -> str:
    """The figure as an SVG element, ready to stand in a page."""
    buffer = BytesIO()
    # No date, so that the same run gives the same page.
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue().decode()
    return text[text.index("<svg") :]


def draw_cost(ax: Axes, frame: "pd.DataFrame", start_cost: float, eta_max: float) -> Axes:
    """Cost per trial by phase, the best so far, and the trials that were unsafe.

    Args:
        ax: Where to draw.
        frame: The run's trials, as of `TuneResult.to_frame`.
        start_cost: Mean cost of the start gains; nan if there is none.
        eta_max: The cost above which a trial is unsafe; may be infinite.
    """
    shown = frame[frame["cost"].notna() & ~frame["unsafe"]]
    for phase, (colour, marker, label) in PHASES.items():
        part = shown[shown["phase"] == phase]
        ax.plot(
            part["number"], part["cost"], marker, color=colour, label=label, zorder=3,
            markersize=3.2 if phase == "search" else 4.0, markeredgewidth=0, alpha=0.85,
        )  # fmt: skip
    # The confirmation repeats given gains: a lucky repeat of theirs is no news of a better place.
    searched = frame[frame["phase"] != "confirm"]
    ax.plot(
        searched["number"], searched["best_cost"], color=BLACK, linewidth=1.3,
        drawstyle="steps-post", label="best so far", zorder=2,
    )  # fmt: skip
    if math.isfinite(start_cost):
        ax.axhline(start_cost, color=ORANGE, linewidth=0.9, linestyle="--", zorder=1)
    finite = shown["cost"].to_numpy(dtype=float)
    if finite.size and finite.min() > 0.0 and finite.max() / finite.min() > _DECADE:
        ax.set_yscale("log")
    _draw_unsafe(ax, frame[frame["unsafe"]], finite, eta_max)
    ax.set_xlabel("trial", **_STYLE)
    ax.set_ylabel("cost η (1 = as good as first order)", **_STYLE)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    _finish(ax)
    _legend_above(ax, columns=3)
    return ax


def draw_response(
    ax: Axes, step: StepProfile, before: TrialRecord | None, after: TrialRecord | None
) -> Axes:
    """The step response before and after tuning, with the setpoint and the 2 % band about it.

    Args:
        ax: Where to draw.
        step: The step asked for.
        before: Response with the start gains.
        after: Response with the recommended gains; None if there are none.
    """
    final = step.preload_N + step.step_N
    band = 0.02 * abs(step.step_N)
    ax.axhspan(final - band, final + band, color=LIGHT, linewidth=0, label="±2 % of the step")
    looks = (
        (before, ORANGE, 1.1, "start gains"),
        (after, BLUE, 1.3, "tuned gains"),
    )
    first = next((record for record, *_ in looks if record is not None), None)
    if first is not None:
        ax.plot(
            first.time_s - step.step_at_s,
            first.setpoint_N,
            "--",
            color=GREY,
            linewidth=0.9,
            drawstyle="steps-post",
            label="setpoint",
        )
    for record, colour, width, label in looks:
        if record is not None:
            ax.plot(
                record.time_s - step.step_at_s, record.tension_N, color=colour, linewidth=width,
                label=label, zorder=2,
            )  # fmt: skip
    ax.set_xlim(-min(step.step_at_s, 0.1 * step.duration_s), step.duration_s - step.step_at_s)
    ax.set_xlabel("time from the step, s", **_STYLE)
    ax.set_ylabel("tension, N", **_STYLE)
    _finish(ax)
    ax.legend(loc="best", **_LEGEND)
    return ax


def draw_gains(ax: Axes, frame: "pd.DataFrame", start: Gains, recommended: Gains) -> Axes:
    """Each gain over the trials as a multiple of its start, on a logarithmic axis.

    Args:
        ax: Where to draw.
        frame: The run's trials, as of `TuneResult.to_frame`.
        start: The gains at the beginning.
        recommended: The gains the run came to.
    """
    ax.set_yscale("log")
    ax.axhline(1.0, color=LIGHT, linewidth=0.9, zorder=0)
    for name in GAIN_NAMES:
        colour, dash, label = GAIN_LOOKS[name]
        values = frame[name].to_numpy(dtype=float)
        # A gain that starts at zero has no multiple: it is shown against its first other value.
        above = values[values > 0.0]
        unit = getattr(start, name) or (above[0] if above.size else math.nan)
        if not math.isfinite(unit):
            continue
        end = getattr(recommended, name)
        shown = np.where(values > 0.0, values, np.nan) / unit
        label = f"{label}  {getattr(start, name):.3g} → {end:.3g} {GAIN_UNITS[name]}"
        ax.plot(frame["number"], shown, linestyle=dash, color=colour, linewidth=1.1, label=label)
        if end > 0.0 and len(frame):
            last = frame["number"].iloc[-1]
            ax.plot(last, end / unit, "o", color=colour, markersize=4.5, clip_on=False)
    ax.set_xlabel("trial", **_STYLE)
    ax.set_ylabel("gain / start gain", **_STYLE)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    _finish(ax)
    _legend_above(ax, columns=2)
    return ax


def _draw_unsafe(ax: Axes, unsafe: "pd.DataFrame", safe: Any, eta_max: float) -> None:
    """Unsafe trials as crosses along the top edge: their cost, if any, is not on the scale."""
    if safe.size:
        low, high = float(safe.min()), float(safe.max())
        log = ax.get_yscale() == "log"
        margin = (high / low) ** 0.06 if log else 0.06 * ((high - low) or high)
        bottom = low / margin if log else low - margin
        room = 2.5 if len(unsafe) else 1.0
        top = high * margin**room if log else high + room * margin
        ax.set_ylim(bottom, top)
        if bottom < eta_max < top:
            ax.axhline(eta_max, color=VERMILION, linewidth=0.9, linestyle=":", zorder=1)
    if len(unsafe):
        ax.plot(
            unsafe["number"], np.full(len(unsafe), 0.965), "x", color=VERMILION, markersize=5,
            markeredgewidth=1.3, transform=ax.get_xaxis_transform(), label="unsafe", zorder=3,
        )  # fmt: skip


def _legend_above(ax: Axes, columns: int) -> None:
    """A legend above the axes, where points over decades leave no corner free."""
    ax.legend(loc="lower left", bbox_to_anchor=(-0.12, 1.0), ncols=columns, **_LEGEND)


def _finish(ax: Axes) -> None:
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=8)
    ax.grid(visible=True, color="#eeeeee", linewidth=0.6)
    ax.set_axisbelow(True)
    if ax.get_yscale() == "log":
        low, high = ax.get_ylim()
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        # Less than two decades would show one labelled tick or none.
        subs = (1.0, 2.0, 5.0) if high / low < _DECADE**2 else (1.0,)
        ax.yaxis.set_major_locator(LogLocator(subs=subs))
        ax.yaxis.set_minor_formatter(NullFormatter())
