"""Friction and inertia of an unloaded reel from its response to a torque ramp.

The motor torque rises steadily from zero; the drum angle is recorded (Kelly & Llamas 1999).
The drum rests until the ramp reaches the static friction. It then passes the Stribeck velocity
and approaches an asymptote set by Coulomb friction and inertia. Kelly and Llamas take viscous and
Coulomb friction from the asymptote. Here the whole response is fitted,

    J omega' + b omega + f_c + (f_s - f_c) exp(-(omega/v_s)^2) = tau,    omega >= 0,

which is (10) with viscous friction. The encoder's angle is compared with the integral of the
velocity, so that nothing is differentiated. The asymptote gives the initial guess, with velocities
from adaptive windows.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.reel.friction import StribeckFriction
from estune.reel.velocity import Windows, motion
from experiments.paper.identify.estimate import Estimate
from experiments.paper.identify.ramp_response import NAMES, ramp_residual, simulate_ramp
from experiments.paper.identify.torque_ramp import SAMPLES_MIN, RampRecord

SEARCH_RANGE = np.log((10.0, 3.0, 10.0, 10.0, 10.0))
"""Search range about a start; narrow for viscous friction, which the asymptote determines well.

With the lower bound of the starts' time constants it keeps the integration stable."""

UNITS = ("kg m2", "N m s/rad", "N m", "N m", "rad/s")


@dataclass(frozen=True, eq=False)
class FrictionFit:
    """Fitted friction and inertia, with confidence intervals."""

    inertia_kgm2: Estimate  # inertia J of the drum, kg m2
    viscous_Nms_rad: Estimate  # viscous friction b, N m s/rad
    coulomb_Nm: Estimate  # dynamic Coulomb friction f_c, N m
    static_Nm: Estimate  # static friction f_s, N m
    stribeck_rad_s: Estimate  # stribeck velocity v_s, rad/s
    # Measured less fitted angle after break-away, rms in counts; quantisation alone gives 0.29.
    residual_counts: float
    confidence: float  # level of the intervals

    @property
    def friction(self) -> StribeckFriction:
        """The dry friction, (10)."""
        return StribeckFriction(
            self.coulomb_Nm.value, self.static_Nm.value, self.stribeck_rad_s.value
        )


def fit_friction(records: Sequence[RampRecord], confidence: float = 0.95) -> FrictionFit:
    """Fits friction and inertia to one or more ramps of one direction or both.

    The intervals are those of least squares for the logarithms, with independent errors of the
    angle. They ignore errors of the friction model: presliding of half a count before break-away
    made the inertia 40 % too large.

    Args:
        records: The ramps; several of different slope narrow the intervals.
        confidence: Level of the confidence intervals, between 0 and 1.

    Raises:
        InvalidInput: no record; too few samples below or above the Stribeck velocity; or a static
            friction that is not significantly above the Coulomb friction.
    """
    from scipy.special import stdtrit  # noqa: PLC0415  slow to import

    if not records:
        raise InvalidInput("no ramp record was given; one or more are needed")
    if not 0.0 < confidence < 1.0:
        raise InvalidInput(f"confidence is {confidence}; it must lie between 0 and 1")
    coarse = [_descend(records, start, tolerance=1e-4, steps=150) for start in _starts(records)]
    _, point = min((fit.cost, tuple(fit.x)) for fit in coarse)
    point = _descend(records, np.array(point), tolerance=1e-10, steps=300).x
    parts = [ramp_residual(record, point) for record in records]
    _check_resolved(records, point)
    # Each record's first count takes one degree of freedom, beside the parameters.
    freedom = sum(error.size - 1 for error, _ in parts) - len(NAMES)
    covariance = _covariance(parts, freedom)
    width = float(stdtrit(freedom, 0.5 + 0.5 * confidence))
    fitted = dict(zip(NAMES, np.exp(point).tolist(), strict=True))
    deviations = dict(zip(NAMES, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    if width * deviations["excess_Nm"] > 1.0 or width * deviations["stribeck_rad_s"] > 1.0:
        raise InvalidInput(
            f"static friction is not significantly above the Coulomb friction of "
            f"{fitted['coulomb_Nm']:.3g} N m: f_s - f_c is {fitted['excess_Nm']:.2g} N m times or "
            f"over {math.exp(width * deviations['excess_Nm']):.3g}; use a slower ramp or a finer "
            "encoder, or compensate Coulomb friction alone"
        )
    squares = [np.mean((e / r.count_rad) ** 2) for (e, _), r in zip(parts, records, strict=True)]
    intervals = {
        name: Estimate.log_normal(value, deviations[name], width, unit)
        for (name, value), unit in zip(fitted.items(), UNITS, strict=True)
    }
    return FrictionFit(
        inertia_kgm2=intervals["inertia_kgm2"],
        viscous_Nms_rad=intervals["viscous_Nms_rad"],
        coulomb_Nm=intervals["coulomb_Nm"],
        static_Nm=_static(fitted, covariance, width),
        stribeck_rad_s=intervals["stribeck_rad_s"],
        residual_counts=math.sqrt(float(np.mean(squares))),
        confidence=confidence,
    )


def _static(fitted: dict[str, float], covariance: FloatArray, width: float) -> Estimate:
    """Static friction f_s = f_c + excess, with correlated errors."""
    value = fitted["coulomb_Nm"] + fitted["excess_Nm"]
    slope = np.array([0.0, 0.0, fitted["coulomb_Nm"], fitted["excess_Nm"], 0.0]) / value
    return Estimate.log_normal(value, math.sqrt(slope @ covariance @ slope), width, "N m")


def _descend(
    records: Sequence[RampRecord], start: FloatArray, tolerance: float, steps: int
) -> Any:
    """Least squares from a start; one simulation gives residuals and sensitivities."""
    from scipy.optimize import least_squares  # noqa: PLC0415  slow to import

    @lru_cache(maxsize=2)
    def parts(point: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
        errors, slopes = zip(*(ramp_residual(r, np.array(point)) for r in records), strict=True)
        return np.concatenate(errors), np.vstack(slopes)

    return least_squares(
        lambda point: parts(tuple(point))[0],
        start,
        jac=lambda point: parts(tuple(point))[1],
        x_scale="jac",
        ftol=tolerance,
        xtol=tolerance,
        max_nfev=steps,
        bounds=(start - SEARCH_RANGE, start + SEARCH_RANGE),
    )


def _starts(records: Sequence[RampRecord]) -> list[FloatArray]:
    """Initial guesses, as logarithms: the misfit has several minima, mostly along v_s.

    The last third of a ramp of slope a gives b and D = f_c + a J/b, from omega = (tau - D)/b (the
    asymptote of Kelly & Llamas), and break-away gives f_s. A grid of f_c/f_s is tried, with its
    time constant J/b and, in case the ramp ended far from its asymptote, with shares of the time
    in motion. The best guess for each v_s is returned.
    """
    viscous, lags, slopes, static, fastest = np.array([_asymptote(r) for r in records]).T
    b, f_s = float(viscous.mean()), float(static.mean())
    least_s = 15.0 * max(record.sample_s for record in records)
    moved_s = max(r.sample_s * (r.time_s.size - r.breakaway_index) for r in records)
    starts = []
    for stribeck in fastest.max() * np.geomspace(0.02, 1.2, 6):
        grid = [
            np.log((b * max(constant, least_s), b, share * f_s, (1.0 - share) * f_s, stribeck))
            for share in (0.3, 0.45, 0.6, 0.75, 0.9)
            for constant in (
                float(np.mean((lags - share * f_s) / slopes)),
                *(moved_s * np.array((0.01, 0.03, 0.1))),
            )
        ]
        starts.append(min(grid, key=lambda point: _misfit(records, point)))
    return starts


def _misfit(records: Sequence[RampRecord], point: FloatArray) -> float:
    """Sum of squared residuals, rad2."""
    return float(sum(np.sum(ramp_residual(record, point)[0] ** 2) for record in records))


def _asymptote(record: RampRecord) -> tuple[float, float, float, float, float]:
    """Viscous friction b, lag D, slope of the ramp, torque at break-away, greatest velocity."""
    late = np.s_[-(record.time_s.size - record.breakaway_index) // 3 :]
    estimated = motion(Windows(record.count_rad), record.time_s, record.turned_rad)
    middles = record.time_s - 0.5 * estimated.velocity_window_s
    torque = record.acting_torque_Nm
    at_middles = np.interp(middles, record.time_s, torque)
    b, lag = np.polyfit(estimated.velocity_rad_s[late], at_middles[late], 1)
    slope = np.polyfit(record.time_s[late], torque[late], 1)[0]
    fastest = float(estimated.velocity_rad_s.max())
    # A drum still accelerating at the end shows no viscous friction: start from a small value.
    b = max(float(b), 1e-3 * float(torque[-1]) / fastest)
    return b, float(lag), float(slope), float(torque[record.breakaway_index]), fastest


def _check_resolved(records: Sequence[RampRecord], point: FloatArray) -> None:
    """Checks that the ramps resolve the Stribeck velocity."""
    stribeck = math.exp(point[-1])
    velocity = np.concatenate([simulate_ramp(record, point)[1] for record in records])
    below = int(np.count_nonzero(velocity < stribeck))
    above = velocity.size - below
    if below < SAMPLES_MIN:
        raise InvalidInput(
            f"{below} samples lie below the Stribeck velocity of {stribeck:.3g} rad/s and "
            f"{SAMPLES_MIN} are needed; use a slower ramp or a higher sampling rate"
        )
    if above < SAMPLES_MIN:
        raise InvalidInput(
            f"{above} samples lie above the Stribeck velocity of {stribeck:.3g} rad/s and "
            f"{SAMPLES_MIN} are needed; end the ramp higher"
        )


def _covariance(parts: Sequence[tuple[FloatArray, FloatArray]], freedom: int) -> FloatArray:
    """Covariance of the logarithms, s^2 (S'S)^-1 with the sensitivities S.

    Quantisation errors of a turning drum are nearly independent: allowing for correlation (Newey &
    West) lowered the coverage of the intervals.
    """
    variance = sum(float(error @ error) for error, _ in parts) / freedom
    try:
        return np.asarray(variance * np.linalg.inv(sum(s.T @ s for _, s in parts)))
    except np.linalg.LinAlgError:
        raise InvalidInput(
            "the ramps do not separate friction from inertia; add one of another slope"
        ) from None
