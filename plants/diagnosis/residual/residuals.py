"""Residuals of the balances over all records, and the regime of the plant."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import NoiseFloor
from plants.diagnosis.data.smoothing import Smoother, least_width
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.residual.balance import ACTUATOR, Equation, Record, Signals, Terms
from plants.diagnosis.residual.dependence import Variable, crossed


def of_usual_rate(measurements: Sequence[MeasuredRecord]) -> list[int]:
    """Numbers of the records at the rate that most of them have, within `rates_alike`."""
    rates = [m.sampling_Hz for m in measurements]

    def alike(rate_Hz: float) -> list[int]:
        most = CONSTANTS.rates_alike
        return [n for n, other in enumerate(rates) if abs(other / rate_Hz - 1.0) <= most]

    return max((alike(rate_Hz) for rate_Hz in rates), key=len, default=[])


def prepared(
    measurements: Sequence[MeasuredRecord],
    numbers: Sequence[BaseNumbers | None],
    floor: NoiseFloor,
    runs: Sequence[Signals] | None = None,
) -> list[Record]:
    """The measurements of the usual sampling rate, so that spectra share a grid.

    Args:
        numbers: Numbers of the model, of each record.
        runs: Channels of each record as a model with effects has them.
    """
    rng = np.random.default_rng(0)
    records = []
    for n in of_usual_rate(measurements):
        m, b = measurements[n], numbers[n]
        if b is None:
            continue
        signals = {"effort_N": m.command_A(b.newtons_per_ampere) * b.newtons_per_ampere}
        columns = {name: m.channel(name) for name in m.outputs}
        columns["current_A"] = m.measured_current_A(b.newtons_per_ampere)
        signals |= {name: column for name, column in columns.items() if column is not None}
        rms = {"effort_N": 0.0} | {name: n.rms for name, n in floor.channels.items()}
        noise = {name: rng.normal(0.0, rms[name], m.samples) for name in signals}
        run = None if runs is None else {**signals, **runs[n]}
        records.append(Record(m, b, signals, noise, run))
    return records


class BalanceFit(NamedTuple):
    """A fitted balance over the concatenated records.

    Attributes:
        residual: What it leaves, shape (samples,).
        noise: What noise alone leaves, same shape.
        carried: What the model explains, same shape.
        noise_carried: The same of noise alone.
        columns: Terms that were fitted, shape (samples, parameters).
        slope: The last of them before the fit, shape (samples,).
    """

    residual: FloatArray
    noise: FloatArray
    carried: FloatArray
    noise_carried: FloatArray
    columns: FloatArray
    slope: FloatArray


def widest_s(records: Sequence[Record]) -> float:
    """Greatest smoothing width that keeps the plant's own motion, s."""
    natural = max(r.numbers.natural_rad_s for r in records)
    shortest = min(r.measurement.duration_s for r in records)
    return min(0.02 * shortest, 1.0 / natural if natural > 0.0 else math.inf)


def fit_balance(equation: Equation, records: Sequence[Record], smoother: Smoother) -> BalanceFit:
    """Residual of the balance, and of noise alone, with the base-model parameters free."""
    own = [smoother._replace(sampling_Hz=r.measurement.sampling_Hz) for r in records]
    pairs = list(zip(records, own, strict=True))
    terms = [_without_effects(equation, r, s) for r, s in pairs]
    noises = [equation.balance(r.numbers, r.noise, s) for r, s in pairs]
    lengths = np.array([r.measurement.cable_length_m or 0.0 for r in records])
    lengths = lengths - lengths.mean()

    def columns(of: Sequence[FloatArray], *, offsets: bool) -> FloatArray:
        wide = []
        for n, terms_of in enumerate(of):
            offset = np.zeros((terms_of.shape[0], len(records) if equation.own_offset else 1))
            offset[:, n if equation.own_offset else 0] = float(offsets)
            # Friction and stiffness may change with the length in proportion.
            by_length = terms_of[:, -1:] * lengths[n] if lengths.any() else terms_of[:, :0]
            wide.append(np.hstack([terms_of, by_length, offset]))
        return np.vstack(wide)

    known = np.concatenate([t.known for t in terms])
    A = columns([t.columns for t in terms], offsets=True)
    inside = np.isfinite(known) & np.isfinite(A).all(axis=1)
    size = np.sqrt(np.mean(A[inside] ** 2, axis=0)) if inside.any() else np.ones(A.shape[1])
    size[~(size > 0.0)] = 1.0
    parameters = np.linalg.lstsq(A[inside] / size, known[inside], rcond=1e-9)[0] / size
    noise_known = np.concatenate([t.known for t in noises])
    noise_A = columns([t.columns for t in noises], offsets=False)
    slope = np.concatenate([t.columns[:, -1] for t in terms])
    carried, noise_carried = A @ parameters, noise_A @ parameters
    return BalanceFit(
        known - carried, noise_known - noise_carried, carried, noise_carried, A / size, slope
    )


def _without_effects(equation: Equation, r: Record, smoother: Smoother) -> Terms:
    """A balance less what the model's effects make of it in the motion that the model runs."""
    terms = equation.balance(r.numbers, r.signals, smoother)
    if r.run is None or equation is ACTUATOR:
        return terms
    own = equation.balance(r.numbers, r.run, smoother)
    return terms._replace(known=terms.known - (own.known - own.columns.sum(axis=1)))


def variables(records: Sequence[Record]) -> list[Variable]:
    """The variables that a residual may follow, at each sample of all the records."""
    first = records[0]
    has_angle, has_tension = "angle_rad" in first.signals, "tension_N" in first.signals
    moving, rate = "angle_rad" if has_angle else "tension_N", first.measurement.sampling_Hz

    def velocity(smoother: Smoother, *, noise: bool = False) -> FloatArray:
        signals = [(r.noise if noise else r.signals)[moving] for r in records]
        return np.concatenate([smoother.sampled(signal, 0.0, 1.0) for signal in signals])

    def quiet(width_s: float) -> bool:
        smoother = Smoother(width_s, rate)
        noise = np.nanstd(velocity(smoother, noise=True))
        return bool(noise <= CONSTANTS.small * np.nanstd(velocity(smoother)))

    smoother = Smoother(least_width(quiet, 1.0 / rate, widest_s(records)), rate)
    v, commands = velocity(smoother), [(r.signals["effort_N"], r.numbers) for r in records]
    least = CONSTANTS.above_noise * float(np.nanstd(velocity(smoother, noise=True)))
    sign = np.where(np.isfinite(v), np.sign(v) * (np.abs(v) > least), np.nan)
    way = np.where(np.isfinite(sign), sign + 1.0, -1.0).astype(np.int64)
    commanded = [smoother.held(u, b.dead_time_s, 0.0, 1.0) for u, b in commands]
    samples = [r.measurement.samples for r in records]
    listed = [
        Variable("time", "of the record", np.concatenate([np.arange(n) / n for n in samples])),
        Variable("velocity sign", "", sign, way),
        Variable("velocity", "rad/s" if has_angle else "N/s", v),
        Variable("command rate", "N/s", np.concatenate(commanded)),
    ]
    if has_tension:
        T = np.concatenate([smoother.sampled(r.signals["tension_N"], 1.0) for r in records])
        cells = crossed(way, T)
        listed.append(Variable("tension", "N", T))
        listed.append(Variable("velocity sign and tension", "N", T, cells))
    if has_angle and (first.numbers.linear is None or not has_tension):
        angles = [_angle_from_slack(r, smoother) for r in records]
        listed.append(Variable("angle", "rad", np.concatenate(angles)))
    lengths = [r.measurement.cable_length_m or math.nan for r in records]
    if np.isfinite(lengths).all() and len(set(lengths)) > 1:
        listed.append(Variable("length", "m", np.repeat(lengths, samples)))
    return listed


def _angle_from_slack(record: Record, smoother: Smoother) -> FloatArray:
    """The drum angle from where the cable is just taut, independent of the encoder's zero; rad."""
    angle = smoother.sampled(record.signals["angle_rad"], 1.0)
    if record.numbers.stiffness_N_m is None or "tension_N" not in record.signals:
        return angle
    tension = float(record.signals["tension_N"].mean())
    return angle - float(np.nanmean(angle)) + tension / record.numbers.tension_per_angle_N_rad


def spectrum(
    parts: Sequence[FloatArray], sampling_Hz: float, longest: int = 512
) -> tuple[FloatArray, FloatArray]:
    """Frequencies, Hz, and power spectral density of a signal over some records (Welch 1967)."""
    from scipy.signal import welch  # noqa: PLC0415  slow to import

    known = (signal[np.isfinite(signal)] for signal in parts)
    finite = [signal for signal in known if signal.size >= CONSTANTS.fewest]
    segment = min([longest, *(signal.size for signal in finite)]) // 2 * 2
    powers = [welch(signal, sampling_Hz, nperseg=segment, detrend=False)[1] for signal in finite]
    frequency: FloatArray = np.linspace(0.0, sampling_Hz / 2.0, segment // 2 + 1)
    if not finite:
        return frequency, np.zeros(frequency.size)
    return frequency, np.average(powers, axis=0, weights=[signal.size for signal in finite])
