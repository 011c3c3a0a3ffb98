"""Even and odd distortion on the lines that a periodic excitation does not excite.

A linear plant answers on the excited lines alone. With odd lines excited, an even law (a square,
slack) answers on the even ones and an odd law (friction, saturation, a cube) on the odd ones
(Pintelon & Schoukens, System Identification, 2nd ed., chapter 4).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise import step_of
from plants.diagnosis.data.periods import Periods, periods_of

EXCITED = 3e-3
"""Amplitude of a line, as a share of the greatest, from which it is meant to be excited."""
ODD = 0.98
"""Share of the power that must lie on odd lines for even ones to show distortion."""
FEWEST_LINES = 2
"""Fewest free lines for a figure."""
CHANNELS = ("tension_N", "angle_rad")


@dataclass(frozen=True, slots=True, eq=False)
class Distortion:
    """Power of a periodic record on the lines it does not excite.

    Attributes:
        source: The record.
        channel: The channel.
        even_dB: Power of the even free lines over the noise, dB; 0 is noise alone.
        odd_dB: That of the odd ones; nan where every odd line is excited.
        frequency_Hz: Of the lines, shape (lines,).
        amplitude: On each line, in the channel's unit, same shape.
        kind: 0 excited, 1 odd, 2 even, for each line.
        noise: Amplitude of noise alone on each line, same shape.
    """

    source: str
    channel: str
    even_dB: float
    odd_dB: float
    frequency_Hz: FloatArray
    amplitude: FloatArray
    kind: NDArray[np.int64]
    noise: FloatArray

    def to_json(self) -> dict[str, Any]:
        """JSON values, without the arrays."""
        odd_dB = None if np.isnan(self.odd_dB) else self.odd_dB
        named = {"source": self.source, "channel": self.channel}
        return named | {"even_dB": self.even_dB, "odd_dB": odd_dB}


def distortions(measurements: Sequence[MeasuredRecord]) -> tuple[Distortion, ...]:
    """One entry for each channel of each record with an excitation that repeats on odd lines."""
    return tuple(distortion for m in measurements for distortion in _of(m))


def _of(m: MeasuredRecord) -> Iterator[Distortion]:
    periods = None if m.setpoint_N is None else periods_of(m.setpoint_N)
    if periods is None or m.setpoint_N is None:
        return
    kind = _kinds(periods.fold(m.setpoint_N)[0])
    if kind is not None:
        for channel in CHANNELS:
            if channel in m.outputs:
                yield _distortion(m, channel, periods, kind)


def _kinds(period: FloatArray) -> NDArray[np.int64] | None:
    """Kind of each line from the first to the highest excited one, or None if even ones are."""
    size = np.abs(np.fft.rfft(period))
    size[0] = 0.0
    excited = np.flatnonzero(size > EXCITED * size.max())
    power = size**2
    if power[1::2].sum() < ODD * power.sum() or np.any(excited % 2 == 0):
        return None
    lines = np.arange(1, excited.max() + 1)
    kind = np.where(lines % 2 == 0, 2, 1)
    kind[excited - 1] = 0
    return kind


def _drift_free(periods: Periods, column: FloatArray) -> FloatArray:
    """The column period by period, without the straight line through the periods' means."""
    folded = periods.fold(column)
    count, samples = folded.shape
    if count < 2:
        return folded
    slope = np.polyfit(np.arange(count), folded.mean(axis=1), 1)[0]
    t = np.arange(count * samples).reshape(count, samples) / samples
    return np.asarray(folded - slope * t)


def _distortion(
    m: MeasuredRecord, channel: str, periods: Periods, kind: NDArray[np.int64]
) -> Distortion:
    column = np.asarray(m.channel(channel))
    folded = _drift_free(periods, column)
    count, samples = folded.shape
    spectra = 2.0 * np.fft.rfft(folded, axis=1)[:, 1 : kind.size + 1] / samples
    mean = spectra.mean(axis=0)
    deviation = np.abs(spectra - mean) ** 2
    # Of the mean over the periods; rounding repeats in each and does not average out.
    rounding = 4.0 * step_of(column) ** 2 / 12.0 / samples
    noise = np.maximum(deviation.sum(axis=0) / ((count - 1) * count), rounding)

    def over_noise(which: int) -> float:
        chosen = kind == which
        if chosen.sum() < FEWEST_LINES:
            return float("nan")
        expected = max(float(noise[chosen].mean()), 1e-300)
        return float(10.0 * np.log10(max(np.mean(np.abs(mean[chosen]) ** 2) / expected, 1.0)))

    return Distortion(
        source=m.source or m.name,
        channel=channel,
        even_dB=over_noise(2),
        odd_dB=over_noise(1),
        frequency_Hz=np.arange(1, kind.size + 1) * m.sampling_Hz / samples,
        amplitude=np.abs(mean),
        kind=kind,
        noise=np.sqrt(noise),
    )
