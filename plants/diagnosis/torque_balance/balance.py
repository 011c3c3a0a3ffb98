"""The balance of torques on a drive that nothing holds, with all terms filtered alike.

    K_t i = J a + b v + tau_0 + sum of laws

is linear in the sizes of its laws. Both sides pass one Gaussian kernel, so that no term is later
or smoother than another; a law is worked out before it, from a velocity smoothed no more than
noise makes necessary, for the sign of a smooth velocity is not that of the velocity. Nothing is
integrated: what disturbs the drive at one moment is no error at the next, as it is where the angle
is predicted. Samples at rest are left out, for friction has any value there.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import Noise
from plants.diagnosis.data.smoothing import Smoother, least_width
from plants.diagnosis.models.base import BaseNumbers

INERTIA, VISCOUS, OFFSET = "inertia", "viscous", "offset"
COULOMB, DRAG, SPEED, SINE, COSINE = "coulomb", "drag", "speed", "sine", "cosine"
BASE = (INERTIA, VISCOUS, OFFSET)


@dataclass(frozen=True, slots=True, eq=False)
class Signals:
    """One record, smoothed, with a sharp velocity beside; all of shape (samples,)."""

    torque_Nm: FloatArray
    command_Nm: FloatArray
    inertial: FloatArray
    velocity_rad_s: FloatArray
    sharp_rad_s: FloatArray
    angle_rad: FloatArray
    smoother: Smoother

    def spread(self, law: FloatArray) -> FloatArray:
        """A law of smoothed signals, smoothed as the torque is."""
        return self.smoother.sampled(np.nan_to_num(law), 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Scale:
    """Sizes that the records show.

    Attributes:
        least_rad_s: Speed below which a drive is at rest, as far as its encoder shows.
        usual_rad_s: Speed in motion, rms.
        angles_rad: Knots over the angle, shape (knots,).
        fadings_rad_s: Velocities tried over which a friction fades, shape (some,).
        lasts_s: Duration of the longest record.
    """

    least_rad_s: float
    usual_rad_s: float
    angles_rad: FloatArray
    fadings_rad_s: FloatArray
    lasts_s: float


@dataclass(frozen=True, eq=False)
class TorqueBalance:
    """The samples in motion of all records.

    Attributes:
        torque_Nm: Torque of the motor, shape (samples,).
        columns: Terms that it may be made of, by name, same shape.
        loaded_Nm: The motor's torque by size, against the motion, N m; same shape.
        block: Number of the stretch of time each sample lies in, same shape.
        widths_s: Standard deviation of the kernel of a velocity in a law, and of all terms, s.
        both_ways: Whether there is motion in both directions.
        noise_Nm: What a complete model may leave: noise of the encoder, numerics, model form; rms.
    """

    torque_Nm: FloatArray
    columns: dict[str, FloatArray]
    loaded_Nm: FloatArray
    block: NDArray[np.int64]
    scale: Scale
    widths_s: tuple[float, float]
    both_ways: bool
    noise_Nm: float

    @cached_property
    def turned_rad(self) -> float:
        """Extent of the angle in motion, rad."""
        return float(np.ptp(self.columns["angle"]))


def torque_balance(
    measurements: Sequence[MeasuredRecord],
    numbers: Sequence[BaseNumbers],
    encoder: Noise,
    narrower: float = 1.0,
    like: TorqueBalance | None = None,
) -> TorqueBalance | None:
    """The balance of some records; None where they show too little motion above the noise.

    Args:
        numbers: Numbers of the model, of each record.
        encoder: Noise of the angle.
        narrower: Width of the kernel relative to the widest; it is not below the least.
        like: A balance of other records, whose kernel and sizes are used.
    """
    pairs = [(m, b) for m, b in zip(measurements, numbers, strict=True) if m.angle_rad is not None]
    if not pairs:
        return None
    sharp_s, width_s = _widths_s(pairs, encoder) if like is None else like.widths_s
    width_s = max(sharp_s, narrower * width_s)
    listed = [_signals(m, b, sharp_s, width_s) for m, b in pairs]
    velocity = np.concatenate([s.sharp_rad_s for s in listed])
    b = pairs[0][1]
    sharp, smoother = (Smoother(s, _usual_rate_Hz(pairs)) for s in (sharp_s, width_s))
    # Records of another rate may be shorter than the kernel is at the usual one.
    most = max(*(m.samples for m, _ in pairs), 4 * sharp.reach, 4 * smoother.reach)
    noise = encoder.drawn(most)
    of_velocity = float(np.nanstd(sharp.sampled(noise, 0.0, 1.0)))
    of_torque = smoother.sampled(noise, 0.0, b.viscous_friction_Nms, b.drum_inertia_kg_m2)
    least = CONSTANTS.above_noise * of_velocity
    moving = np.abs(velocity[np.abs(velocity) > least])
    if moving.size < CONSTANTS.fewest:
        return None
    fastest = CONSTANTS.above_noise * float(np.quantile(moving, 0.95))
    usual = float(np.sqrt(np.mean(np.square(moving[moving <= fastest]))))
    angle = np.concatenate([s.angle_rad for s in listed])
    scale = Scale(
        least,
        usual,
        np.linspace(float(np.nanmin(angle)), float(np.nanmax(angle)), CONSTANTS.angle_knots),
        np.geomspace(max(0.03 * usual, least), usual, CONSTANTS.fadings),
        max(m.duration_s for m, _ in pairs),
    )
    scale = scale if like is None else like.scale
    # One record has twice as many: records beside each other are stretches, too.
    parts = max(CONSTANTS.parts, math.ceil(2 * CONSTANTS.parts / len(listed)))
    torque, columns, loaded, blocks = [], [], [], []
    number = 0
    for s in listed:
        inside, terms, against = _terms(s, scale, fastest)
        stride = _stride(width_s, s.smoother.sampling_Hz)
        for part in np.array_split(np.arange(inside.size), parts):
            chosen = part[inside[part]][::stride]
            if chosen.size >= CONSTANTS.part_samples:
                torque.append(s.torque_Nm[chosen])
                columns.append({name: column[chosen] for name, column in terms.items()})
                loaded.append(against[chosen])
                blocks.append(np.full(chosen.size, number))
                number += 1
    # Of fewer stretches no two can be left out and the law still be known.
    if number < CONSTANTS.parts:
        return None
    joined = {name: np.concatenate([c[name] for c in columns]) for name in columns[0]}
    kept = float(np.square(joined[VISCOUS]).mean()) * len(joined[VISCOUS])
    there = float(np.square(moving[moving <= fastest]).sum())
    stride = _stride(width_s, listed[0].smoother.sampling_Hz)
    if kept * stride < CONSTANTS.small * there:
        return None
    forward, whole = float(np.mean(joined[VISCOUS] > 0.0)), np.concatenate(torque)
    allowance = CONSTANTS.allowance * float(np.sqrt(np.mean(whole**2)))
    return TorqueBalance(
        whole,
        joined,
        np.concatenate(loaded),
        np.concatenate(blocks),
        scale,
        (sharp_s, width_s),
        both_ways=min(forward, 1.0 - forward) >= CONSTANTS.small,
        noise_Nm=math.hypot(float(np.nanstd(of_torque)), allowance),
    )


def _widths_s(
    pairs: Sequence[tuple[MeasuredRecord, BaseNumbers]], encoder: Noise
) -> tuple[float, float]:
    """The least kernel that keeps the noise out of the motion, and the widest that keeps that."""
    durations = [m.duration_s for m, _ in pairs]
    rate_Hz = _usual_rate_Hz(pairs)
    commands = [
        m.command_A(b.newtons_per_ampere) * b.newtons_per_ampere * b.drum_radius_m
        for m, b in pairs
    ]
    torque = float(np.std(np.concatenate(commands)))
    inertia = float(np.median([b.drum_inertia_kg_m2 for _, b in pairs]))
    noise = encoder.drawn(max(m.samples for m, _ in pairs))

    def velocity(width_s: float) -> FloatArray:
        return np.concatenate(
            [Smoother(width_s, m.sampling_Hz).sampled(_angle(m), 0.0, 1.0) for m, _ in pairs]
        )

    def quiet(width_s: float) -> bool:
        smoother = Smoother(width_s, rate_Hz)
        if noise.size <= 2 * smoother.reach:  # of records of unlike rates: it covers all of them
            return True
        of_acceleration = inertia * float(np.nanstd(smoother.sampled(noise, 0.0, 0.0, 1.0)))
        of_velocity = float(np.nanstd(smoother.sampled(noise, 0.0, 1.0)))
        moved = float(np.nanstd(velocity(width_s)))
        return (
            of_acceleration <= CONSTANTS.kernel_quiet * torque
            and of_velocity <= CONSTANTS.kernel_quiet * moved
        )

    shortest = 1.0 / min(m.sampling_Hz for m, _ in pairs)
    least = least_width(
        quiet, shortest, max(shortest, 2.0 * CONSTANTS.kernel_widest * min(durations))
    )
    sharp = velocity(least)

    def loses(width_s: float) -> bool:
        smooth = velocity(width_s)
        both = np.isfinite(sharp) & np.isfinite(smooth)
        return bool(
            not both.any() or smooth[both].std() < CONSTANTS.kernel_kept * sharp[both].std()
        )

    widest = CONSTANTS.kernel_widest * float(np.median(durations))
    return least, least if widest <= least else least_width(loses, least, widest)


def _usual_rate_Hz(pairs: Sequence[tuple[MeasuredRecord, BaseNumbers]]) -> float:
    """The median rate, at which the encoder's noise is drawn.

    At that of the first record, whose clock was a thousand times too fast, a kernel of the others
    had millions of samples, which took minutes.
    """
    return sorted(m.sampling_Hz for m, _ in pairs)[(len(pairs) - 1) // 2]


def _angle(m: MeasuredRecord) -> FloatArray:
    assert m.angle_rad is not None  # noqa: S101  only such records are taken
    return m.angle_rad


def _signals(m: MeasuredRecord, b: BaseNumbers, sharp_s: float, width_s: float) -> Signals:
    least_s, angle = 1.0 / m.sampling_Hz, _angle(m)
    sharp, smoother = (Smoother(max(s, least_s), m.sampling_Hz) for s in (sharp_s, width_s))
    command = m.command_A(b.newtons_per_ampere) * b.newtons_per_ampere * b.drum_radius_m
    return Signals(
        smoother.held(command, b.dead_time_s, 1.0),
        command,
        smoother.sampled(angle, 0.0, 0.0, 1.0),
        smoother.sampled(angle, 0.0, 1.0),
        sharp.sampled(angle, 0.0, 1.0),
        angle,
        smoother,
    )


def _terms(
    s: Signals, scale: Scale, fastest_rad_s: float
) -> tuple[NDArray[np.bool_], dict[str, FloatArray], FloatArray]:
    """Which samples are in motion, their terms, and the torque by size against the motion."""
    v = np.nan_to_num(s.sharp_rad_s)
    way = np.sign(v)
    terms = {
        INERTIA: s.inertial,
        VISCOUS: s.velocity_rad_s,
        OFFSET: np.ones(v.size),
        COULOMB: s.spread(way),
        DRAG: s.spread(v * np.abs(v)),
        SPEED: s.spread(np.abs(v)),
        SINE: s.spread(np.sin(s.angle_rad)),
        COSINE: s.spread(np.cos(s.angle_rad)),
        "angle": s.angle_rad,
    }
    for n, fading in enumerate(scale.fadings_rad_s):
        terms[f"fading {n}"] = s.spread(way * np.exp(-np.square(v / fading)))
    place = v / (np.abs(v) + scale.usual_rad_s)
    knots = np.linspace(-1.0, 1.0, CONSTANTS.velocity_knots)
    for n, one in enumerate(np.eye(CONSTANTS.velocity_knots)):
        terms[f"velocity {n}"] = s.spread(np.interp(place, knots, one))
    for n, one in enumerate(np.eye(CONSTANTS.angle_knots)):
        terms[f"over angle {n}"] = s.spread(np.interp(s.angle_rad, scale.angles_rad, one))
    time_s = np.arange(v.size) / s.smoother.sampling_Hz
    times = np.linspace(0.0, scale.lasts_s, CONSTANTS.time_knots)
    for n, one in enumerate(np.eye(CONSTANTS.time_knots)):
        terms[f"time {n}"] = s.spread(way * np.interp(time_s, times, one))
    turning = s.spread((np.abs(v) > scale.least_rad_s).astype(np.float64))
    jumps = s.spread((np.abs(v) > fastest_rad_s).astype(np.float64))
    inside = np.isfinite(s.torque_Nm) & np.isfinite(s.velocity_rad_s)
    inside &= (turning > 1.0 - CONSTANTS.small) & (jumps < CONSTANTS.rounding)
    return inside, terms, s.spread(np.abs(s.command_Nm) * way)


def _stride(width_s: float, sampling_Hz: float) -> int:
    """Samples from one that is kept to the next: four in a width say all there is."""
    return max(1, round(0.25 * width_s * sampling_Hz))
