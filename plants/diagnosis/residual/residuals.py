"""Residuals of the balances over all records, and the regime of the plant."""

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import NoiseFloor
from plants.diagnosis.data.smoothing import Smoother, least_width
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.residual.balance import Equation, Signals
from plants.diagnosis.residual.dependence import Regime

WIDTH_MAX = 0.02
"""Greatest smoothing width of a plant without a natural frequency, as a share of the record."""
VELOCITY_NOISE_MAX = 0.1
"""Noise of the velocity, as a share of it, at which its sign is reliable."""
SEGMENT = 512
"""Samples in a segment of the spectrum."""
FEWEST = 64
"""Fewest samples of a balance."""


class Record(NamedTuple):
    """One measurement with the model's numbers, its signals, and simulated noise of each."""

    measurement: MeasuredRecord
    numbers: BaseNumbers
    signals: Signals
    noise: Signals


def prepared(
    measurements: Sequence[MeasuredRecord],
    numbers: Sequence[BaseNumbers | None],
    floor: NoiseFloor,
) -> list[Record]:
    """The measurements of the most common sampling rate, so that spectra share a grid."""
    rates = Counter(m.sampling_Hz for m in measurements)
    rng = np.random.default_rng(0)
    records = []
    for m, b in zip(measurements, numbers, strict=True):
        if b is None or m.sampling_Hz != rates.most_common(1)[0][0]:
            continue
        command = m.command_A(b.newtons_per_ampere) * b.newtons_per_ampere
        signals = {"effort_N": command}
        measured = m.measured_current_A(b.newtons_per_ampere)
        if measured is not None:
            signals["current_A"] = measured
        for name in m.outputs:
            column = m.channel(name)
            if column is not None:
                signals[name] = column
        noise = {"effort_N": np.zeros(m.samples)}
        for name in signals.keys() - noise.keys():
            noise[name] = rng.normal(0.0, floor.channels[name].rms, m.samples)
        records.append(Record(m, b, signals, noise))
    return records


class BalanceFit(NamedTuple):
    """A fitted balance over the concatenated records."""

    residual: FloatArray
    noise: FloatArray
    known: FloatArray
    columns: FloatArray
    slope: FloatArray


def widest_s(records: Sequence[Record]) -> float:
    """Greatest smoothing width that keeps the plant's own motion, s."""
    natural = max(r.numbers.natural_rad_s for r in records)
    shortest = min(r.measurement.duration_s for r in records)
    return min(WIDTH_MAX * shortest, 1.0 / natural if natural > 0.0 else math.inf)


def fit_balance(equation: Equation, records: Sequence[Record], smoother: Smoother) -> BalanceFit:
    """Residual of the balance, and of noise alone, with the base-model parameters free."""
    terms = [equation.balance(r.numbers, r.signals, smoother) for r in records]
    noises = [equation.balance(r.numbers, r.noise, smoother) for r in records]
    lengths = np.array([r.measurement.cable_length_m or 0.0 for r in records])
    lengths = lengths - lengths.mean()

    def columns(of: Sequence[FloatArray], *, offsets: bool) -> FloatArray:
        wide = []
        for n, own in enumerate(of):
            offset = np.zeros((own.shape[0], len(records) if equation.own_offset else 1))
            offset[:, n if equation.own_offset else 0] = float(offsets)
            # Friction and stiffness may change with the length in proportion.
            by_length = own[:, -1:] * lengths[n] if lengths.any() else own[:, :0]
            wide.append(np.hstack([own, by_length, offset]))
        return np.vstack(wide)

    known = np.concatenate([t.known for t in terms])
    A = columns([t.columns for t in terms], offsets=True)
    inside = np.isfinite(known) & np.isfinite(A).all(axis=1)
    size = np.sqrt(np.mean(A[inside] ** 2, axis=0)) if inside.any() else np.ones(A.shape[1])
    size[~(size > 0.0)] = 1.0
    found = np.linalg.lstsq(A[inside] / size, known[inside], rcond=1e-9)[0] / size
    noise_known = np.concatenate([t.known for t in noises])
    noise_A = columns([t.columns for t in noises], offsets=False)
    slope = np.concatenate([t.columns[:, -1] for t in terms])
    return BalanceFit(known - A @ found, noise_known - noise_A @ found, known, A / size, slope)


def regime_of(records: Sequence[Record], slope: FloatArray) -> Regime:
    """Regime of the plant at each sample of all the records.

    Args:
        records: The records.
        slope: Regressor of a slope per cable length, shape (samples,).
    """
    first = records[0]
    has_angle, has_tension = "angle_rad" in first.signals, "tension_N" in first.signals
    moving = "angle_rad" if has_angle else "tension_N"
    rate = first.measurement.sampling_Hz

    def over(smoother: Smoother, name: str, *c: float, noise: bool = False) -> FloatArray:
        signals = [r.noise if noise else r.signals for r in records]
        return np.concatenate([smoother.sampled(s[name], *c) for s in signals])

    def quiet(width_s: float) -> bool:
        smoother = Smoother(width_s, rate)
        noise = np.nanstd(over(smoother, moving, 0.0, 1.0, noise=True))
        return bool(noise <= VELOCITY_NOISE_MAX * np.nanstd(over(smoother, moving, 0.0, 1.0)))

    smoother = Smoother(least_width(quiet, 1.0 / rate, widest_s(records)), rate)
    angle = None
    if has_angle and (first.numbers.linear is None or not has_tension):
        angle = np.concatenate([_angle_from_slack(r, smoother) for r in records])
    lengths = [r.measurement.cable_length_m for r in records]
    known = [length for length in lengths if length is not None]
    samples = [r.measurement.samples for r in records]
    return Regime(
        part=np.concatenate([np.arange(n) / n for n in samples]),
        velocity=over(smoother, moving, 0.0, 1.0),
        velocity_noise=float(np.nanstd(over(smoother, moving, 0.0, 1.0, noise=True))),
        tension=over(smoother, "tension_N", 1.0) if has_tension else None,
        angle=angle,
        command_rate=np.concatenate(
            [
                smoother.held(r.signals["effort_N"], r.numbers.dead_time_s, 0.0, 1.0)
                for r in records
            ]
        ),
        length=np.repeat(known, samples) if len(known) == len(lengths) else None,
        slope=slope,
        units={
            "velocity": "rad/s" if has_angle else "N/s",
            "tension": "N",
            "angle": "rad",
            "command_rate": "N/s",
        },
    )


def _angle_from_slack(record: Record, smoother: Smoother) -> FloatArray:
    """The drum angle from where the cable is just taut, independent of the encoder's zero; rad."""
    angle = smoother.sampled(record.signals["angle_rad"], 1.0)
    if record.numbers.stiffness_N_m is None or "tension_N" not in record.signals:
        return angle
    tension = float(record.signals["tension_N"].mean())
    return angle - float(np.nanmean(angle)) + tension / record.numbers.tension_per_angle_N_rad


def spectrum(parts: Sequence[FloatArray], sampling_Hz: float) -> tuple[FloatArray, FloatArray]:
    """Frequencies and power spectral density of a residual over the records."""
    from scipy.signal import welch  # noqa: PLC0415  slow to import

    finite = [part for part in map(inner, parts) if part.size >= FEWEST]
    segment = min(SEGMENT, *(part.size for part in finite)) // 2 * 2 if finite else FEWEST
    total, weight = np.zeros(segment // 2 + 1), 0.0
    frequency: FloatArray = np.linspace(0.0, sampling_Hz / 2.0, segment // 2 + 1)
    for part in finite:
        _, power = welch(part, sampling_Hz, nperseg=segment, detrend=False)
        total, weight = total + part.size * power, weight + part.size
    return frequency, total / max(weight, 1.0)


def inner(part: FloatArray) -> FloatArray:
    """A residual without the ends at which it is undefined."""
    return part[np.isfinite(part)]
