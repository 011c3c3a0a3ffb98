"""Extremum seeking as the paper has it (section V-C): [39] adapted to a real, noisy reel.

What it adds to Killingsworth & Krstic: the logarithm of each parameter in place of the parameter,
the setpoint filter's time constant as a fourth parameter, and a low-pass filter after the
demodulation beside the high-pass (washout) before it; see `demodulated`. Like [39] it demodulates
by the dither itself, phi_i = 0 and W_i = 1, as if the washout led by nothing: the slope is read at
cos(lead) times the washout's gain of its size, differently for each parameter.

The paper prints no numbers for the settings and none for the frequencies. It normalises the cost
by the first-order reference in (35), which does not stop a bad start from making the first steps a
hundred times the last ones; here the cost is normalised by its logarithm as well.
"""

from dataclasses import dataclass
from typing import Literal

from estune.tuners.dither import dither
from estune.tuners.extremum_seeking import DemodulationSignal, ExtremumSeeking


@dataclass(frozen=True, slots=True)
class Otis(ExtremumSeeking):
    """The paper's tuner; its settings are those of `ExtremumSeeking`."""

    name: Literal["otis"] = "otis"

    def carriers(self) -> tuple[DemodulationSignal, ...]:
        """The dither itself."""
        frequencies = dither(len(self.space.names)).frequencies
        return tuple([DemodulationSignal(w, 1.0, 0.0) for w in frequencies])
