"""Why a cause was told, in three pictures: time, output against measurement, spectrum."""

import math
from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes

from estune.core.quantities import FloatArray
from estune.service_records.cause import margins
from estune.service_records.cause.evidence import CauseEvidence
from estune.service_records.cause.judge import Cause
from estune.service_records.cause.loop_signals import swings
from estune.service_records.cause.valve import positions
from estune.support.html_page import Block, Drawing, Page, Section, Status
from estune.support.plot_style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    finish,
    legend,
    new_figure,
    stacked,
)

_SIGNS = {
    "tuning": "A loop that is too tight swings at its own period, the dashed line, "
    "where the spectrum of the disturbance has none.",
    "sticking": "An actuator that sticks lets the measurement rest while the output travels; the "
    "curve has corners.",
    "outside": "A wave from outside is a line of both spectra, beside the loop's own period.",
    "sensor": "Readings that no plant can give show in time.",
    "none": "Nothing repeats, and the measurement follows the output.",
    "unknown": "No shape is clear.",
}


DRAWN = 16
"""Swings that are drawn: of ninety no shape is seen."""

LEAST = 1e-5
"""Least share of the variance that is drawn; below is noise, which would take half of the axis."""


def page(cause: Cause) -> Page:
    """The page of a cause by itself, where no gains are known."""
    status = Status(cause.heading(), good=True if cause.name == "none" else None)
    return Page("Tuning or machine", status, (), sections(cause))


def sections(cause: Cause | None) -> tuple[Section, ...]:
    """The section of a cause; none where no signals were judged."""
    if cause is None or cause.shown is None:
        return ()
    return (Section("Tuning or machine", tuple(_pictures(cause, cause.shown))),)


def _pictures(cause: Cause, shown: CauseEvidence) -> Iterator[Block]:
    figure, panels = stacked(2, 4.4)
    draw_time(cause, shown, *panels)
    yield Drawing(
        figure, "cause-time", "Setpoint, measurement and output over time", f"{cause.heading()}"
    )
    figure = new_figure(7.2, 3.4)
    draw_plane(cause, shown, figure.add_subplot())
    yield Drawing(
        figure, "cause-plane", "Measurement over output as one curve", _SIGNS[cause.name]
    )
    figure = new_figure(7.2, 2.8)
    draw_spectrum(shown, figure.add_subplot())
    yield Drawing(
        figure,
        "cause-spectrum",
        "Share of the variance of error and disturbance over the period",
        "The disturbance is what a linear plant behind the output leaves of the measurement; the "
        "dashed line is the period at which the loop by itself is most sensitive.",
    )


def draw_time(cause: Cause, shown: CauseEvidence, above: Axes, below: Axes) -> None:
    """Setpoint and measurement over time, and below the output, of some swings."""
    signals, rows = shown.signals, _rows(cause, shown)
    time_s = (np.arange(signals.samples) * signals.interval_s)[rows]
    above.plot(time_s, signals.measurement[rows], color=BLUE, lw=0.8, label="measurement")
    above.plot(time_s, signals.setpoint[rows], color=GREY, lw=1.0, label="setpoint")
    below.plot(time_s, signals.output[rows], color=ORANGE, lw=0.8, label="output")
    valve = shown.predicted.sticking.valve
    if cause.name == "sticking" and valve is not None:
        at = positions(signals.output, [valve])[rows, 0]
        below.plot(time_s, at, color=GREY, lw=1.0, label="actuator, as identified")
        legend(below)
    finish(above, "measurement")
    finish(below, "output", "time, s")
    legend(above)


def draw_plane(cause: Cause, shown: CauseEvidence, ax: Axes) -> None:
    """Measurement over output as one curve, of some swings."""
    rows = _rows(cause, shown)
    ax.plot(shown.signals.output[rows], shown.signals.measurement[rows], color=BLUE, lw=0.6)
    finish(ax, "measurement", "output")


def _rows(cause: Cause, shown: CauseEvidence) -> slice:
    """The last `DRAWN` swings of a loop whose swings have a shape; the whole log of another."""
    found = swings(shown.signals.output) if cause.name in ("tuning", "sticking", "outside") else []
    return slice(found[-DRAWN].start if len(found) > DRAWN else 0, None)


def draw_spectrum(shown: CauseEvidence, ax: Axes) -> None:
    """Share of the variance of error and disturbance over the period."""
    signals, interval_s = shown.signals, shown.signals.interval_s
    for x, color, label in (
        (signals.error, BLUE, "error"),
        (shown.predicted.left, GREEN, "disturbance"),
    ):
        periods, power = _spectrum(x, interval_s)
        ax.loglog(periods, power, color=color, lw=0.8, label=label)
    own_s = 2.0 * math.pi * interval_s / margins.peak(shown.predicted.linear, shown.controller)
    ax.axvline(own_s, color=GREY, lw=0.8, ls="--")
    finish(ax, "share of variance", "period, s")
    legend(ax)


def _spectrum(x: FloatArray, interval_s: float) -> tuple[FloatArray, FloatArray]:
    power = np.abs(np.fft.rfft((x - x.mean()) * np.hanning(x.size))) ** 2
    periods = x.size * interval_s / np.arange(1, power.size)
    return periods, np.maximum(power[1:] / (power.sum() + 1e-300), LEAST)
