"""Figures of a run: cost per trial, step response before and after, gains over the trials.

Each is drawn on the given axes or on new ones, from `RunResult.columns` and from trial records.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from estune.core.gains import GAIN_NAMES, Gains
from estune.core.metrics import BAND
from estune.core.quantities import BoolArray, FloatArray
from estune.loop_model.load_rejection import HORIZON, LoadRejection
from estune.support.plot_style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    LIGHT,
    ORANGE,
    PURPLE,
    VERMILION,
    finish,
    legend,
    new_axes,
)
from estune.support.quantity_text import axis_unit, with_unit
from estune.trial import RigDescription, TrialRecord
from estune.trial.profiles import LoadStepProfile, StepProfile

Trials = Mapping[str, NDArray[Any]]
"""Columns of a run's trials, as of `RunResult.columns`."""

PHASES = {
    "baseline": (ORANGE, "s", "initial gains"),
    "search": (BLUE, "o", "search"),
    "choose": (PURPLE, "^", "choice"),
    "confirm": (GREEN, "D", "confirmation"),
}
GAIN_LOOKS = {
    "P": (BLUE, "-", "P"),
    "I": (VERMILION, "-", "I"),
    "D": (GREEN, (0, (4, 1.2)), "D"),
    "setpoint_filter_s": (PURPLE, (0, (1.5, 0.8)), "filter"),
}

_LOOKS: Mapping[str, dict[str, Any]] = {
    "start": {
        "color": ORANGE, "linewidth": 1.1, "linestyle": (0, (5, 1.2)), "label": "initial gains"
    },
    "tuned": {"color": BLUE, "linewidth": 1.3, "label": "tuned gains"},
}  # fmt: skip
"""Curves before and after the tuning."""

_LEGEND: Mapping[str, Any] = {
    "loc": "best", "fontsize": 8, "frameon": False, "handlelength": 1.8
}  # fmt: skip

_DECADE = 10.0
FEW = 20
"""Trials of a phase from which their symbols are drawn smaller."""

VECTORS_MAX = 2000
"""Trials of a figure that are drawn one by one; more are drawn as an image."""


def draw_cost(ax: Axes | None, trials: Trials, start_cost: float, eta_max: float) -> Axes:
    """Cost per trial by phase, the lowest so far, and the unsafe trials.

    Args:
        trials: The trials, as of `RunResult.columns`.
        start_cost: Mean cost of the initial gains; nan if there is none.
        eta_max: The cost above which a trial is unsafe; may be infinite.
    """
    ax = ax or new_axes()
    shown = _where(trials, ~np.isnan(trials["cost"]) & ~trials["unsafe"])
    for phase, (colour, marker, label) in PHASES.items():
        part = _where(shown, shown["phase"] == phase)
        count = part["number"].size
        if not count:
            continue
        ax.plot(
            part["number"], part["cost"], marker, color=colour, label=label, zorder=3,
            markersize=4.0 if count < FEW else 3.2, markeredgewidth=0, alpha=0.85,
            rasterized=count > VECTORS_MAX,
        )  # fmt: skip
    # Repeats after the search are left out: a lucky one does not mean better gains.
    searched = _searched(trials)
    ax.plot(
        searched["number"], searched["best_cost"], color=BLACK, linewidth=1.3,
        drawstyle="steps-post", label="best so far", zorder=2,
    )  # fmt: skip
    if math.isfinite(start_cost):
        ax.axhline(start_cost, color=ORANGE, linewidth=0.9, linestyle="--", zorder=1)
    finite = shown["cost"]
    if finite.size and finite.min() > 0.0 and finite.max() / finite.min() > _DECADE:
        ax.set_yscale("log")
    _draw_unsafe(ax, trials["number"][trials["unsafe"]], finite, eta_max)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    finish(ax, "cost η (1 = as good as first order)", "trial")
    legend(ax, columns=2, left=-0.12)
    return ax


def draw_response(
    ax: Axes | None, step: StepProfile, before: TrialRecord | None, after: TrialRecord | None,
    ordinate: str = "tension, N",
) -> Axes:  # fmt: skip
    """The step response before and after tuning, with the setpoint and its 2 % band."""
    ax = ax or new_axes()
    _draw_band(ax, step.preload_N + step.step_N, step.step_N)
    first = before or after
    per_s, unit = axis_unit(step.duration_s)
    if first is not None:
        ax.plot(
            (first.time_s - step.step_at_s) * per_s, first.setpoint_N, "--", color=GREY,
            linewidth=0.9, drawstyle="steps-post", label="setpoint",
        )  # fmt: skip
    for record, look in _before_and_after(before, after):
        ax.plot((record.time_s - step.step_at_s) * per_s, record.tension_N, zorder=2, **look)
    _mark_load(ax, step, per_s)
    early_s = min(step.step_at_s, 0.1 * step.duration_s)
    ax.set_xlim(-early_s * per_s, (step.duration_s - step.step_at_s) * per_s)
    finish(ax, ordinate, f"time from the step, {unit}")
    ax.legend(**_LEGEND)
    return ax


def draw_command(
    ax: Axes,
    step: StepProfile,
    rig: RigDescription,
    before: TrialRecord | None,
    after: TrialRecord | None,
) -> Axes:
    """The controller output before and after tuning, and its limits where they are near."""
    per_s, unit = axis_unit(step.duration_s)
    for record, look in _before_and_after(before, after):
        effort = record.current_A * rig.newtons_per_ampere
        ax.plot((record.time_s - step.step_at_s) * per_s, effort, **look)
    _mark_load(ax, step, per_s)
    low, high = ax.get_ylim()
    room = 0.5 * (high - low)
    for limit in (rig.controller.output_min_N, rig.controller.output_max_N):
        if low - room <= limit <= high + room:
            ax.axhline(limit, color=VERMILION, linewidth=1.0, linestyle=":", label="limit")
    finish(ax, rig.command, f"time from the step, {unit}")
    return ax


def draw_disturbance(
    ax: Axes,
    step: LoadStepProfile,
    rig: RigDescription,
    before: TrialRecord | None,
    after: TrialRecord | None,
) -> Axes:
    """Deviation from the setpoint after the load, before and after tuning, with the 2 % band."""
    per_s, unit = axis_unit(step.duration_s)
    _draw_band(ax, 0.0, step.step_N)
    for record, look in _before_and_after(before, after):
        at = round(step.load_at_s * record.sampling_Hz)
        deviation = record.tension_N[at:] - record.setpoint_N[at:]
        ax.plot((record.time_s[at:] - step.load_at_s) * per_s, deviation, **look)
    return _finish_deviation(ax, rig, unit)


def draw_rejections(
    ax: Axes, rejections: Mapping[str, LoadRejection | None], step_N: float, rig: RigDescription
) -> Axes:
    """Predicted deviation after a load step, by the names of `_LOOKS`, with the 2 % band."""
    _draw_band(ax, 0.0, step_N)
    known = {name: at for name, at in rejections.items() if at is not None}
    ends_s = [at.vanished_s if at.vanishes else math.inf for at in known.values()]
    longest_s = max(at.time_s[-1] for at in known.values())
    shown_s = min(1.5 * max(*ends_s, longest_s / HORIZON), longest_s)
    per_s, unit = axis_unit(shown_s)
    for name, at in known.items():
        shown = at.time_s <= shown_s
        ax.plot(at.time_s[shown] * per_s, at.deviation[shown], **_LOOKS[name])
    return _finish_deviation(ax, rig, unit)


def _draw_band(ax: Axes, level: float, step_N: float) -> None:
    band = BAND * abs(step_N)
    ax.axhspan(level - band, level + band, color=LIGHT, linewidth=0, label="±2 % of the step")


def _finish_deviation(ax: Axes, rig: RigDescription, unit: str) -> Axes:
    finish(ax, f"deviation, {rig.measurement_unit}".rstrip(", "), f"time from the load, {unit}")
    ax.legend(**_LEGEND)
    return ax


def _mark_load(ax: Axes, step: StepProfile, per_s: float) -> None:
    """Marks the begin of the load that some profiles add after the step."""
    load_at_s = getattr(step, "load_at_s", None)
    if load_at_s is not None:
        at = (load_at_s - step.step_at_s) * per_s
        ax.axvline(at, color=GREY, linewidth=0.9, linestyle=":", label="load begins")


def _before_and_after(
    before: TrialRecord | None, after: TrialRecord | None
) -> Iterator[tuple[TrialRecord, dict[str, Any]]]:
    """The records that there are, each with its look."""
    if before is not None:
        yield before, _LOOKS["start"]
    if after is not None:
        yield after, _LOOKS["tuned"]


def draw_gains(
    ax: Axes | None,
    trials: Trials,
    start: Gains,
    recommended: Gains,
    *,
    intervals: Mapping[str, tuple[float, float]],
    units: Mapping[str, str],
) -> Axes:
    """Each gain over the search, relative to its initial value, on a logarithmic axis.

    Args:
        trials: The trials, as of `RunResult.columns`.
        recommended: The gains of the result, drawn behind the last trial.
        intervals: Confidence interval of each optimum, by name, drawn as bars.
        units: Units of the gains, by name.
    """
    ax = ax or new_axes()
    last = float(trials["number"].max(initial=0))
    searched = _searched(trials)
    number = searched["number"]
    ax.set_yscale("log")
    ax.axhline(1.0, color=LIGHT, linewidth=0.9, zorder=0)
    for place, name in enumerate(GAIN_NAMES, start=2):
        colour, dash, label = GAIN_LOOKS[name]
        values = searched[name]
        # A gain with initial value zero is shown relative to its first other value.
        above = values[values > 0.0]
        unit = getattr(start, name) or (above[0] if above.size else math.nan)
        if not math.isfinite(unit):
            continue
        end = getattr(recommended, name)
        shown = np.where(values > 0.0, values, np.nan) / unit
        label = f"{label}  {getattr(start, name):.3g} → {with_unit(end, units[name], 3)}"
        ax.plot(
            number, shown, linestyle=dash, color=colour, linewidth=1.1, label=label,
            rasterized=number.size > VECTORS_MAX,
        )  # fmt: skip
        if end > 0.0 and number.size:
            # Side by side, so that the bars do not overlap.
            behind = last * (1.0 + 0.015 * place) + 0.15 * place
            ax.plot(behind, end / unit, "o", color=colour, markersize=4.5, clip_on=False)
            if name in intervals:
                low, high = intervals[name]
                ax.vlines(behind, low / unit, high / unit, color=colour, linewidth=1.6)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    finish(ax, "gain / initial gain", "trial")
    legend(ax, columns=2, left=-0.12)
    return ax


def _where(trials: Trials, chosen: BoolArray) -> Trials:
    return {name: column[chosen] for name, column in trials.items()}


def _searched(trials: Trials) -> Trials:
    return _where(trials, np.isin(trials["phase"], ["baseline", "search"]))


def _draw_unsafe(ax: Axes, unsafe: NDArray[Any], safe: FloatArray, eta_max: float) -> None:
    """Unsafe trials as crosses along the top edge: their cost, if any, is off the scale."""
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
            unsafe, np.full(len(unsafe), 0.965), "x", color=VERMILION, markersize=5,
            markeredgewidth=1.3, transform=ax.get_xaxis_transform(), label="unsafe", zorder=3,
        )  # fmt: skip
