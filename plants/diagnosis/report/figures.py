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
from matplotlib.patches import Patch

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.support.plot_style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    LIGHT,
    ORANGE,
    PURPLE,
    VERMILION,
    WIDTH_in,
    finish,
    legend,
    new_figure,
)
from plants.diagnosis.report.diagnosis import BaseParameter, Diagnosis, Trace
from plants.diagnosis.residual.localisation import Block, Distortion, ResidualDependence
from plants.effects.plant_scale import digits, si

BEFORE: dict[str, Any] = {"color": ORANGE, "linewidth": 1.1}
AFTER: dict[str, Any] = {"color": BLUE, "linewidth": 1.1}
MEASURED: dict[str, Any] = {"color": BLACK, "linewidth": 3.0, "alpha": 0.3}
NOISE: dict[str, Any] = {"color": GREY, "linewidth": 1.0, "linestyle": (0, (4, 2))}

CHANNEL_TITLES = {
    "tension_N": "tension",
    "angle_rad": "angle",
    "reference_N": "tension outside",
    "current_A": "current",
}
BLOCK_COLOURS = (VERMILION, PURPLE, GREEN, BLUE)
SPLIT_LOOKS = {"fit": LIGHT, "rank": ORANGE, "report": BLUE}

_EXCERPT_samples = 1200
_BINS = 600
MOST_BARS = 14
"""Effects that a ranking draws; the rest are in its table."""
_COLUMNS = 3


def draw_gap(ax: Axes, d: Diagnosis) -> Axes:
    """The gap on the report split after each step, above the floor."""
    names = ["base fit" if s.effect is None else f"+ {s.effect}" for s in d.steps]
    gaps = [s.gap for s in d.steps]
    at = np.arange(len(gaps))
    floor = [s.floor for s in d.steps]
    ax.bar(at, gaps, width=0.5, color=[ORANGE, *[BLUE] * (len(gaps) - 1)], zorder=2)
    for x, gap, step in zip(at, gaps, d.steps, strict=True):
        said = f"{si(gap, d.written_unit)}\n{step.ratio:.3g} floors"
        ax.annotate(
            said, (x, gap), (0, 3), textcoords="offset points", ha="center", fontsize=8
        )  # fmt: skip
    ax.step([-0.5, *(at + 0.5)], [floor[0], *floor], where="pre", label="noise floor", **NOISE)
    ax.set_xticks(at, names)
    ax.set_xlim(-0.6, max(len(gaps), 2) - 0.4)
    ax.set_ylim(0.0, 1.3 * max([*gaps, *floor]))
    ax.yaxis.set_major_formatter(lambda value, _: digits(value))  # small ones without a factor
    finish(ax, f"gap rms, {d.written_unit}" if d.written_unit else "gap rms")
    ax.grid(visible=False, axis="x")
    legend(ax)
    return ax


def draw_trace(ax: Axes, trace: Trace, within: slice | None = None) -> Axes:
    """One channel of one record, measured and in free run before and after."""
    part = excerpt(trace) if within is None else within
    time = trace.time_s[part]
    ax.plot(time, trace.measured[part], label="measured", **MEASURED)
    ax.plot(time, trace.before[part], label="base model", **BEFORE)
    if changed(trace):
        ax.plot(time, trace.after[part], label="with the effects", **AFTER)
    ax.set_xlim(time[0], time[-1])
    finish(ax, f"{CHANNEL_TITLES[trace.channel]}, {trace.unit}", "time, s")
    legend(ax)
    return ax


def draw_error(ax: Axes, trace: Trace) -> Axes:
    """What the free run is wrong by over the whole record, before and after, as its envelope."""
    looks = [(trace.before, ORANGE, "base model")]
    looks += [(trace.after, BLUE, "with the effects")] * changed(trace)
    for predicted, colour, label in looks:
        time, low, high = _envelope(trace.time_s, trace.measured - predicted)
        ax.fill_between(time, low, high, color=colour, alpha=0.75, linewidth=0.5, label=label)
    part = excerpt(trace)
    ends = trace.time_s[part][0], trace.time_s[part][-1]
    ax.axvspan(*ends, color=LIGHT, alpha=0.6, linewidth=0, zorder=0)
    ax.set_xlim(trace.time_s[0], trace.time_s[-1])
    finish(ax, f"error, {trace.unit}", "time, s")
    return ax


def draw_spectrum(ax: Axes, d: Diagnosis, channel: str | None = None) -> Axes:
    """Amplitude density of the free run's error before and after, above that of the noise."""
    channel = channel or main_channel(d)
    traces = [t for t in d.traces if t.channel == channel]
    for which, look, label in (
        ("before", BEFORE, "base model"),
        ("after", AFTER, "with the effects"),
    ):
        if which == "before" or any(map(changed, traces)):
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
    finish(ax, f"{CHANNEL_TITLES[channel]} error, {unit}/√Hz", "frequency, Hz")
    legend(ax)
    return ax


def draw_ranking(ax: Axes, d: Diagnosis) -> Axes:
    """What each effect that was fitted leaves of the gap on the rank split, in floors."""
    fitted = [c for c in d.candidates if math.isfinite(c.gap)][:MOST_BARS]
    found = {e.name for e in d.effects} | set(d.ambiguous)
    at = np.arange(len(fitted))[::-1]
    colours = [BLUE if c.name in found else "#b8c4cc" for c in fitted]
    ax.barh(at, [c.gap for c in fitted], height=0.62, color=colours, zorder=2)
    for y, c in zip(at, fitted, strict=True):
        ax.annotate(
            f"{c.gap:.3g}", (c.gap, y), (4, 0), textcoords="offset points", va="center",
            fontsize=8,
        )  # fmt: skip
    ax.axvline(d.ratio_before, color=ORANGE, linewidth=1.2, label="base model")
    ax.axvline(1.0, label="noise floor", **NOISE)
    ax.set_yticks(at, [c.name for c in fitted])
    finish(ax, "", "gap left with this effect alone, in floors (rank split)")
    ax.grid(visible=False, axis="y")
    legend(ax, columns=2)
    return ax


def draw_shares(ax: Axes, d: Diagnosis) -> Axes:
    """What share of each block's residual goes with each variable."""
    names = list(dict.fromkeys(v.name for b in d.where.blocks for v in b.views))
    best = {n: max(v.share for b in d.where.blocks for v in b.views if v.name == n) for n in names}
    names.sort(key=lambda name: best[name])
    height = 0.8 / max(len(d.where.blocks), 1)
    for n, (block, colour) in enumerate(zip(d.where.blocks, BLOCK_COLOURS, strict=False)):
        shares = {view.name: view.share for view in block.views}
        at = np.arange(len(names)) + 0.4 - height * (n + 0.5)
        values = [100.0 * shares.get(name, 0.0) for name in names]
        label = f"{block.name}, {block.ratio:.3g} times noise"
        ax.barh(at, values, height=0.9 * height, color=colour, label=label, zorder=2)
    ax.set_yticks(np.arange(len(names)), names)
    ax.set_xlim(0.0, 100.0)
    finish(ax, "", "share of the residual that goes with it, %")
    ax.grid(visible=False, axis="y")
    # The bars are shortest below.
    ax.legend(loc="lower right", fontsize=8, frameon=False, handlelength=1.2)
    return ax


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


def draw_block_spectrum(ax: Axes, block: Block) -> Axes:
    """Where in frequency a block's residual lies, above that of the noise."""
    seen = block.frequency_Hz > 0.0
    frequency = block.frequency_Hz[seen]
    ax.plot(frequency, np.sqrt(block.power[seen]), color=VERMILION, linewidth=1.0)
    ax.plot(frequency, np.sqrt(block.noise_power[seen]), **NOISE)
    ax.set_xscale("log")
    ax.set_yscale("log")
    if block.low_Hz < block.high_Hz:
        ax.axvspan(block.low_Hz, block.high_Hz, color=LIGHT, alpha=0.6, linewidth=0, zorder=0)
    ax.set_title(f"frequency: {block.band}".rstrip(": "), fontsize=8, loc="left")
    finish(ax, f"residual, {block.unit}/√Hz", "Hz")
    return _small(ax)


def draw_distortion(ax: Axes, distortion: Distortion) -> Axes:
    """Lines of a multisine's response: those it excites, odd and even ones it does not."""
    looks = ((0, GREY, "D", "excited"), (1, VERMILION, "o", "odd"), (2, BLUE, "s", "even"))
    for kind, colour, marker, label in looks:
        lines = (distortion.kind == kind) & (distortion.amplitude > 0.0)
        level = 20.0 * np.log10(distortion.amplitude[lines])
        ax.plot(
            distortion.frequency_Hz[lines], level, marker, color=colour, markersize=3.0,
            markeredgewidth=0, label=label,
        )  # fmt: skip
    some = distortion.noise > 0.0
    noise = 20.0 * np.log10(distortion.noise[some])
    ax.plot(distortion.frequency_Hz[some], noise, label="noise", **NOISE)
    unit = distortion.channel.rpartition("_")[2]
    title = CHANNEL_TITLES[distortion.channel]
    finish(ax, f"{title}, dB above 1 {unit}", "frequency, Hz")
    legend(ax)
    return ax


def draw_splits(ax: Axes, d: Diagnosis) -> Axes:
    """What each stretch of the records was used for."""
    records = list(dict.fromkeys(part.record for part in d.splits))
    for part in d.splits:
        y = len(records) - 1 - records.index(part.record)
        width = part.end_s - part.start_s
        colour = SPLIT_LOOKS[part.split]
        ax.barh(y, width, left=part.start_s, height=0.7, color=colour, zorder=2, antialiased=False)
    ax.set_yticks(range(len(records)), records[::-1])
    finish(ax, "", "time in the record, s")
    ax.grid(visible=False, axis="y")
    ax.legend(
        handles=[Patch(color=colour, label=name) for name, colour in SPLIT_LOOKS.items()],
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, fontsize=8, frameon=False,
    )  # fmt: skip
    return ax


def draw_calibrations(ax: Axes, d: Diagnosis) -> Axes:
    """The base model's numbers relative to those given, fitted without and with the effects."""
    shown = scalable(d)
    at = np.arange(len(shown))[::-1]
    fits = [("base", ORANGE, "s", 0.13, "fitted alone")]
    fits += [("with_effects", BLUE, "o", -0.13, "fitted with the effects")] * bool(d.effects)
    for which, colour, marker, off, label in fits:
        found = [getattr(c, which) for c in shown]
        scaled = [
            (f.value / c.given, abs(f.value - f.low), abs(f.high - f.value), abs(c.given))
            for c, f in zip(shown, found, strict=True)
        ]
        value, low, high = np.array([(v, lo / g, hi / g) for v, lo, hi, g in scaled]).T
        bars = np.nan_to_num(np.array([low, high]))
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


def main_channel(d: Diagnosis) -> str:
    """The channel that the gap is told in, or the first there is."""
    channels = [trace.channel for trace in d.traces]
    wanted = "tension_N" if d.unit == "N" else "angle_rad"
    return wanted if wanted in channels else channels[0]


def changed(trace: Trace) -> bool:
    """Whether there is an after."""
    return not np.array_equal(trace.before, trace.after)


def most_telling(d: Diagnosis) -> Trace:
    """The record of the main channel in which the base model is worst."""
    traces = [trace for trace in d.traces if trace.channel == main_channel(d)]
    return max(traces, key=lambda t: float(np.nanmean((t.measured - t.before) ** 2)))


def excerpt(trace: Trace) -> slice:
    """The stretch in which the base model is worst, short enough that its curves can be read."""
    samples = trace.time_s.size
    if samples <= _EXCERPT_samples:
        return slice(0, samples)
    wrong = np.nan_to_num((trace.measured - trace.before) ** 2)
    power = np.cumsum(np.concatenate([[0.0], wrong]))
    start = int(np.argmax(power[_EXCERPT_samples:] - power[:-_EXCERPT_samples]))
    return slice(start, start + _EXCERPT_samples)


def error_density(traces: Iterable[Trace], which: str) -> tuple[FloatArray, FloatArray]:
    """Frequencies, Hz, and amplitude density of the error over all traces, Welch's mean."""
    from scipy.signal import welch  # noqa: PLC0415  slow to import

    errors = [(np.nan_to_num(t.measured - getattr(t, which)), _rate_Hz(t.time_s)) for t in traces]
    rate = errors[0][1]
    same = [error for error, hertz in errors if math.isclose(hertz, rate, rel_tol=1e-3)]
    window = min(1024, *(error.size for error in same))
    powers = [welch(error, rate, nperseg=window) for error in same]
    weights = [error.size for error in same]
    power = np.average([p for _, p in powers], axis=0, weights=weights)
    return powers[0][0], np.sqrt(np.maximum(power, 1e-300))


def _rate_Hz(time_s: FloatArray) -> float:
    return float((time_s.size - 1) / (time_s[-1] - time_s[0]))


def _envelope(time: FloatArray, signal: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Least and greatest value in each of a few hundred bins, so that a page stays small."""
    if time.size <= 2 * _BINS:
        return time, np.minimum(signal, 0.0), np.maximum(signal, 0.0)
    starts = np.linspace(0, time.size, _BINS, endpoint=False).astype(int)
    known = np.nan_to_num(signal)
    return time[starts], np.minimum.reduceat(known, starts), np.maximum.reduceat(known, starts)


def scalable(d: Diagnosis) -> tuple[BaseParameter, ...]:
    """The calibrations that can be told as a multiple of what was given."""
    return tuple(c for c in d.calibrations if math.isfinite(c.given) and c.given != 0.0)


def trace_of(d: Diagnosis, record: str | None) -> Trace:
    """A record of the report split by name, in the main channel if it has it.

    Raises:
        InvalidInput: there is no such record in the report split.
    """
    if record is None and d.traces:
        return most_telling(d)
    named = [trace for trace in d.traces if trace.name == record]
    if not named:
        names = ", ".join(dict.fromkeys(trace.name for trace in d.traces)) or "nothing"
        raise InvalidInput(f"the report split has no record {record}; it has {names}")
    return next((trace for trace in named if trace.channel == main_channel(d)), named[0])


def most_distorted(d: Diagnosis) -> dict[str, Distortion]:
    """For each channel the record that shows most distortion."""

    def shown(distortion: Distortion) -> float:
        return float(np.nanmax([distortion.even_dB, distortion.odd_dB, -np.inf]))

    ranked = sorted(d.where.distortion, key=shown)
    return {distortion.channel: distortion for distortion in ranked}


def block_figure(block: Block) -> Figure:
    """Where a block's residual lies: its spectrum, and its mean over each variable."""
    panels = 1 + len(block.views)
    rows = -(-panels // _COLUMNS)
    figure = new_figure(WIDTH_in, 1.75 * rows)
    axes = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    draw_block_spectrum(axes[0], block)
    for ax, view in zip(axes[1:], sorted(block.views, key=lambda v: -v.share), strict=False):
        draw_view(ax, block, view)
    for ax in axes[panels:]:
        ax.set_visible(False)
    return figure


def overview(d: Diagnosis) -> Figure:
    """Before and after, the gap step by step, and where it lives."""
    figure = new_figure(WIDTH_in, 6.4)
    grid = figure.add_gridspec(2, 2)
    if d.traces:
        draw_trace(figure.add_subplot(grid[0, :]), most_telling(d))
    draw_gap(figure.add_subplot(grid[1, 0] if d.where.blocks else grid[1, :]), d)
    if d.where.blocks:
        draw_shares(figure.add_subplot(grid[1, 1]), d)
    return figure
