"""Bode and Nyquist figures of the loop of a run, before and after."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from estune.core.gains import Gains
from estune.core.margins import controller_response
from estune.core.pidf import ControllerSettings
from estune.core.quantities import ComplexArray, FloatArray
from estune.interop import sampled_model
from estune.loop_model.claim import Claim
from estune.loop_model.drawn_models import drawn_models, white_factor
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.margins import frequency_response
from estune.support.html_page import Drawing
from estune.support.plot_style import (
    BLUE,
    GREY,
    LIGHT,
    ORANGE,
    ShownAxes,
    figure_of,
    finish,
    legend,
    new_figure,
)
from estune.trial import RigDescription

DRAWS = 200
"""Models drawn from the fit's covariance; 95 % of them lie within the band."""
SHOWN = 15
"""Of these in the Nyquist figure."""

_POINTS = 300
_SETTLINGS = 20.0
"""Settling times in the period of the lowest frequency shown."""
_NYQUIST_MAX = 3.0
"""Loop gain at which a Nyquist curve begins."""


@dataclass(frozen=True, eq=False)
class PlantResponse:
    """Frequency response of a plant, shape (frequencies,).

    Attributes:
        plant: G.
        draws: G of models drawn from the covariance of the fit, shape (draws, frequencies);
            none for a model of unknown accuracy.
    """

    frequency_Hz: FloatArray
    plant: ComplexArray
    draws: ComplexArray

    @classmethod
    def of_fit(
        cls, fit: LoopFit, settings: ControllerSettings, settling_time_s: float
    ) -> "PlantResponse":
        """The loop identified from records."""
        frequency, theta = _grid(settings.sampling_Hz, settling_time_s)
        # A fixed seed: the same run gives the same page.
        models = drawn_models(fit, white_factor(fit), DRAWS, seed=0)
        drawn = [frequency_response(model, theta) for model in models]
        return cls(frequency, frequency_response(fit.model, theta), np.array(drawn))

    @classmethod
    def of_loop(
        cls, claim: Claim, fit: LoopFit | None, rig: RigDescription
    ) -> "PlantResponse | None":
        """The identified loop where its margins are claimed, else the rig's model; or None."""
        if claim.margins is not None and fit is not None:
            return cls.of_fit(fit, rig.controller, rig.settling_time_s)
        return cls.of_rig(rig)

    @classmethod
    def of_rig(cls, rig: RigDescription) -> "PlantResponse | None":
        """The rig's own linear model; None without one."""
        if rig.linear_model is None:
            return None
        frequency, theta = _grid(rig.controller.sampling_Hz, rig.settling_time_s)
        plant = sampled_model(rig.linear_model, rig.controller).response(theta)
        return cls(frequency, plant, np.empty((0, frequency.size), complex))


Loop = tuple[str, Gains]
"""Label and gains of a curve."""

_LOOKS: tuple[dict[str, Any], ...] = (
    {"color": ORANGE, "linestyle": (0, (5, 1.2)), "linewidth": 1.2},
    {"color": BLUE, "linestyle": "-", "linewidth": 1.4},
)


_THIN = {"linewidth": 0.7}
"""Phases on the axes of the gains."""


def loop_drawings(
    response: PlantResponse,
    settings: ControllerSettings,
    loops: Sequence[Loop],
    sensitivity_limit: float,
    csv: str = "",
) -> Iterator[Drawing]:
    """Both figures for a page; `csv` is offered with the first."""
    yield Drawing(
        figure_of(draw_bode(response, settings, loops)),
        "bode",
        "Magnitude and phase of the loop gain over frequency",
        "Bode diagram. The phase margin is read where |L| = 1, the gain margin at -180 degrees.",
        csv=csv,
    )
    yield Drawing(
        figure_of(draw_nyquist(response, settings, loops, sensitivity_limit)),
        "nyquist",
        "Loop gain in the complex plane",
        "Nyquist diagram with the unit circle. A curve that stays outside the grey disc about -1 "
        f"has a sensitivity below {sensitivity_limit:g}.",
    )


def draw_bode(
    response: PlantResponse,
    settings: ControllerSettings,
    loops: Sequence[Loop],
    ax: Axes | None = None,
) -> Axes:
    """Magnitude and phase of the loop gain L for each gains; the band is of the last.

    On one axes the phase has its scale at the right.
    """
    if ax is None:
        kind = {"axes_class": ShownAxes}
        upper, lower = new_figure(7.2, 4.2).subplots(2, 1, sharex=True, subplot_kw=kind)
    else:
        upper, lower = ax, ax.twinx()
    for (label, gains), look in zip(loops, _looks(loops), strict=True):
        controller = _controller(response, settings, gains)
        loop = controller * response.plant
        if gains is loops[-1][1] and len(response.draws):
            drawn = controller * response.draws
            _band(upper, response, np.abs(drawn), look["color"])
            # Angles relative to the estimate's, so that no draw is a turn away.
            turned = np.unwrap(np.angle(loop)) + np.angle(drawn / loop)
            _band(lower, response, np.degrees(turned), look["color"])
        upper.plot(response.frequency_Hz, np.abs(loop), label=label, **look)
        phase = np.degrees(np.unwrap(np.angle(loop)))
        lower.plot(response.frequency_Hz, phase, **look | ({} if ax is None else _THIN))
    upper.axhline(1.0, color=GREY, linewidth=0.8)
    lower.axhline(-180.0, color=GREY, linewidth=0.8)
    upper.set_xscale("log")
    upper.set_yscale("log")
    upper.set_ylim(max(upper.get_ylim()[0], 1e-3), upper.get_ylim()[1])
    lower.set_ylim(max(lower.get_ylim()[0], -540.0), lower.get_ylim()[1])
    finish(upper, "loop gain |L|", "" if ax is None else "frequency, Hz")
    thin = "" if ax is None else " (thin)"
    finish(lower, f"phase of L{thin}, degrees", "frequency, Hz")
    legend(upper)
    shown: Axes = upper
    return shown


def draw_nyquist(
    response: PlantResponse,
    settings: ControllerSettings,
    loops: Sequence[Loop],
    limit: float,
    ax: Axes | None = None,
) -> Axes:
    """The loop gain in the complex plane, the unit circle, and the circle of a sensitivity."""
    ax = ax or new_figure(7.2, 4.2).add_subplot(axes_class=ShownAxes)
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    ax.plot(np.cos(angle), np.sin(angle), color=GREY, linewidth=0.7)
    circle = -1.0 + np.exp(1j * angle) / limit
    ax.fill(circle.real, circle.imag, color=LIGHT, label=f"sensitivity above {limit:g}")
    ax.plot(-1.0, 0.0, "+", color=GREY, markersize=9)
    for (label, gains), look in zip(loops, _looks(loops), strict=True):
        loop = _controller(response, settings, gains) * response.plant
        if gains is loops[-1][1]:
            for one in _controller(response, settings, gains) * response.draws[:SHOWN]:
                shown = one[np.abs(one) < _NYQUIST_MAX]
                ax.plot(shown.real, shown.imag, color=look["color"], linewidth=0.5, alpha=0.25)
        shown = loop[np.abs(loop) < _NYQUIST_MAX]
        ax.plot(shown.real, shown.imag, label=label, **look)
    ax.set_aspect("equal")
    ax.set_xlim(-2.2, 1.2)
    ax.set_ylim(-1.6, 1.1)
    finish(ax, "imaginary part of L", "real part of L")
    legend(ax)
    return ax


def response_columns(
    response: PlantResponse, settings: ControllerSettings, loops: Sequence[Loop]
) -> dict[str, FloatArray]:
    """The numbers of both figures by column."""
    columns = {"frequency_Hz": response.frequency_Hz}
    for label, gains in loops:
        loop = _controller(response, settings, gains) * response.plant
        name = label.split()[0]
        columns |= {f"{name}_L_real": loop.real, f"{name}_L_imaginary": loop.imag}
    return columns


def _looks(loops: Sequence[Loop]) -> tuple[dict[str, Any], ...]:
    return _LOOKS[: len(loops)]


def _controller(
    response: PlantResponse, settings: ControllerSettings, gains: Gains
) -> ComplexArray:
    theta = 2.0 * np.pi * response.frequency_Hz / settings.sampling_Hz
    return controller_response(gains, settings, theta)


def _grid(rate: float, settling_time_s: float) -> tuple[FloatArray, FloatArray]:
    lowest = min(1.0 / (_SETTLINGS * settling_time_s), 0.05 * rate)
    frequency = np.geomspace(lowest, 0.499 * rate, _POINTS)
    return frequency, 2.0 * np.pi * frequency / rate


def _band(ax: Axes, response: PlantResponse, values: FloatArray, color: str) -> None:
    low, high = np.quantile(values, (0.025, 0.975), axis=0)
    ax.fill_between(response.frequency_Hz, low, high, color=color, alpha=0.25, linewidth=0.0)
