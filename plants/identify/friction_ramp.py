"""Friction and inertia of a reel from its velocity response to a torque ramp.

The cable is taken off, the motor torque rises steadily from zero, and the drum's angle is recorded
(Kelly & Llamas 1999). The drum rests until the ramp reaches the static friction, breaks away,
passes the Stribeck velocity and ends up following the ramp at a distance that Coulomb friction and
inertia make. Kelly and Llamas read viscous and Coulomb friction off that asymptote. Here the whole
response is fitted,

    J omega' + b omega + f_c + (f_s - f_c) exp(-(omega/v_s)^2) = tau,    omega >= 0,

which is (10) with viscous friction; what the encoder counts is compared with the integral of the
velocity, so that nothing is differentiated. Their asymptote gives the first guess, with
velocities by adaptive windows.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.reel.friction import FeedForward, StribeckFriction
from estune.reel.velocity import Windows, motion
from plants.identify.torque_ramp import LEAST_SAMPLES, RampRecord

NAMES = ("inertia_kgm2", "viscous_Nms_rad", "coulomb_Nm", "excess_Nm", "stribeck_rad_s")
"""What is fitted, as logarithms; the excess is f_s - f_c, so that all are above zero."""

ROAM = np.log((10.0, 3.0, 10.0, 10.0, 10.0))
"""How far the fit may go from a start; less for viscous friction, which the asymptote tells well.

With the starts' least time constant this keeps the integration stable."""


class Estimate(NamedTuple):
    """A fitted value and its confidence interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class FrictionFit:
    """What was found, with confidence intervals at the level asked for.

    Attributes:
        inertia_kgm2: Inertia J of the drum, kg m2.
        viscous_Nms_rad: Viscous friction b, N m s/rad.
        coulomb_Nm: Dynamic Coulomb friction f_c, N m.
        static_Nm: Static friction f_s, N m.
        stribeck_rad_s: Stribeck velocity v_s, rad/s.
        residual_rad: Angle read less angle fitted, after break-away; one array per record.
        residual_counts: Their root mean square in encoder counts; 0.29 is counting alone.
        confidence: Level of the intervals.
    """

    inertia_kgm2: Estimate
    viscous_Nms_rad: Estimate
    coulomb_Nm: Estimate
    static_Nm: Estimate
    stribeck_rad_s: Estimate
    residual_rad: tuple[FloatArray, ...]
    residual_counts: float
    confidence: float

    @property
    def friction(self) -> StribeckFriction:
        """The dry friction, (10)."""
        return StribeckFriction(
            self.coulomb_Nm.value, self.static_Nm.value, self.stribeck_rad_s.value
        )

    def feed_forward(self, fraction: float = 0.8) -> FeedForward:
        """The compensation for this reel; see `estune.reel.friction.FeedForward`."""
        return FeedForward(self.friction, self.inertia_kgm2.value, fraction)


def fit_friction(records: Sequence[RampRecord], confidence: float = 0.95) -> FrictionFit:
    """Fits friction and inertia to one or more ramps of one direction or both.

    The intervals are those of least squares for the logarithms, with errors of the angle that are
    independent from sample to sample. They know of no friction but the model's: bristles so soft
    that the drum creeps by half a count before it breaks away made the inertia 40 % too large.

    Args:
        records: The ramps; several of different slope narrow the intervals.
        confidence: Level of the confidence intervals, between 0 and 1.

    Raises:
        InvalidInput: no record; too few samples below or above the Stribeck velocity; or a static
            friction that does not stand out from the Coulomb friction.
    """
    from scipy.stats import t as t_distribution  # noqa: PLC0415  slow to import

    if not records:
        raise InvalidInput("no ramp record was given; one or more are needed")
    if not 0.0 < confidence < 1.0:
        raise InvalidInput(f"confidence is {confidence}; it must lie between 0 and 1")
    roughly = [_descend(records, start, tolerance=1e-4, steps=150) for start in _starts(records)]
    _, point = min((found.cost, tuple(found.x)) for found in roughly)
    point = _descend(records, np.array(point), tolerance=1e-10, steps=300).x
    parts = [_residual(record, point) for record in records]
    _check_resolved(records, point)
    # Each record's first count takes one degree of freedom, beside the parameters.
    freedom = sum(error.size - 1 for error, _ in parts) - len(NAMES)
    covariance = _covariance(parts, freedom)
    width = float(t_distribution.ppf(0.5 + 0.5 * confidence, freedom))
    fitted = dict(zip(NAMES, np.exp(point).tolist(), strict=True))
    deviations = dict(zip(NAMES, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    if width * deviations["excess_Nm"] > 1.0 or width * deviations["stribeck_rad_s"] > 1.0:
        raise InvalidInput(
            f"static friction does not stand out from the Coulomb friction of "
            f"{fitted['coulomb_Nm']:.3g} N m: f_s - f_c is {fitted['excess_Nm']:.2g} N m times or "
            f"over {math.exp(width * deviations['excess_Nm']):.3g}; use a slower ramp or a finer "
            "encoder, or compensate Coulomb friction alone"
        )
    residuals = tuple(residual for residual, _ in parts)
    squares = [np.mean((e / r.count_rad) ** 2) for e, r in zip(residuals, records, strict=True)]
    intervals = {
        name: Estimate(value, value * math.exp(-s), value * math.exp(s))
        for name, value in fitted.items()
        for s in [width * deviations[name]]
    }
    return FrictionFit(
        inertia_kgm2=intervals["inertia_kgm2"],
        viscous_Nms_rad=intervals["viscous_Nms_rad"],
        coulomb_Nm=intervals["coulomb_Nm"],
        static_Nm=_static(fitted, covariance, width),
        stribeck_rad_s=intervals["stribeck_rad_s"],
        residual_rad=residuals,
        residual_counts=math.sqrt(float(np.mean(squares))),
        confidence=confidence,
    )


def _static(fitted: dict[str, float], covariance: FloatArray, width: float) -> Estimate:
    """f_s = f_c + excess, whose errors are correlated."""
    value = fitted["coulomb_Nm"] + fitted["excess_Nm"]
    slope = np.array([0.0, 0.0, fitted["coulomb_Nm"], fitted["excess_Nm"], 0.0]) / value
    spread = width * math.sqrt(slope @ covariance @ slope)
    return Estimate(value, value * math.exp(-spread), value * math.exp(spread))


@lru_cache(maxsize=8)
def _response(samples: int) -> Any:
    """States of a ramp after each sample but the first, with their slopes in the parameters.

    (state, [ln parameters; step; torque before; torque after]) -> states; a state is angle,
    velocity, and the slopes of both. One Runge-Kutta step of order four per sample; the drum rests
    until the torque overcomes static friction. The slopes are carried along as states.
    """
    point, x = ca.SX.sym("point", len(NAMES)), ca.SX.sym("x", 2)
    before, after, h = ca.SX.sym("before"), ca.SX.sym("after"), ca.SX.sym("h")
    J, b, coulomb, excess, stribeck = ca.vertsplit(ca.exp(point))

    def acceleration(torque: Any, omega: Any) -> Any:
        dry = coulomb + excess * ca.exp(-((omega / stribeck) ** 2))
        return (torque - b * omega - dry) / J

    theta, omega = x[0], x[1]
    middle = 0.5 * (before + after)
    k1 = acceleration(before, omega)
    k2 = acceleration(middle, omega + 0.5 * h * k1)
    k3 = acceleration(middle, omega + 0.5 * h * k2)
    k4 = acceleration(after, omega + h * k3)
    moved = ca.vertcat(
        theta + ca.fmax(0.0, h * omega + h**2 / 6.0 * (k1 + k2 + k3)),
        ca.fmax(0.0, omega + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)),
    )
    slopes = ca.SX.sym("slopes", 2, len(NAMES))
    carried = ca.jacobian(moved, x) @ slopes + ca.jacobian(moved, point)
    step = ca.Function(
        "ramp_step",
        [ca.veccat(x, slopes), ca.vertcat(point, h, before, after)],
        [ca.densify(ca.veccat(moved, carried))],
    )
    return step.mapaccum("ramp", samples - 1)


def _simulate(record: RampRecord, point: FloatArray) -> FloatArray:
    """Angle, velocity and their slopes after break-away, shape (2 + 10, samples)."""
    torque = record.acting_torque_Nm
    inputs = np.empty((len(NAMES) + 3, torque.size - 1))
    inputs[: len(NAMES)] = point[:, None]
    inputs[len(NAMES)] = record.sample_s
    inputs[-2:] = torque[:-1], torque[1:]
    states = _response(torque.size)(np.zeros(2 + 2 * len(NAMES)), inputs)
    return np.asarray(states)[:, record.breakaway_index - 1 :]


def _residual(record: RampRecord, point: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angle read less angle fitted after break-away, and its slopes; both less their means.

    The means stand for the angle of the first count, which is known to within a count only.
    """
    states = _simulate(record, point)
    error = record.turned_rad[record.breakaway_index :] - states[0]
    slopes = -states[2::2].T
    return error - error.mean(), slopes - slopes.mean(axis=0)


def _descend(
    records: Sequence[RampRecord], start: FloatArray, tolerance: float, steps: int
) -> Any:
    """Least squares from a start; residuals and slopes come from one simulation."""
    from scipy.optimize import least_squares  # noqa: PLC0415  slow to import

    @lru_cache(maxsize=2)
    def parts(point: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
        errors, slopes = zip(*(_residual(r, np.array(point)) for r in records), strict=True)
        return np.concatenate(errors), np.vstack(slopes)

    return least_squares(
        lambda point: parts(tuple(point))[0],
        start,
        jac=lambda point: parts(tuple(point))[1],
        x_scale="jac",
        ftol=tolerance,
        xtol=tolerance,
        max_nfev=steps,
        bounds=(start - ROAM, start + ROAM),
    )


def _starts(records: Sequence[RampRecord]) -> list[FloatArray]:
    """Where to begin, as logarithms: the misfit has more than one minimum, mostly along v_s.

    The last third of a ramp of slope a gives b and D = f_c + a J/b, from omega = (tau - D)/b (the
    asymptote of Kelly & Llamas), and break-away gives f_s. What is left open, f_c/f_s, is tried on
    a grid, with the time constant J/b that goes with it or, should the ramp not have come near its
    asymptote, with shares of the time moved. Of each v_s the best beginning is kept.
    """
    viscous, lags, slopes, static, fastest = np.array([_asymptote(r) for r in records]).T
    b, f_s = float(viscous.mean()), float(static.mean())
    least_s = 15.0 * max(record.sample_s for record in records)
    moved_s = max(r.sample_s * (r.time_s.size - r.breakaway_index) for r in records)
    found = []
    for stribeck in fastest.max() * np.geomspace(0.02, 1.2, 6):
        grid = [
            np.log((b * max(constant, least_s), b, share * f_s, (1.0 - share) * f_s, stribeck))
            for share in (0.3, 0.45, 0.6, 0.75, 0.9)
            for constant in (
                float(np.mean((lags - share * f_s) / slopes)),
                *(moved_s * np.array((0.01, 0.03, 0.1))),
            )
        ]
        found.append(min(grid, key=lambda point: _misfit(records, point)))
    return found


def _misfit(records: Sequence[RampRecord], point: FloatArray) -> float:
    """Sum of squared residuals, rad2."""
    return float(sum(np.sum(_residual(record, point)[0] ** 2) for record in records))


def _asymptote(record: RampRecord) -> tuple[float, float, float, float, float]:
    """Viscous friction b, lag D, slope of the ramp, torque at break-away, greatest velocity."""
    late = np.s_[-(record.time_s.size - record.breakaway_index) // 3 :]
    seen = motion(Windows(record.count_rad), record.time_s, record.turned_rad)
    middles = record.time_s - 0.5 * seen.velocity_window_s
    torque = record.acting_torque_Nm
    at_middles = np.interp(middles, record.time_s, torque)
    b, lag = np.polyfit(seen.velocity_rad_s[late], at_middles[late], 1)
    slope = np.polyfit(record.time_s[late], torque[late], 1)[0]
    fastest = float(seen.velocity_rad_s.max())
    # A drum still speeding up at the end tells no viscous friction; a small one is a beginning.
    b = max(float(b), 1e-3 * float(torque[-1]) / fastest)
    return b, float(lag), float(slope), float(torque[record.breakaway_index]), fastest


def _check_resolved(records: Sequence[RampRecord], point: FloatArray) -> None:
    """Refuses ramps that passed the Stribeck velocity too fast, or hardly reached it."""
    stribeck = math.exp(point[-1])
    velocity = np.concatenate([_simulate(record, point)[1] for record in records])
    below = int(np.count_nonzero(velocity < stribeck))
    above = velocity.size - below
    if below < LEAST_SAMPLES:
        raise InvalidInput(
            f"{below} samples lie below the Stribeck velocity of {stribeck:.3g} rad/s and "
            f"{LEAST_SAMPLES} are needed; use a slower ramp or a higher sampling rate"
        )
    if above < LEAST_SAMPLES:
        raise InvalidInput(
            f"{above} samples lie above the Stribeck velocity of {stribeck:.3g} rad/s and "
            f"{LEAST_SAMPLES} are needed; end the ramp higher"
        )


def _covariance(parts: Sequence[tuple[FloatArray, FloatArray]], freedom: int) -> FloatArray:
    """Covariance of the logarithms, s^2 (S'S)^-1 with the slopes S.

    Counting errors of a drum that turns are independent enough from sample to sample: allowing
    for correlation (Newey & West) made the intervals cover less often than they say, not more.
    """
    variance = sum(float(error @ error) for error, _ in parts) / freedom
    try:
        return np.asarray(variance * np.linalg.inv(sum(s.T @ s for _, s in parts)))
    except np.linalg.LinAlgError:
        raise InvalidInput(
            "the ramps do not tell friction and inertia apart; add one of another slope"
        ) from None
