"""Waves over the angle in the current that a drive's motion takes.

A drive that turns slowly in a velocity loop shows its cogging in the current, hardly in the
motion: a prediction of the motion from the current is then as uncertain as the difference of two
large torques. The other way round,

    K_t i = b v + F sign(v) + tau_0 + sum A_k sin(N_k theta + phi_k),

the current is predicted from the motion, where it is slow: there the inertia takes nothing. The
waves are found one after the other, each the one
that takes off the most (orthogonal matching pursuit, Pati et al. 1993); what they are worth is
judged on records, or thirds of one, that they were not fitted to.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.smoothing import Smoother
from plants.diagnosis.interval import QUANTILE, Interval
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.residual.angle_periods import ResidualOverAngle, per_turn
from plants.effects.cogging import WAVES

WIDTH_s = 0.005
"""Smoothing of motion and current alike."""


class TorqueMotion(NamedTuple):
    """Current, angle and the terms of the motion in one record, each of shape (samples,)."""

    torque_Nm: FloatArray
    angle_rad: FloatArray
    terms: FloatArray  # velocity and its sign, shape (samples, 2)


class TorqueWaves(NamedTuple):
    """Waves that explain a current over the angle.

    Attributes:
        parameters: Those of `Cogging`, with their intervals.
        offset_Nm: The constant torque of the drive beside them.
        before_A: Root mean square of the current about its mean, on data left out.
        after_A: What the waves leave of it.
        noise_A: Noise of the current, smoothed alike.
        orders: Periods a turn, the greatest wave first.
        held_A: The same two on records held out of all fits, or None.
    """

    parameters: dict[str, Interval]
    offset_Nm: float
    before_A: float
    after_A: float
    noise_A: float
    orders: tuple[float, ...]
    held_A: tuple[float, float] | None = None

    @property
    def share(self) -> float:
        """Share of the current's power that they explain on data left out."""
        return 1.0 - (self.after_A / self.before_A) ** 2 if self.before_A > 0.0 else 0.0

    @property
    def sentence(self) -> str:
        """What they explain, in plain words."""
        said = (
            f"Over the angle it explains {self.share:.0%} of the current on data left out, "
            f"{self.before_A:.3g} A rms about its mean, of which {self.after_A:.3g} A are left "
            f"in slow motion, {self.after_A / self.noise_A:.2g} times its noise."
        )
        if self.held_A is not None:
            said += f" On the held-out records {self.held_A[1]:.3g} of {self.held_A[0]:.3g} A."
        return f"{said} The motion itself is not predicted: short predictions stay as they are."


def torque_waves(
    measurements: Sequence[MeasuredRecord],
    numbers: Sequence[BaseNumbers | None],
    noise_A: float,
    held: Sequence[MeasuredRecord] = (),
) -> TorqueWaves | None:
    """The waves over the angle in the current of some records; None where there are none.

    Args:
        measurements: The records, whose angle counts from one zero.
        numbers: Numbers of the model, of each record.
        noise_A: Noise of the current, A rms.
        held: Records held out of all fits.
    """
    first = numbers[0]
    if first is None or not first.is_free:
        return None
    motions = [_motion(m, first) for m in measurements if m.angle_rad is not None]
    if not motions:
        return None
    orders = _orders(motions)
    if not orders:
        return None
    parts = _parts(motions)
    K, rate_Hz = first.newtons_per_ampere * first.drum_radius_m, first.sampling_Hz
    after, moving = min(
        (_left_out(parts, orders, moving=moving), moving) for moving in (False, True)
    )
    before = _left_out(parts, (), moving=False)
    fitted = _fitted(parts, orders, moving=moving)
    shifts = [
        _fitted(parts[:n] + parts[n + 1 :], orders, moving=moving) - fitted
        for n in range(len(parts))
    ]
    error = np.sqrt((len(parts) - 1.0) / len(parts) * np.sum(np.square(shifts), axis=0))
    aside = [_motion(m, first) for m in held if m.angle_rad is not None]
    apart = None
    if aside:
        torque = np.concatenate([m.torque_Nm for m in aside])
        residual = np.concatenate([_rest(m, orders, fitted, moving=moving) for m in aside])
        apart = float(torque.std()) / K, float(np.sqrt(np.mean(residual**2))) / K
    return TorqueWaves(
        _parameters(orders, fitted, error),
        -float(fitted[0]),
        before / K,
        after / K,
        # A Gaussian of s samples leaves 1/(2 sqrt(pi) s) of the power of white noise.
        noise_A / math.sqrt(max(2.0 * math.sqrt(math.pi) * WIDTH_s * rate_Hz, 1.0)),
        orders,
        apart,
    )


def _motion(m: MeasuredRecord, b: BaseNumbers) -> TorqueMotion:
    assert m.angle_rad is not None  # noqa: S101  only such records are taken
    smoother = Smoother(max(WIDTH_s, 1.0 / m.sampling_Hz), m.sampling_Hz)
    command = m.command_A(b.newtons_per_ampere) * b.newtons_per_ampere * b.drum_radius_m
    torque = smoother.held(command, b.dead_time_s, 1.0)
    angle, velocity = (smoother.sampled(m.angle_rad, *c) for c in ((1.0,), (0.0, 1.0)))
    inside = np.isfinite(torque) & np.isfinite(angle)
    speed = np.abs(velocity[inside])
    # What is five times as fast as usual starts or jumps.
    slow = speed <= 5.0 * max(float(np.median(speed)), 1e-300)
    v = velocity[inside][slow]
    terms = np.column_stack([v, np.sign(v)])
    return TorqueMotion(torque[inside][slow], angle[inside][slow], terms)


def _columns(m: TorqueMotion, orders: Sequence[float], *, moving: bool) -> FloatArray:
    """One, sine and cosine of each order, and where it helps velocity and its sign."""
    waves = [f(order * m.angle_rad) for order in orders for f in (np.sin, np.cos)]
    columns = [np.ones(m.angle_rad.size), *waves, *(m.terms.T if moving else ())]
    return np.column_stack(columns)


def _fitted(parts: Sequence[TorqueMotion], orders: Sequence[float], *, moving: bool) -> FloatArray:
    columns = np.vstack([_columns(m, orders, moving=moving) for m in parts])
    torque = np.concatenate([m.torque_Nm for m in parts])
    coefficients: FloatArray = np.linalg.lstsq(columns, torque, rcond=1e-9)[0]
    return coefficients


def _rest(
    m: TorqueMotion, orders: Sequence[float], fitted: FloatArray, *, moving: bool
) -> FloatArray:
    residual: FloatArray = m.torque_Nm - _columns(m, orders, moving=moving) @ fitted
    return residual


def _left_out(parts: list[TorqueMotion], orders: Sequence[float], *, moving: bool) -> float:
    """Root mean square of what is left in each part by a fit to the others, N m."""
    residuals = []
    for n, part in enumerate(parts):
        others = parts[:n] + parts[n + 1 :]
        residuals.append(
            _rest(part, orders, _fitted(others, orders, moving=moving), moving=moving)
        )
    return float(np.sqrt(np.mean(np.concatenate(residuals) ** 2)))


def _parts(motions: Sequence[TorqueMotion]) -> list[TorqueMotion]:
    """The records; of one alone, three parts of its turns, each with all angles."""
    if len(motions) > 1:
        return list(motions)
    (m,) = motions
    edges = np.linspace(0, m.angle_rad.size, 4).astype(int)
    return [
        TorqueMotion(m.torque_Nm[a:b], m.angle_rad[a:b], m.terms[a:b])
        for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    ]


def _orders(motions: Sequence[TorqueMotion]) -> tuple[float, ...]:
    """Periods a turn of the waves that are worth it, the greatest first; three in a record."""
    extent = max(float(np.ptp(m.angle_rad)) for m in motions)
    angle = np.concatenate([m.angle_rad for m in motions])

    def left(orders: Sequence[float]) -> FloatArray:
        fitted = _fitted(motions, orders, moving=False)
        return np.concatenate([_rest(m, orders, fitted, moving=False) for m in motions])

    orders: tuple[float, ...] = ()
    residual = left(orders)
    for _ in range(WAVES):
        found = per_turn([ResidualOverAngle(angle, residual)], 0.0, 3.0)
        if not found:
            break
        tried = {(*orders, found[0]): left((*orders, found[0]))}
        # Over a turn, the next whole number is meant that takes off nearly as much.
        if extent >= 0.9 * 2.0 * math.pi:
            whole = (*orders, float(round(found[0])))
            tried[whole] = left(whole)
        gained = {added: _power(residual) - _power(rest) for added, rest in tried.items()}
        # The last tried is the whole number.
        most, (last, gain) = max(gained.values()), list(gained.items())[-1]
        added = last if gain >= 0.9 * most else next(iter(tried))
        # Each further wave takes off a tenth of the power left at least.
        if gained[added] < 0.1 * _power(residual) or added[-1] in orders:
            break
        orders, residual = added, tried[added]
    return orders


def _power(residual: FloatArray) -> float:
    return float(np.mean(residual**2))


def _parameters(
    orders: Sequence[float], fitted: FloatArray, error: FloatArray
) -> dict[str, Interval]:
    """Amplitudes, orders and phases of the waves with their intervals."""
    parameters: dict[str, Interval] = {}
    for k in range(WAVES):
        amplitude = phase = half = 0.0
        order = 1.0
        if k < len(orders):
            sine, cosine = fitted[1 + 2 * k], fitted[2 + 2 * k]
            order, amplitude = orders[k], float(np.hypot(sine, cosine))
            phase = float(np.arctan2(cosine, sine))
            half = QUANTILE * float(np.hypot(*error[1 + 2 * k : 3 + 2 * k]))
        low, turn = max(amplitude - half, 0.0), half / max(amplitude, 1e-300)
        parameters[f"amplitude_{k + 1}_Nm"] = Interval(amplitude, low, amplitude + half, "N m")
        parameters[f"per_turn_{k + 1}"] = Interval(order, order, order, "")
        parameters[f"phase_{k + 1}_rad"] = Interval(phase, phase - turn, phase + turn, "rad")
    return parameters
