"""Why a cause was told, in three pictures: time, output against measurement, spectrum."""

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes

from estune.core.quantities import FloatArray
from estune.service_records.cause.judge import Cause
from estune.service_records.cause.loop_signals import JudgedSignals
from estune.support.html_page import Block, Drawing, Page, Section, Status
from estune.support.plot_style import BLUE, GREY, ORANGE, finish, legend, new_figure, stacked

_SIGNS = {
    "tuning": "A loop that is too tight swings by sines in both; the curve is an ellipse.",
    "sticking": "An actuator that sticks lets the measurement rest while the output travels; the "
    "curve has corners.",
    "outside": "A wave from outside is a line of the spectrum, where the loop by itself has none.",
    "sensor": "Readings that no plant can give show in time.",
    "none": "Nothing repeats, and the measurement follows the output.",
    "unknown": "No shape is clear.",
}


def page(cause: Cause) -> Page:
    """The page of a cause by itself, where no gains are known."""
    status = Status(cause.heading(), good=True if cause.name == "none" else None)
    return Page("Tuning or machine", status, (), sections(cause))


def sections(cause: Cause | None) -> tuple[Section, ...]:
    """The section of a cause; none where no signals were judged."""
    if cause is None or cause.signals is None:
        return ()
    return (Section("Tuning or machine", tuple(_pictures(cause, cause.signals))),)


def _pictures(cause: Cause, signals: JudgedSignals) -> Iterator[Block]:
    figure, panels = stacked(2, 4.4)
    draw_time(signals, *panels)
    yield Drawing(
        figure, "cause-time", "Setpoint, measurement and output over time", f"{cause.heading()}"
    )
    figure = new_figure(7.2, 3.4)
    draw_plane(signals, figure.add_subplot())
    yield Drawing(
        figure, "cause-plane", "Measurement over output as one curve", _SIGNS[cause.name]
    )
    figure = new_figure(7.2, 2.8)
    draw_spectrum(cause, signals, figure.add_subplot())
    yield Drawing(
        figure,
        "cause-spectrum",
        "Share of the variance of error and disturbance over the period",
        "The disturbance is what a linear plant behind the output leaves of the measurement.",
    )


def draw_time(signals: JudgedSignals, above: Axes, below: Axes) -> None:
    """Setpoint and measurement over time, and the output below."""
    time_s = np.arange(signals.samples) * signals.interval_s
    above.plot(time_s, signals.setpoint, color=GREY, lw=1.0, label="setpoint")
    above.plot(time_s, signals.measurement, color=BLUE, lw=0.8, label="measurement")
    below.plot(time_s, signals.output, color=ORANGE, lw=0.8)
    finish(above, "measurement")
    finish(below, "output", "time, s")
    legend(above)


def draw_plane(signals: JudgedSignals, ax: Axes) -> None:
    """Measurement over output as one curve."""
    ax.plot(signals.output, signals.measurement, color=BLUE, lw=0.6)
    finish(ax, "measurement", "output")


def draw_spectrum(cause: Cause, signals: JudgedSignals, ax: Axes) -> None:
    """Share of the variance of error and disturbance over the period."""
    left = cause.disturbance if cause.disturbance is not None else signals.error
    for x, color, label in ((signals.error, BLUE, "error"), (left, ORANGE, "disturbance")):
        periods, power = _spectrum(x, signals.interval_s)
        ax.loglog(periods, power, color=color, lw=0.8, label=label)
    finish(ax, "share of variance", "period, s")
    legend(ax)


def _spectrum(x: FloatArray, interval_s: float) -> tuple[FloatArray, FloatArray]:
    power = np.abs(np.fft.rfft((x - x.mean()) * np.hanning(x.size))) ** 2
    periods = x.size * interval_s / np.arange(1, power.size)
    return periods, np.maximum(power[1:] / (power.sum() + 1e-300), 1e-9)
