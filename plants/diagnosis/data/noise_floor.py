"""Noise floor: noise of each channel, steps of encoder and gauge, and an allowance.

The noise is what a sensor adds. Repeated trials, a periodic setpoint and stretches of constant
setpoint show it with all that disturbs the plant and with the jitter of its clock; the upper
spectrum, where the plant does not follow, bounds it from above.
"""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import CHANNELS, OUTPUTS, MeasuredRecord
from plants.diagnosis.data.noise import spectral_rms, step_of, upper_rms
from plants.diagnosis.data.periods import holds, periods_of

SOURCES = ("repeats", "periods", "quiet stretches", "upper spectrum", "steps")
"""Sources of a noise estimate, the best first; `steps` is rounding alone."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of one channel.

    Attributes:
        rms: Its root mean square, in the channel's unit; never below lsb / sqrt(12).
        lsb: Rounding step of the readings, or 0 without one.
        how: Its source, one of `SOURCES`.
        walk: Rms of what each sample adds to all later ones, where an angle is the integral of a
            speed: the noise of the speed times the time of a sample.
    """

    rms: float
    lsb: float
    how: str
    walk: float = 0.0

    def drawn(self, samples: int) -> FloatArray:
        """Noise like it, the same at each call, shape (samples,)."""
        white = np.random.default_rng(0).normal(0.0, self.walk or self.rms, samples)
        return white.cumsum() if self.walk else white


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFloor:
    """The noise of a set of measurements.

    Attributes:
        channels: Pooled over the measurements, by channel.
    """

    channels: dict[str, Noise]

    @property
    def tension_N(self) -> float:
        """Noise of the gauge, N rms; nan without a gauge."""
        return self.rms("tension_N")

    @property
    def angle_rad(self) -> float:
        """Noise of the encoder, rad rms; nan without an encoder."""
        return self.rms("angle_rad")

    @property
    def coarse_step_N(self) -> float | None:
        """Step of a gauge whose readings are rounded by more than its noise, N, or None."""
        gauge = self.channels.get("tension_N")
        if gauge is None:
            return None
        # Below a twentieth of a step, what is beside the rounding cannot be told from none.
        beside = max(gauge.rms**2 - gauge.lsb**2 / 12.0, (gauge.lsb / 20.0) ** 2)
        return gauge.lsb if gauge.lsb > CONSTANTS.above_noise * math.sqrt(beside) else None

    def effective(self, channel: str, signal_rms: float, least_rms: float = 0.0) -> float:
        """Noise and allowance together, sigma_eff, in the channel's unit.

        sigma_eff^2 = sigma_n^2 + (0.4 % of the signal's rms)^2
        """
        noise = max(self.rms(channel), least_rms)
        return float((noise**2 + (CONSTANTS.allowance * signal_rms) ** 2) ** 0.5)

    def rms(self, channel: str) -> float:
        """Noise of a channel, rms in its unit; nan where it is in no record."""
        return self.channels[channel].rms if channel in self.channels else float("nan")


def noise_floor(measurements: Sequence[MeasuredRecord]) -> NoiseFloor:
    """The noise of each channel of one rig's records, each of enough samples for a spectrum."""
    repeated = _repeats(measurements)
    records = tuple(
        {
            name: _noise(m, column, repeated.get((n, name)))
            for name in (*OUTPUTS, "current_A")
            if (column := m.channel(name)) is not None
        }
        for n, m in enumerate(measurements)
    )
    names = dict.fromkeys(name for record in records for name in record)
    samples = [m.samples for m in measurements]
    return NoiseFloor({name: _pooled(name, records, samples) for name in names})


def _noise(m: MeasuredRecord, column: FloatArray, repeated: float | None) -> Noise:
    lsb = step_of(column)
    rms, how = (repeated, SOURCES[0]) if repeated is not None else _alone(m, column)
    if rms > (most := CONSTANTS.upper_most * upper_rms(column)):
        rms, how = most, SOURCES[3]
    rounding = lsb / math.sqrt(12.0)
    walk = 0.0
    if column is m.angle_rad and m.speed_rad_s is not None:
        walk = _noise(m, m.speed_rad_s, None).rms / m.sampling_Hz
    return Noise(max(rms, rounding), lsb, how if rms > rounding else SOURCES[4], walk)


def _alone(m: MeasuredRecord, column: FloatArray) -> tuple[float, str]:
    """The noise of a channel from its own record alone, and its source."""
    estimates: list[tuple[float, str]] = []
    if m.setpoint_N is not None:
        periods = periods_of(m.setpoint_N)
        if periods is not None and periods.samples >= CONSTANTS.fewest:
            estimates.append((_group_rms(periods.fold(column)), SOURCES[1]))
        elif quiet := [column[hold] for hold in holds(m.setpoint_N, CONSTANTS.fewest)]:
            # Of each stretch the second half: by then the plant has settled.
            settled = (c[c.size // 2 :] if c.size >= 2 * CONSTANTS.fewest else c for c in quiet)
            estimates.append((float(np.median([spectral_rms(c) for c in settled])), SOURCES[2]))
    if not estimates or m.loop == "closed":
        # A controller turns the gauge's noise into motion, which the recorded current explains:
        # the upper spectrum, where the plant does not follow, may then be nearer the truth.
        estimates.append((upper_rms(column), SOURCES[3]))
    return min(estimates)


def _group_rms(same: FloatArray) -> float:
    """Noise of signals that are equal but for noise, shape (repeats, samples)."""
    repeats = same.shape[0]
    deviation = same - same.mean(axis=0)
    # The mean takes 1/repeats of the noise with it.
    each = [spectral_rms(row) for row in deviation]
    return float(np.sqrt(np.mean(np.square(each)) * repeats / (repeats - 1.0)))


def _repeats(measurements: Sequence[MeasuredRecord]) -> dict[tuple[int, str], float]:
    """Noise by measurement and channel, of trials run twice or more."""
    rms_of = {}
    for same in _repeated(measurements):
        for name in CHANNELS[1:]:
            columns = [measurements[n].channel(name) for n in same]
            known = [column for column in columns if column is not None]
            if len(known) == len(same):
                rms = _group_rms(np.stack(known))
                rms_of.update(dict.fromkeys(((n, name) for n in same), rms))
    return rms_of


def unrepeated(measurements: Sequence[MeasuredRecord]) -> tuple[dict[str, FloatArray], ...]:
    """Deviation between repeats of an open-loop command, by channel for each measurement.

    Scaled to a single run; nan where a command was not repeated. Besides noise it holds the
    response to disturbance forces, however slow.
    """
    deviations: tuple[dict[str, FloatArray], ...] = tuple({} for _ in measurements)
    for n, m in enumerate(measurements):
        periods = None if m.setpoint_N is None else periods_of(m.setpoint_N)
        if periods is None or m.loop != "open":
            continue
        lag = periods.samples
        begin = periods.first + (lag if periods.periods > 2 else 0)
        end = periods.first + (periods.periods - 1) * lag
        for name in m.outputs:
            column = m.channel(name)
            if column is not None:
                deviations[n][name] = np.full(m.samples, np.nan)
                again = column[begin + lag : end + lag] - column[begin:end]
                deviations[n][name][begin:end] = again / math.sqrt(2.0)
    for same in _repeated(measurements):
        for name in measurements[same[0]].outputs if measurements[same[0]].loop == "open" else ():
            columns = [measurements[n].channel(name) for n in same]
            known = np.stack([column for column in columns if column is not None])
            if len(known) == len(same):
                deviation = (known - known.mean(axis=0)) * math.sqrt(len(same) / (len(same) - 1.0))
                # An encoder may be zeroed before each run.
                deviation -= deviation.mean(axis=1, keepdims=True)
                for n, deviation_of_run in zip(same, deviation, strict=True):
                    deviations[n][name] = deviation_of_run
    return deviations


def _repeated(measurements: Sequence[MeasuredRecord]) -> list[list[int]]:
    """Indices of the measurements of each trial that was run twice or more."""
    groups: dict[tuple[Any, ...], list[int]] = defaultdict(list)
    for n, m in enumerate(measurements):
        if m.setpoint_N is not None:
            groups[m.loop, m.profile, m.gains, m.cable_length_m, m.samples].append(n)
    return [same for group in groups.values() for same in _same_setpoints(measurements, group)]


def _same_setpoints(measurements: Sequence[MeasuredRecord], group: list[int]) -> list[list[int]]:
    """Splits a group into those with equal setpoints, two or more of each."""
    groups: list[tuple[FloatArray, list[int]]] = []
    for n in group:
        setpoint = measurements[n].setpoint_N
        assert setpoint is not None  # noqa: S101  groups are made of records that have one
        same = CONSTANTS.numerics * max(float(np.abs(setpoint).max()), 1e-300)
        for first, members in groups:
            if np.abs(setpoint - first).max() <= same:
                members.append(n)
                break
        else:
            groups.append((setpoint, [n]))
    return [members for _, members in groups if len(members) > 1]


def _pooled(name: str, records: Sequence[dict[str, Noise]], samples: Sequence[int]) -> Noise:
    """One noise for all records: the mean square over those from the best source."""
    known = [(r[name], n) for r, n in zip(records, samples, strict=True) if name in r]
    how = min((noise.how for noise, _ in known), key=SOURCES.index)
    best = [(noise, n) for noise, n in known if noise.how == how]
    total = sum(n for _, n in best)
    square = sum(noise.rms**2 * n for noise, n in best) / total
    walk = math.sqrt(sum(noise.walk**2 * n for noise, n in best) / total)
    lsb = float(np.median([noise.lsb for noise, _ in known]))
    rms, rounding = math.sqrt(square), lsb / math.sqrt(12.0)
    # A drum that friction holds through a record reads the same throughout, which is no noise of
    # zero: the angle outweighed all else, and a torque gain of 0.06 was fitted.
    return Noise(max(rms, rounding), lsb, how if rms > rounding else SOURCES[4], walk)
