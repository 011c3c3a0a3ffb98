"""Waves over the angle in the current that a drive's motion takes.

A drive that turns slowly in a velocity loop shows its cogging in the current, hardly in the
motion: a prediction of the motion from the current is then as uncertain as the difference of two
large torques. The other way round,

    K_t i = J a + b v + F sign(v) + tau_0 + sum A_k sin(N_k theta + phi_k),

the current is predicted from the motion, where it is slow. J is the model's: at a steady speed the
acceleration over the angle is a wave, too, and no fit could tell it from cogging. Where the
acceleration is noise more than motion, or the friction shows nothing, data left out are predicted
better without. The waves are found one after the other, each the one that takes off the most
(orthogonal matching pursuit, Pati et al. 1993); what they are worth is judged on records, or
thirds of one, that they were not fitted to.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.smoothing import Smoother
from plants.diagnosis.interval import Interval
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.residual.angle_periods import ResidualOverAngle, per_turn
from plants.effects.cogging import WAVES
from plants.effects.plant_scale import PlantScale


class TorqueMotion(NamedTuple):
    """Current, angle and the terms of the motion in one record, each of shape (samples,)."""

    torque_Nm: FloatArray
    inertial_Nm: FloatArray  # of the model's inertia
    angle_rad: FloatArray
    terms: FloatArray  # velocity and its sign, shape (samples, 2)

    def between(self, first: int, last: int) -> "TorqueMotion":
        """The samples from one to another."""
        return TorqueMotion(*(column[first:last] for column in self))


class CurrentLaw(NamedTuple):
    """What a current is predicted from.

    Attributes:
        orders: Periods a turn of the waves.
        moving: Whether friction is part of it.
        accelerating: Whether the model's inertia is.
    """

    orders: tuple[float, ...]
    moving: bool = False
    accelerating: bool = False

    def columns(self, m: TorqueMotion) -> FloatArray:
        """One, sine and cosine of each order, and velocity and its sign."""
        waves = [f(order * m.angle_rad) for order in self.orders for f in (np.sin, np.cos)]
        return np.column_stack(
            [np.ones(m.angle_rad.size), *waves, *(m.terms.T if self.moving else ())]
        )

    def torque_Nm(self, m: TorqueMotion) -> FloatArray:
        """The torque that its columns explain."""
        return m.torque_Nm - m.inertial_Nm if self.accelerating else m.torque_Nm

    def fitted(self, parts: Sequence[TorqueMotion]) -> FloatArray:
        """Its coefficients by least squares, shape (columns,)."""
        columns = np.vstack([self.columns(m) for m in parts])
        torque = np.concatenate([self.torque_Nm(m) for m in parts])
        coefficients: FloatArray = np.linalg.lstsq(columns, torque, rcond=1e-9)[0]
        return coefficients

    def residual(self, m: TorqueMotion, fitted: FloatArray) -> FloatArray:
        """What it leaves of the torque, N m."""
        unexplained: FloatArray = self.torque_Nm(m) - self.columns(m) @ fitted
        return unexplained

    def left_out(self, parts: list[TorqueMotion]) -> float:
        """Root mean square residual of each part after a fit to the others, N m."""
        residuals = [
            self.residual(part, self.fitted(parts[:n] + parts[n + 1 :]))
            for n, part in enumerate(parts)
        ]
        return float(np.sqrt(np.mean(np.concatenate(residuals) ** 2)))


class TorqueWaves(NamedTuple):
    """Waves that explain a current over the angle.

    Attributes:
        parameters: Those of `Cogging`, with their intervals.
        offset_Nm: The constant torque of the drive beside them.
        before_A: Root mean square of the current that inertia and friction leave, on data left
            out.
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

    def sentence(self, scale: PlantScale) -> str:
        """What they explain, in the plant's own words and units."""
        effort = "current" if scale.unit("A") == "A" else "effort"
        before, after = (scale.amount(rms, "A") for rms in (self.before_A, self.after_A))
        sentence = (
            f"Over the {scale.along} it explains {self.share:.0%} of the {effort} that inertia "
            f"and friction do not, on data left out: {before} rms, of which {after} are left in "
            f"slow motion, {self.after_A / self.noise_A:.2g} times its noise."
        )
        if self.held_A is not None:
            before, after = (scale.amount(rms, "A") for rms in self.held_A)
            sentence += f" On the held-out records {after} of {before}."
        return (
            f"{sentence} The motion itself is not predicted: short predictions stay as they are."
        )


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
    motions = _motions(measurements, first)
    if not motions:
        return None
    orders = _orders(motions)
    if not orders:
        return None
    parts = _parts(motions)
    K = first.newtons_per_ampere * first.drum_radius_m
    # The current is compared with a law of inertia and friction alone.
    before, plain = _best((), parts)
    after, law = _best(orders, parts)
    fitted = law.fitted(parts)
    shifts = [law.fitted(parts[:n] + parts[n + 1 :]) - fitted for n in range(len(parts))]
    error = np.sqrt((len(parts) - 1.0) / len(parts) * np.sum(np.square(shifts), axis=0))
    if law.accelerating:
        by_inertia = fitted - law._replace(accelerating=False).fitted(parts)
        error = np.hypot(error, CONSTANTS.inertia_sd * by_inertia)
    aside = _motions(held, first)
    apart = None
    if aside:
        alone = plain.fitted(parts)
        without, residual = (
            np.concatenate([tried.residual(m, values) for m in aside])
            for tried, values in ((plain, alone), (law, fitted))
        )
        apart = math.sqrt(_power(without)) / K, math.sqrt(_power(residual)) / K
    return TorqueWaves(
        _parameters(orders, fitted, error),
        -float(fitted[0]),
        before / K,
        after / K,
        # A Gaussian of s samples leaves 1/(2 sqrt(pi) s) of the power of white noise.
        noise_A / math.sqrt(2.0 * math.sqrt(math.pi) * CONSTANTS.slow),
        orders,
        apart,
    )


def _best(orders: tuple[float, ...], parts: list[TorqueMotion]) -> tuple[float, CurrentLaw]:
    """The law of some waves that predicts data left out best, and what it leaves, N m rms."""
    laws = [CurrentLaw(orders, m, a) for m in (False, True) for a in (False, True)]
    return min((law.left_out(parts), law) for law in laws)


def _motions(measurements: Sequence[MeasuredRecord], b: BaseNumbers) -> list[TorqueMotion]:
    angles = [(m, m.angle_rad) for m in measurements if m.angle_rad is not None]
    motions = [_motion(m, angle, b) for m, angle in angles]
    return [motion for motion in motions if motion.angle_rad.size]


def _motion(m: MeasuredRecord, angle_rad: FloatArray, b: BaseNumbers) -> TorqueMotion:
    smoother = Smoother(CONSTANTS.slow / m.sampling_Hz, m.sampling_Hz)
    command = m.command_A(b.newtons_per_ampere) * b.newtons_per_ampere * b.drum_radius_m
    torque = smoother.held(command, b.dead_time_s, 1.0)
    orders = (1.0,), (0.0, 1.0), (0.0, 0.0, b.drum_inertia_kg_m2)
    angle, velocity, inertial = (smoother.sampled(angle_rad, *c) for c in orders)
    inside = np.isfinite(torque) & np.isfinite(angle)
    speed = np.abs(velocity[inside])
    # Motion far above the usual speed is a start or a jump.
    slow = speed <= CONSTANTS.clear * max(float(np.median(speed)) if speed.size else 0.0, 1e-300)
    v = velocity[inside][slow]
    terms = np.column_stack([v, np.sign(v)])
    torque, inertial, angle = (column[inside][slow] for column in (torque, inertial, angle))
    return TorqueMotion(torque, inertial, angle, terms)


def _parts(motions: Sequence[TorqueMotion]) -> list[TorqueMotion]:
    """The records; of one alone, three parts of its turns, each with all angles."""
    if len(motions) > 1:
        return list(motions)
    (m,) = motions
    edges = np.linspace(0, m.angle_rad.size, 4).astype(int)
    return [m.between(a, b) for a, b in itertools.pairwise(edges.tolist())]


def _orders(motions: Sequence[TorqueMotion]) -> tuple[float, ...]:
    """Periods a turn of the waves that explain enough, the greatest first."""
    extent = max(float(np.ptp(m.angle_rad)) for m in motions)
    angle = np.concatenate([m.angle_rad for m in motions])

    def residual_of(orders: Sequence[float]) -> FloatArray:
        law = CurrentLaw(tuple(orders))
        fitted = law.fitted(motions)
        return np.concatenate([law.residual(m, fitted) for m in motions])

    orders: tuple[float, ...] = ()
    residual = residual_of(orders)
    for _ in range(WAVES):
        best = per_turn([ResidualOverAngle(angle, residual)], 0.0, 3.0)
        if not best:
            break
        tried = {(*orders, best[0]): residual_of((*orders, best[0]))}
        # Over a whole turn the nearest integer is used if it explains nearly as much.
        if extent >= 2.0 * math.pi:
            whole = (*orders, float(round(best[0])))
            tried[whole] = residual_of(whole)
        gained = {added: _power(residual) - _power(rest) for added, rest in tried.items()}
        # The last tried is the whole number.
        most, (last, gain) = max(gained.values()), list(gained.items())[-1]
        added = last if gain >= (1.0 - CONSTANTS.small) * most else next(iter(tried))
        # Each further wave takes off more than a small share of the power left.
        if gained[added] < CONSTANTS.small * _power(residual) or added[-1] in orders:
            break
        orders, residual = added, tried[added]
    return orders


def _power(residual: FloatArray) -> float:
    return float(np.mean(residual**2))


def _parameters(
    orders: Sequence[float], fitted: FloatArray, error: FloatArray
) -> dict[str, Interval]:
    parameters: dict[str, Interval] = {}
    for k, order in enumerate(orders):
        sine, cosine = fitted[1 + 2 * k], fitted[2 + 2 * k]
        amplitude, phase = float(np.hypot(sine, cosine)), float(np.arctan2(cosine, sine))
        half = CONSTANTS.quantile * float(np.hypot(*error[1 + 2 * k : 3 + 2 * k]))
        low, turn = max(amplitude - half, 0.0), half / max(amplitude, 1e-300)
        parameters[f"amplitude_{k + 1}_Nm"] = Interval(amplitude, low, amplitude + half, "N m")
        parameters[f"per_turn_{k + 1}"] = Interval(order, order, order, "")
        parameters[f"phase_{k + 1}_rad"] = Interval(phase, phase - turn, phase + turn, "rad")
    return parameters
