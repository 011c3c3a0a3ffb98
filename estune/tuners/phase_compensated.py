"""Extremum seeking that makes up for what its washout filter does to the dither.

The law is `demodulated`, with the phase lead and the gain of the washout (z - 1)/(z + h) at w_i
for phi_i and W_i, so that the slope of every parameter is read at its full size. The published
laws, `killingsworth` and `otis`, leave this out.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from estune.tuners.dither import dither
from estune.tuners.extremum_seeking import DemodulationSignal, ExtremumSeeking
from estune.tuners.filters import washout_response


@dataclass(frozen=True, slots=True)
class PhaseCompensated(ExtremumSeeking):
    """The paper's tuner with compensated demodulation; settings are those of `ExtremumSeeking`."""

    name: Literal["phase_compensated"] = "phase_compensated"

    def carriers(self) -> tuple[DemodulationSignal, ...]:
        """The dither as the washout leaves it."""
        return _washed_dither(len(self.space.names), self.washout_h)


@lru_cache(maxsize=64)
def _washed_dither(parameters: int, h: float) -> tuple[DemodulationSignal, ...]:
    return tuple(
        [DemodulationSignal(w, *washout_response(h, w)) for w in dither(parameters).frequencies]
    )
