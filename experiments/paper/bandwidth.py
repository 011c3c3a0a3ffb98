"""The measured bandwidth of the reel at four lengths or tensions, for Figs. 9 to 11."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter
from scipy.stats import linregress

from estune.core.quantities import FloatArray
from estune.support.plot_style import FOUR, finish, legend, stacked
from experiments.identification import excitation
from experiments.paper import PaperFigure
from plants.cable import string_frequency_Hz
from plants.identify import (
    FrequencyResponse,
    SecondOrderFit,
    fit_second_order,
    open_loop_record,
    response_of_record,
)
from plants.models.reel import Reel


class Bandwidth(NamedTuple):
    """One reel identified from ten seconds of its noisy record."""

    reel: Reel
    response: FrequencyResponse
    fit: SecondOrderFit


class Power(NamedTuple):
    """The power p of a dependence y ~ x^p, by least squares on logarithms, and its error."""

    value: float
    standard_error: float

    @property
    def rounded(self) -> str:
        """The value alone."""
        return f"{self.value:.2g}"

    def __str__(self) -> str:
        return f"{self.rounded} ± {self.standard_error:.1g}"


def measure(reels: list[Reel]) -> list[Bandwidth]:
    """Excites each reel by a multisine about its preload and fits the second-order model."""
    signal, found = excitation(), []
    for seed, reel in enumerate(reels):
        response = response_of_record(open_loop_record(reel, signal, seed), signal)
        found.append(Bandwidth(reel, response, fit_second_order(response)))
    return found


def power(x: list[float], y: list[float]) -> Power:
    """The power of the dependence of y on x."""
    line = linregress(np.log(x), np.log(y))
    return Power(float(line.slope), float(line.stderr))


def string_Hz(reel: Reel) -> float:
    """Where the cable of the reel would sound as a string, (31)."""
    place = reel.cable_density_kg_m, reel.cable_length_m, reel.tension_N
    return float(string_frequency_Hz(*place))


def draw(found: Mapping[str, Bandwidth]) -> Figure:
    """Magnitude and phase: the 95 % band of the measurement, and the fitted model.

    Args:
        found: By the name each has in the legend.
    """
    figure, (size, phase) = stacked(2, 4.6)
    for (name, (reel, response, fit)), look in zip(found.items(), FOUR, strict=False):
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
    found = measure([Reel(length_m, tension) for tension in tensions_N])
    peaks = [each.fit.resonance_Hz.value for each in found]
    shift = power(list(tensions_N), peaks)
    string = power(list(tensions_N), [string_Hz(each.reel) for each in found])
    return PaperFigure(
        number=number,
        title=f"Bandwidth of the reel for a cable length of {length_m:g} m and four tensions",
        claim="The reel does not respond as a string instrument: the cable's tension does not "
        "significantly affect its bandwidth.",
        holds=abs(shift.value) < 0.5 * string.value,
        measured=f"From {tensions_N[0]:g} to {tensions_N[-1]:g} N the resonance goes from "
        f"{peaks[0]:.2f} to {peaks[-1]:.2f} Hz, as the tension to the power {shift}; that of a "
        f"string (31) goes as its power {string.rounded}.",
        rule="The power of the tension is nearer to none than to the string's.",
        caveat="The reference reel's stiffness is that of its structure in series with EA/L, the "
        "latter lowered by what sag there is; so this shows that ten seconds of noisy data bring "
        "out what was built in, and how little sag is left at these tensions.",
        numbers={
            "power_of_tension": shift.value,
            "power_of_a_string": string.value,
            "resonance_low_Hz": peaks[0],
            "resonance_high_Hz": peaks[-1],
        },
        figure=draw({f"{each.reel.tension_N:g} N": each for each in found}),
    )
