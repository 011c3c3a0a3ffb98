"""Figs. 9 to 11: the bandwidth of the reel at four lengths or tensions."""

from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter
from scipy.stats import linregress

from estune.core.quantities import FloatArray
from estune.support.plot_style import finish, legend, stacked
from experiments.paper import PaperFigure
from experiments.paper.cable import string_frequency_Hz
from experiments.paper.curves import FOUR
from experiments.paper.identify import (
    FrequencyResponse,
    SecondOrderFit,
    fit_second_order,
    open_loop_record,
    response_of_record,
)
from experiments.paper.identify.conditions import TENSIONS_N, LENGTHS_m, excitation
from plants.models.reel import Reel

TENSION_N = 15.0


class Bandwidth(NamedTuple):
    """A reel identified from a noisy record of ten seconds."""

    reel: Reel
    response: FrequencyResponse
    fit: SecondOrderFit


class Power(NamedTuple):
    """The power p of a dependence y ~ x^p, by least squares on logarithms, and its error."""

    value: float
    standard_error: float

    @property
    def rounded(self) -> str:
        """The value without its error."""
        return f"{self.value:.2g}"

    def __str__(self) -> str:
        return f"{self.rounded} ± {self.standard_error:.1g}"


def measure(reels: list[Reel]) -> list[Bandwidth]:
    """Fits the second-order model to each reel's response to a multisine about its preload."""
    signal, bandwidths = excitation(), []
    for seed, reel in enumerate(reels):
        response = response_of_record(open_loop_record(reel, signal, seed), signal)
        bandwidths.append(Bandwidth(reel, response, fit_second_order(response)))
    return bandwidths


def power(x: list[float], y: list[float]) -> Power:
    """The power of the dependence of y on x."""
    line = linregress(np.log(x), np.log(y))
    return Power(float(line.slope), float(line.stderr))


def string_Hz(reel: Reel) -> float:
    """Frequency of the reel's cable as a string, (31)."""
    place = reel.cable_density_kg_m, reel.cable_length_m, reel.tension_N
    return float(string_frequency_Hz(*place))


def _draw(bandwidths: Mapping[str, Bandwidth]) -> Figure:
    """Magnitude and phase: 95 % band of the measurement, and the fitted model, by label."""
    figure, (size, phase) = stacked(2, 4.6)
    for (name, (reel, response, fit)), look in zip(bandwidths.items(), FOUR, strict=False):
        f, scale = response.frequency_Hz, reel.newtons_per_ampere
        low, high = response.magnitude_band()
        size.fill_between(
            f, low / scale, high / scale, color=look["color"], alpha=0.25, linewidth=0.0
        )
        early, late = response.phase_band_deg()
        phase.fill_between(f, early, late, color=look["color"], alpha=0.25, linewidth=0.0)
        dense: FloatArray = np.geomspace(f[0], f[-1], 600)
        model = fit.model.sampled_response(dense, response.sampling_Hz)
        size.plot(dense, np.abs(model) / scale, label=name, **look)
        phase.plot(dense, np.degrees(np.unwrap(np.angle(model))), **look)
    size.set(xscale="log", yscale="log", xlim=(f[0], f[-1]))
    size.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    finish(size, "tension per command, N/N")
    finish(phase, "phase, degrees", "frequency, Hz")
    legend(size)
    return figure


def of_tension(number: int, length_m: float, tensions_N: tuple[float, ...]) -> PaperFigure:
    """Figs. 10 and 11: the bandwidth at one length and four tensions."""
    bandwidths = measure([Reel(length_m, tension) for tension in tensions_N])
    peaks = [each.fit.resonance_Hz.value for each in bandwidths]
    shift = power(list(tensions_N), peaks)
    string = power(list(tensions_N), [string_Hz(each.reel) for each in bandwidths])
    return PaperFigure(
        number=number,
        title=f"Bandwidth of the reel for a cable length of {length_m:g} m and four tensions",
        claim="The reel does not respond as a string instrument: the cable's tension does not "
        "significantly affect its bandwidth.",
        holds=abs(shift.value) < 0.5 * string.value,
        measured=f"From {tensions_N[0]:g} to {tensions_N[-1]:g} N the resonance changes from "
        f"{peaks[0]:.2f} to {peaks[-1]:.2f} Hz, as the tension to the power {shift}; that of a "
        f"string (31) changes as its power {string.rounded}.",
        rule="The power of the tension is nearer to zero than to the string's.",
        caveat="The reference reel's stiffness is that of its structure in series with EA/L, the "
        "latter lowered by sag. So this shows that ten seconds of noisy data recover the model, "
        "and how little sag remains at these tensions.",
        numbers={
            "power_of_tension": shift.value,
            "power_of_a_string": string.value,
            "resonance_low_Hz": peaks[0],
            "resonance_high_Hz": peaks[-1],
        },
        figure=_draw({f"{each.reel.tension_N:g} N": each for each in bandwidths}),
    )


def figure_9(*, quick: bool = False) -> PaperFigure:  # noqa: ARG001  one record each suffices
    """Fig. 9: the bandwidth at one tension and four lengths."""
    bandwidths = measure([Reel(length, TENSION_N) for length in LENGTHS_m])
    damping = [each.fit.damping for each in bandwidths]
    peaks = [each.fit.resonance_Hz.value for each in bandwidths]
    growth = power(list(LENGTHS_m), [each.value for each in damping])
    shift = power(list(LENGTHS_m), peaks)
    string = power(list(LENGTHS_m), [string_Hz(each.reel) for each in bandwidths])
    increases = all(b.low > a.high for a, b in pairwise(damping))
    gauges = [each.fit.gauge_Hz.value for each in bandwidths if each.fit.gauge_Hz is not None]
    return PaperFigure(
        number=9,
        title="Bandwidth of the reel for a constant tension and four cable lengths",
        claim="The reel does not exactly respond as a string instrument, and the cable's length "
        "has a proportional influence on the damping.",
        holds=increases and growth.value > 0.5 and abs(shift.value) < abs(string.value),
        measured=f"From {LENGTHS_m[0]:g} to {LENGTHS_m[-1]:g} m the damping ratio rises from "
        f"{damping[0].value:.4f} to {damping[-1].value:.4f}, as the length to the power {growth}; "
        f"the resonance falls from {peaks[0]:.1f} to {peaks[-1]:.1f} Hz, power {shift}, where a "
        f"string's (31) has {string.rounded}. The gauge's own peak is at "
        f"{sum(gauges) / len(gauges):.1f} Hz, near half the sampling rate, "
        f"{0.5 * bandwidths[0].reel.sampling_Hz:g} Hz, as the paper sees it.",
        rule="Damping rises from each length to the next by more than its 95 % intervals, its "
        "power of the length is nearer to one (proportional) than to zero, and the resonance "
        "depends on the length less than a string's.",
        caveat="Friction that grows with the length is built into the reference reel, which takes "
        "it from this figure. This shows that it can be measured, and that it makes the damping "
        "nearly proportional. The paper derives it from (31), which contains no damping.",
        numbers={
            "power_of_damping": growth.value,
            "power_of_resonance": shift.value,
            "power_of_a_string": string.value,
            "damping_short": damping[0].value,
            "damping_long": damping[-1].value,
        },
        figure=_draw({f"{each.reel.cable_length_m:g} m": each for each in bandwidths}),
    )


def figure_10(*, quick: bool = False) -> PaperFigure:  # noqa: ARG001  one record each suffices
    """Fig. 10: the bandwidth at 0.5 m and four tensions."""
    return of_tension(10, 0.5, TENSIONS_N)


def figure_11(*, quick: bool = False) -> PaperFigure:  # noqa: ARG001  one record each suffices
    """Fig. 11: the bandwidth at 1.4 m and four tensions."""
    return of_tension(11, 1.4, TENSIONS_N)
