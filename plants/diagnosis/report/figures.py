"""The figures of a diagnosis, drawn on axes that are handed in.

The model as it was is orange, the model with the effects blue, what was measured black, noise
grey.
"""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from estune.core.quantities import FloatArray
from estune.support.plot_style import (
    BLACK,
    BLUE,
    LIGHT,
    ORANGE,
    WIDTH_in,
    finish,
    legend,
    new_figure,
)
from plants.diagnosis.report.residual_figures import NOISE, draw_shares
from plants.diagnosis.report.summary import main_channel, step_name, worst_trace
from plants.diagnosis.residual.residuals import spectrum
from plants.diagnosis.result import BaseParameter, DiagnosisResult, Trace
from plants.effects.plant_scale import digits, si

BEFORE: dict[str, Any] = {"color": ORANGE, "linewidth": 1.1}
AFTER: dict[str, Any] = {"color": BLUE, "linewidth": 1.1}
MEASURED: dict[str, Any] = {"color": BLACK, "linewidth": 3.0, "alpha": 0.3}

BARS_MAX = 14
"""Effects that a ranking draws; the rest are in its table."""


def draw_gap(ax: Axes, d: DiagnosisResult) -> Axes:
    """Prediction error on data left out after each step, above the noise floor."""
    names = [step_name(s.effect) for s in d.steps]
    gaps = [s.gap for s in d.steps]
    at = np.arange(len(gaps))
    floor = [s.floor for s in d.steps]
    ax.bar(at, gaps, width=0.5, color=[ORANGE, *[BLUE] * (len(gaps) - 1)], zorder=2)
    for x, gap, step in zip(at, gaps, d.steps, strict=True):
        label = f"{si(gap, d.written_unit)}\n{step.ratio:.3g}x floor"
        ax.annotate(
            label, (x, gap), (0, 3), textcoords="offset points", ha="center", fontsize=8
        )  # fmt: skip
    ax.step([-0.5, *(at + 0.5)], [floor[0], *floor], where="pre", label="noise floor", **NOISE)
    ax.set_xticks(at, names)
    ax.set_xlim(-0.6, max(len(gaps), 2) - 0.4)
    ax.set_ylim(0.0, 1.3 * max([*gaps, *floor]))
    ax.yaxis.set_major_formatter(lambda value, _: digits(value))  # small ones without a factor
    finish(
        ax, f"prediction error rms, {d.written_unit}" if d.written_unit else "prediction error rms"
    )
    ax.grid(visible=False, axis="x")
    legend(ax)
    return ax


def draw_trace(ax: Axes, trace: Trace) -> Axes:
    """One channel of one record, measured and in free run before and after."""
    shown = excerpt(trace)
    time = trace.time_s[shown]
    ax.plot(time, trace.measured[shown], label="measured", **MEASURED)
    ax.plot(time, trace.before[shown], label="base model", **BEFORE)
    if changed(trace):
        ax.plot(time, trace.after[shown], label="with the effects", **AFTER)
    ax.set_xlim(time[0], time[-1])
    finish(ax, f"{trace.title}, {trace.unit}", "time, s")
    legend(ax)
    return ax


def draw_error(ax: Axes, trace: Trace) -> Axes:
    """Error of the free run over the whole record, before and after, as its envelope."""
    looks = [(trace.before, ORANGE, "base model")]
    looks += [(trace.after, BLUE, "with the effects")] * changed(trace)
    for predicted, colour, label in looks:
        time, low, high = _envelope(trace.time_s, trace.measured - predicted)
        ax.fill_between(time, low, high, color=colour, alpha=0.75, linewidth=0.5, label=label)
    shown = excerpt(trace)
    ends = trace.time_s[shown][0], trace.time_s[shown][-1]
    ax.axvspan(*ends, color=LIGHT, alpha=0.6, linewidth=0, zorder=0)
    ax.set_xlim(trace.time_s[0], trace.time_s[-1])
    finish(ax, f"error, {trace.unit}", "time, s")
    return ax


def draw_spectrum(ax: Axes, d: DiagnosisResult) -> Axes:
    """Amplitude density of the free run's error before and after, above that of the noise."""
    channel = main_channel(d)
    traces = [t for t in d.traces if t.channel == channel]
    looks = [("before", BEFORE, "base model")]
    looks += [("after", AFTER, "with the effects")] * any(map(changed, traces))
    for which, look, label in looks:
        frequency, density = error_density(traces, which)
        ax.plot(frequency, density, label=label, **look)
    unit = traces[0].unit
    noise = d.noise.channels.get(channel)
    if noise is not None and noise.rms > 0.0:
        white = noise.rms / math.sqrt(frequency[-1])
        ax.axhline(white, label="sensor noise", **NOISE)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlim(frequency[1], frequency[-1])
    finish(ax, f"{traces[0].title} error, {unit}/√Hz", "frequency, Hz")
    legend(ax)
    return ax


def draw_ranking(ax: Axes, d: DiagnosisResult) -> Axes:
    """Prediction error left by each effect that was fitted, in times the noise floor."""
    fitted = [c for c in d.candidates if math.isfinite(c.gap)][:BARS_MAX]
    ranked = {e.name for e in d.effects} | set(d.ambiguous)
    at = np.arange(len(fitted))[::-1]
    colours = [BLUE if c.name in ranked else "#b8c4cc" for c in fitted]
    ax.barh(at, [c.gap for c in fitted], height=0.62, color=colours, zorder=2)
    for y, c in zip(at, fitted, strict=True):
        ax.annotate(
            f"{c.gap:.3g}", (c.gap, y), (4, 0), textcoords="offset points", va="center",
            fontsize=8,
        )  # fmt: skip
    ax.axvline(d.before.ratio, color=ORANGE, linewidth=1.2, label="base model")
    ax.axvline(1.0, label="noise floor", **NOISE)
    ax.set_yticks(at, [c.name for c in fitted])
    finish(ax, "", "error left with this effect alone, times the noise floor")
    ax.grid(visible=False, axis="y")
    legend(ax, columns=2)
    return ax


def draw_calibrations(ax: Axes, d: DiagnosisResult) -> Axes:
    """The base model's numbers relative to those given, fitted without and with the effects."""
    shown = scalable(d)
    at = np.arange(len(shown))[::-1]
    fits = [("base", ORANGE, "s", 0.13, "fitted alone")]
    fits += [("with_effects", BLUE, "o", -0.13, "fitted with the effects")] * bool(d.effects)
    for which, colour, marker, off, label in fits:
        ends = [(f.value, f.low, f.high) for f in (getattr(c, which) for c in shown)]
        value, low, high = np.array(ends).T / np.array([c.given for c in shown])
        bars = np.nan_to_num(np.abs([value - low, high - value]))
        ax.errorbar(
            value, at + off, xerr=bars, fmt=marker, color=colour, markersize=4, capsize=2,
            linewidth=1.0, label=label,
        )  # fmt: skip
    ax.axvline(1.0, label="as given", **NOISE)
    ax.set_yticks(at, [c.name for c in shown])
    ax.set_ylim(-0.6, len(shown) - 0.4)
    finish(ax, "", "times the value given")
    legend(ax, columns=3)
    return ax


def changed(trace: Trace) -> bool:
    """Whether there is an after."""
    return not np.array_equal(trace.before, trace.after)


def excerpt(trace: Trace) -> slice:
    """The stretch in which the base model is worst, short enough that its curves can be read."""
    samples = trace.time_s.size
    shown = 1200
    if samples <= shown:
        return slice(0, samples)
    wrong = np.nan_to_num((trace.measured - trace.before) ** 2)
    power = np.cumsum(np.concatenate([[0.0], wrong]))
    start = int(np.argmax(power[shown:] - power[:-shown]))
    return slice(start, start + shown)


def error_density(traces: Iterable[Trace], which: str) -> tuple[FloatArray, FloatArray]:
    """Frequencies, Hz, and amplitude density of the error over all traces of one rate."""
    traces = list(traces)
    rate = _rate_Hz(traces[0].time_s)
    same = [t for t in traces if math.isclose(_rate_Hz(t.time_s), rate, rel_tol=1e-3)]
    errors = [t.measured - getattr(t, which) for t in same]
    frequency, power = spectrum([error - np.nanmean(error) for error in errors], rate, 1024)
    return frequency, np.sqrt(np.maximum(power, 1e-300))


def _rate_Hz(time_s: FloatArray) -> float:
    return float((time_s.size - 1) / (time_s[-1] - time_s[0]))


def _envelope(time: FloatArray, signal: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Least and greatest value in each of a few hundred bins, so that a page stays small."""
    bins = 600
    if time.size <= 2 * bins:
        return time, np.minimum(signal, 0.0), np.maximum(signal, 0.0)
    starts = np.linspace(0, time.size, bins, endpoint=False).astype(int)
    known = np.nan_to_num(signal)
    return time[starts], np.minimum.reduceat(known, starts), np.maximum.reduceat(known, starts)


def scalable(d: DiagnosisResult) -> tuple[BaseParameter, ...]:
    """The base-model parameters that can be shown relative to their given values."""
    return tuple(c for c in d.calibrations if math.isfinite(c.given) and c.given != 0.0)


def overview(d: DiagnosisResult) -> Figure:
    """Before and after, the error step by step, and where it is."""
    figure = new_figure(WIDTH_in, 6.4)
    grid = figure.add_gridspec(2, 2)
    if d.traces:
        draw_trace(figure.add_subplot(grid[0, :]), worst_trace(d))
    draw_gap(figure.add_subplot(grid[1, 0] if d.unexplained.blocks else grid[1, :]), d)
    if d.unexplained.blocks:
        draw_shares(figure.add_subplot(grid[1, 1]), d.unexplained)
    return figure
