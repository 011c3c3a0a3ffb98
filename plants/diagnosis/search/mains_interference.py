"""Mains interference, found in the noise of the records; it has another phase in each."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.interval import Interval
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter


@dataclass(frozen=True, slots=True, eq=False)
class MainsLine:
    """A sine of the mains frequency in the gauge's readings."""

    amplitude_N: Interval
    frequency_Hz: Interval
    phase_rad: Interval
    measurements: tuple[MeasuredRecord, ...]


def line_in_residual(
    fitter: ModelFitter, model: CandidateFit, recorded: Sequence[MeasuredRecord]
) -> MainsLine | None:
    """Mains interference in what a model leaves of the gauge's readings as they were recorded."""
    predictions = model.fitted.predictor.predict(model.fitted.values[None, :])
    lines = [
        _Line(n, m.time_s, m.tension_N - p.tension_N[0])
        for n, (m, p) in enumerate(zip(recorded, predictions, strict=True))
        if m.tension_N is not None and p.tension_N is not None
    ]
    if not lines:
        return None
    longest = max(float(np.ptp(line.time_s)) for line in lines)
    highest = 0.5 * min(m.sampling_Hz for m in recorded)
    tried = (50.0, 60.0, 100.0, 120.0, 150.0, 180.0)
    peaks = [_peak(lines, f, longest) for f in tried if f < highest]
    best = max((p for p in peaks if p is not None), key=lambda p: p[1], default=None)
    if best is None:
        return None
    return _interference(recorded, lines, best[0], longest, fitter.floor.tension_N)


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    """Remainder of one record's readings."""

    number: int
    time_s: FloatArray
    remainder_N: FloatArray

    def wave(self, frequency_Hz: float) -> tuple[float, float]:
        """Weights of sine and cosine."""
        turn = 2.0 * math.pi * frequency_Hz * self.time_s
        columns = np.stack([np.sin(turn), np.cos(turn), np.ones(turn.size)], axis=1)
        sine, cosine, _ = np.linalg.lstsq(columns, self.remainder_N, rcond=None)[0]
        return float(sine), float(cosine)

    def stands_out(self, frequency_Hz: float) -> bool:
        """Whether the line is far above what is beside it in this record."""
        beside = [math.hypot(*self.wave(frequency_Hz * share)) for share in CONSTANTS.beside]
        least = 0.25 * CONSTANTS.clear**2 * float(np.median(beside)) ** 2
        return math.hypot(*self.wave(frequency_Hz)) ** 2 > least


def _powers(lines: Sequence[_Line], first_Hz: float, step_Hz: float, number: int) -> FloatArray:
    """Power of all records at frequencies a step apart, shape (number,)."""
    turns = -2j * math.pi * (first_Hz + step_Hz * np.arange(number))
    power = np.zeros(number)
    for line in lines:
        residual = line.remainder_N - line.remainder_N.mean()
        sums = [np.exp(turn * line.time_s) @ residual for turn in turns]
        power += 4.0 * np.abs(sums) ** 2 / line.time_s.size
    return power


def _peak(lines: Sequence[_Line], about_Hz: float, longest_s: float) -> tuple[float, float] | None:
    """Highest line within 1 % of a frequency, and its power, or None if it is no line."""
    step, lowest = 0.25 / longest_s, 0.99 * about_Hz
    power = _powers(lines, lowest, step, math.ceil(0.02 * about_Hz / step))
    beside = [_powers(lines, about_Hz * share, 0.0, 1)[0] for share in CONSTANTS.beside]
    top = int(power.argmax())
    if power[top] < CONSTANTS.clear**2 * float(np.median(beside)):
        return None
    near = lowest + (top - 1) * step
    power = _powers(lines, near, step / 8.0, 17)
    top = int(power.argmax())
    return near + top * step / 8.0, float(power[top])


def _interference(
    measurements: Sequence[MeasuredRecord],
    lines: Sequence[_Line],
    frequency_Hz: float,
    longest_s: float,
    noise_N: float,
) -> MainsLine | None:
    waves = {line.number: line.wave(frequency_Hz) for line in lines}
    sizes = np.array([math.hypot(*w) for w in waves.values()])
    middle = float(np.median(sizes))
    # Interference does not depend on the motion: its amplitude is the same in all records.
    alike = (sizes > 0.5 * middle) & (sizes < 2.0 * middle)
    # A missing effect may produce lines, too, but not in records of every kind.
    alike &= np.array([line.stands_out(frequency_Hz) for line in lines])
    if middle < CONSTANTS.shown * math.sqrt(2.0) * noise_N or alike.mean() < CONSTANTS.alike:
        return None
    amplitude = float(np.mean(sizes[alike]))
    spread = 2.6 * float(np.std(sizes[alike])) / math.sqrt(alike.sum()) + 0.02 * amplitude
    phases = {n: math.atan2(cosine, sine) for n, (sine, cosine) in waves.items()}
    first = next(iter(phases.values()))
    apart = max(abs(math.remainder(p - first, 2.0 * math.pi)) for p in phases.values())
    reach = math.pi if apart > 0.5 else apart
    off = 0.15 / longest_s
    return MainsLine(
        Interval(amplitude, amplitude - spread, amplitude + spread, "N"),
        Interval(frequency_Hz, frequency_Hz - off, frequency_Hz + off, "Hz"),
        Interval(first, max(first - reach, -math.pi), min(first + reach, math.pi), "rad"),
        _cleaned(measurements, lines, amplitude, frequency_Hz, phases),
    )


def _cleaned(
    measurements: Sequence[MeasuredRecord],
    lines: Sequence[_Line],
    amplitude_N: float,
    frequency_Hz: float,
    phases: dict[int, float],
) -> tuple[MeasuredRecord, ...]:
    cleaned = list(measurements)
    for line in lines:
        m = cleaned[line.number]
        waves = [(amplitude_N, frequency_Hz, phases[line.number])]
        for order in (2, 3, 5):
            if order * frequency_Hz < 0.5 * m.sampling_Hz:
                sine, cosine = line.wave(order * frequency_Hz)
                wave = math.hypot(sine, cosine), order * frequency_Hz, math.atan2(cosine, sine)
                waves.append(wave)
        assert m.tension_N is not None  # noqa: S101  only records with a gauge have a line
        tension = m.tension_N.copy()
        for size, frequency, phase in waves:
            tension -= size * np.sin(2.0 * math.pi * frequency * m.time_s + phase)
        cleaned[line.number] = replace(m, tension_N=tension)
    return tuple(cleaned)
