"""From the readings of the two-reel procedure to B, C_R and the gauge of Y, and how sure they are.

Each sweep over the setpoints is one estimate of the friction curve; their mean is the result, and
Student's interval of their scatter says how well it is known. So the interval holds for noise and
for friction that scatters from one approach to the next, whatever their size at each tension, as
long as sweeps are independent of one another; whether they drift is tested.

What no measurement of this kind can tell is whether the reels are alike. The cable passes both
eyelets in series, so that only `B_X B_Y` shows: with unequal reels, B is their geometric mean.
`plants.two_reel_bench.reel_comparison` tells it from two measurements with different angles.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.reel.calibration import GaugeCalibration
from plants.identify.estimate import Estimate
from plants.two_reel_bench.friction_ratio import friction_coefficient
from plants.two_reel_bench.index import WEBER_LIMIT, StaticTransparency, static_transparency
from plants.two_reel_bench.mean_estimate import (
    SIGNIFICANCE_LEVEL,
    mean_estimate,
    student_quantile,
    two_sided_p_value,
)
from plants.two_reel_bench.procedure import LEAST_SETPOINTS, LEAST_SWEEPS, SetpointReadings

RESOLVED_PROBABILITY = 0.999
"""How sure a result must be to lie within the tolerance for it to be called resolved."""

_LEAST_B = 1e-6


class FrictionCurve(NamedTuple):
    """Loss of tension per eyelet against tension, `F_R = c + a T + b T^2`: B = 1 - a - b T.

    Coulomb's law has b = 0. The constant c is no friction but what stands in its way: a zero of
    X's gauge, or a cable that was not quite on the verge of sliding. Left out of the curve, it
    would be taken for friction.

    Attributes:
        constant_N: c, N.
        linear: a.
        quadratic: b, 1/N.
        constant_p_value: How likely chance alone would make c differ so much from zero.
        quadratic_p_value: How likely chance alone would make b differ so much from zero.
    """

    constant_N: Estimate
    linear: Estimate
    quadratic: Estimate
    constant_p_value: float
    quadratic_p_value: float

    @property
    def follows_coulomb(self) -> bool:
        """Whether the measurement does not contradict Coulomb's law."""
        return self.quadratic_p_value >= SIGNIFICANCE_LEVEL

    def ratio(self, tension_N: FloatArray) -> FloatArray:
        """B at tensions inside the reel, N."""
        return np.asarray(1.0 - self.linear.value - self.quadratic.value * tension_N)


@dataclass(frozen=True, slots=True, eq=False)
class TwoReelResult:
    """What the two-reel procedure found. Arrays have shape (sweeps, setpoints).

    Attributes:
        attenuation: Attenuation ratio B at the mean tension.
        friction_coefficient: Friction coefficient C_R there.
        mean_tension_N: Mean of all tensions at which friction acted, N.
        resolved: Whether C_R is known to within the tolerance.
        sweeps_needed: Sweeps after which it should be, by their present scatter; None where no
            number of sweeps would do.
        warnings: What stands in the way, or should be known; with what to do about it.
        curve: Loss of tension against tension.
        setpoint_N: Tensions commanded, N, shape (setpoints,).
        tension_N: Mean tension at which friction acted at each setpoint, N, shape (setpoints,).
        ratios: Attenuation ratios `(x_2/x_1)^(1/4)`: the data of Fig. 7.
        reading_y: Readings of Y's gauge, in its own unit.
        tension_y_N: Tension at Y's gauge at these readings, N.
        probability: Of the intervals.
        angles_x_rad: Angle gamma of each contact at X, rad.
        angles_y_rad: Angle gamma of each contact at Y, rad.
    """

    attenuation: Estimate
    friction_coefficient: Estimate
    mean_tension_N: float
    resolved: bool
    sweeps_needed: int | None
    warnings: tuple[str, ...]
    curve: FrictionCurve
    setpoint_N: FloatArray
    tension_N: FloatArray
    ratios: FloatArray
    reading_y: FloatArray
    tension_y_N: FloatArray
    probability: float
    angles_x_rad: tuple[float, ...]
    angles_y_rad: tuple[float, ...]

    def ratio_at_setpoints(self) -> tuple[Estimate, ...]:
        """B at each setpoint on its own, without assuming a curve: Fig. 7 with its bars."""
        return tuple(
            mean_estimate(self.ratios[:, k], self.probability) for k in range(self.ratios.shape[1])
        )

    def calibration_y(self, margin: float = 0.0) -> GaugeCalibration:
        """The gauge of Y, from its readings and the tension at them.

        The print takes `y_2 = B x_2`, but the tension at Y when it reads x_1 is `B^2 x_1`, which
        is `x_2/B^2`, and `sqrt(x_1 x_2)` without knowing B; that is what stands here, times
        `sqrt(B(x_1)/B(x_2))` where B changes with tension.

        Each reading is moved along the curve to the mean tension of its setpoint, so that the
        sweeps are repeats, and the calibration can test its form against their scatter.

        Args:
            margin: Share of the range by which it may be used beyond either end.

        Raises:
            InvalidInput: the readings do not rise, or fall, throughout.
        """
        middle = float(self.tension_y_N.mean())
        slopes = np.polyder(
            np.polyfit(self.tension_y_N.ravel() - middle, self.reading_y.ravel(), 2)
        )
        at = np.broadcast_to(self.tension_y_N.mean(axis=0), self.tension_y_N.shape)
        moved = np.polyval(slopes, 0.5 * (self.tension_y_N + at) - middle) * (
            at - self.tension_y_N
        )
        return GaugeCalibration.fit(at.ravel(), (self.reading_y + moved).ravel(), margin=margin)

    def transparency(self, limit: float = WEBER_LIMIT) -> StaticTransparency:
        """Static transparency (27) to (29), from B at each setpoint."""
        found = self.ratio_at_setpoints()
        columns = np.array([(e.value, e.low, e.high) for e in found])
        value, low, high = np.clip(columns, _LEAST_B, 1.0).T
        return static_transparency(value, low, high, limit)


def evaluate(
    measurements: Sequence[SetpointReadings],
    angles_x_rad: Sequence[float],
    angles_y_rad: Sequence[float] | None = None,
    *,
    angle_error_rad: float = 0.0,
    tolerance: float = 0.02,
    probability: float = 0.95,
) -> TwoReelResult:
    """Evaluates the readings of the two-reel procedure.

    Args:
        measurements: What `TwoReelProcedure.run` returned; every sweep with all setpoints.
        angles_x_rad: Angle gamma of each contact between gauge and free cable at X, rad.
        angles_y_rad: The same at Y; None if they are those of X.
        angle_error_rad: Standard uncertainty of the angles, common to all, rad.
        tolerance: Relative error of C_R that still counts as resolved.
        probability: Of the intervals.

    Raises:
        InvalidInput: too few measurements, sweeps that differ in their setpoints, readings that
            are not above zero, or angles or limits out of their range.
    """
    for name, value in (("tolerance", tolerance), ("probability", probability)):
        if not 0.0 < value < 1.0:
            raise InvalidInput(f"{name} is {value}; it must lie between 0 and 1")
    if not (np.isfinite(angle_error_rad) and angle_error_rad >= 0.0):
        raise InvalidInput(f"angle_error_rad is {angle_error_rad}; it must be zero or above")
    angles_x = tuple(map(float, angles_x_rad))
    angles_y = angles_x if angles_y_rad is None else tuple(map(float, angles_y_rad))
    table = _table(measurements)
    setpoint, x_1, y_1 = table[0, :, 0], table[..., 2], table[..., 3]
    x_2 = _at_same_reading(table)
    ratios = np.asarray((x_2 / x_1) ** 0.25)
    # Friction acts four times, with x_1, B^2 x_1 twice and B^4 x_1 inside.
    tension = 0.25 * x_1 * (1.0 + ratios**2) ** 2
    fits = np.array([_curve_of(T, (1.0 - B) * T) for T, B in zip(tension, ratios, strict=True)])
    middle = float(tension.mean())
    per_sweep = 1.0 - fits @ np.array([0.0, 1.0, middle])
    B = mean_estimate(per_sweep, probability)
    C, error = _coefficient(
        B, (*angles_x, *angles_y), angle_error_rad, per_sweep.size, probability
    )
    remarks = _remarks(B, C, error, tolerance, per_sweep)
    curve = _friction_curve(fits, probability)
    return TwoReelResult(
        attenuation=B,
        friction_coefficient=C,
        mean_tension_N=middle,
        resolved=not remarks,
        sweeps_needed=error.sweeps_needed(tolerance * C.value),
        warnings=(*remarks, *_notes(curve, middle)),
        curve=curve,
        setpoint_N=setpoint,
        tension_N=tension.mean(axis=0),
        ratios=ratios,
        reading_y=y_1,
        tension_y_N=np.sqrt(x_1 * x_2 * curve.ratio(x_1) / curve.ratio(x_2)),
        probability=probability,
        angles_x_rad=angles_x,
        angles_y_rad=angles_y,
    )


def _table(measurements: Sequence[SetpointReadings]) -> FloatArray:
    """The measurements, shape (sweeps, setpoints, 6), setpoints rising."""
    rows = sorted(measurements, key=lambda m: (m.sweep, m.setpoint_N))
    sweeps, setpoints = len({m.sweep for m in rows}), len({m.setpoint_N for m in rows})
    if sweeps < LEAST_SWEEPS:
        raise InvalidInput(
            f"{sweeps} sweeps cannot tell scatter from friction; take {LEAST_SWEEPS} or more"
        )
    if setpoints < LEAST_SETPOINTS:
        raise InvalidInput(f"{setpoints} setpoints; {LEAST_SETPOINTS} or more are needed")
    if len(rows) != sweeps * setpoints:
        raise InvalidInput(
            f"{len(rows)} measurements are not {sweeps} whole sweeps of {setpoints} setpoints; "
            "leave out the broken ones"
        )
    table = np.array(rows, dtype=np.float64).reshape(sweeps, setpoints, len(SetpointReadings._fields))
    if not np.isfinite(table).all():
        raise InvalidInput("a measurement is not finite; leave out its sweep")
    if np.ptp(table[..., 0], axis=0).any() or np.ptp(table[..., 1], axis=1).any():
        raise InvalidInput(
            "the sweeps differ in their setpoints; leave out those that are not whole"
        )
    if not (table[..., [2, 4]] > 0.0).all():
        raise InvalidInput("a tension read at X is not above zero; set its gauge's zero")
    return table


def _at_same_reading(table: FloatArray) -> FloatArray:
    """x_2 as it would be had Y's controller kept the very reading y_1.

    At a reading that is higher by d, the tension at Y is higher by as much as X has to pull more,
    d dx_1/dy, and x_2 in proportion.
    """
    x_1, y_1, x_2, y_2 = np.moveaxis(table[..., 2:], -1, 0)
    middle, scale = float(y_1.mean()), float(np.ptp(y_1))
    if scale == 0.0:
        raise InvalidInput("reel Y read the same at every setpoint; check its gauge")
    curve = np.polyfit((y_1.ravel() - middle) / scale, x_1.ravel(), 2)
    between = (0.5 * (y_1 + y_2) - middle) / scale
    missing = np.polyval(np.polyder(curve), between) / scale * (y_1 - y_2)
    far = np.abs(missing) > 0.2 * x_1
    if far.any():
        raise InvalidInput(
            f"reel Y read {y_2[far][0]:.4g} when it was to pull to {y_1[far][0]:.4g}, too far off "
            "to correct for; let it settle longer, or tune its tension controller"
        )
    return np.asarray(x_2 * x_1 / (x_1 - missing))


def _curve_of(tension_N: FloatArray, loss_N: FloatArray) -> FloatArray:
    """c, a and b of `F_R = c + a T + b T^2`, by least squares."""
    scale = tension_N.max()
    t = tension_N / scale
    found, *_ = np.linalg.lstsq(np.stack([t**0, t, t**2], axis=1), loss_N, rcond=None)
    return np.asarray(found / np.array([1.0, scale, scale**2]))


def _friction_curve(fits: FloatArray, probability: float) -> FrictionCurve:
    """The mean curve of all sweeps."""
    c, a, b = (
        mean_estimate(column, probability, unit)
        for column, unit in zip(fits.T, ("N", "", "1/N"), strict=True)
    )
    by_chance = (two_sided_p_value(e.value, e.standard_error, len(fits) - 1) for e in (c, b))
    return FrictionCurve(c, a, b, *by_chance)


def _notes(curve: FrictionCurve, middle_N: float) -> list[str]:
    """What should be known beside C_R."""
    said = []
    if not curve.follows_coulomb:
        said.append(
            f"friction does not follow Coulomb's law: B changes by {-curve.quadratic.value:.2g} "
            f"per N, and B and C_R hold at {middle_N:.3g} N; set the setpoints about the tension "
            "that matters"
        )
    if curve.constant_p_value < SIGNIFICANCE_LEVEL:
        said.append(
            f"the loss of tension has a part of {curve.constant_N.value:.2g} N that does not grow "
            "with tension and was left out: check the zero of X's gauge, and hold by breakout"
        )
    return said


class _Uncertainty(NamedTuple):
    """Standard errors of C_R: from the scatter of the sweeps, and from the angles."""

    scatter: float
    angle: float
    sweeps: int

    def half_width(self, probability: float) -> float:
        """Half width of an interval."""
        from scipy.special import ndtri  # noqa: PLC0415  slow to import

        normal = float(ndtri(0.5 + 0.5 * probability))
        return float(
            np.hypot(student_quantile(probability, self.sweeps - 1) * self.scatter, normal * self.angle)
        )

    def sweeps_needed(self, half_width: float) -> int | None:
        """Sweeps that would make the promised interval as narrow as this, None if none would."""
        left = half_width**2 - _Uncertainty(0.0, self.angle, self.sweeps).half_width(RESOLVED_PROBABILITY) ** 2
        if left <= 0.0:
            return None
        one_sweep = self.scatter * float(np.sqrt(self.sweeps / left))
        count = max(LEAST_SWEEPS, int((student_quantile(RESOLVED_PROBABILITY, 10**9) * one_sweep) ** 2))
        while student_quantile(RESOLVED_PROBABILITY, count - 1) * one_sweep > np.sqrt(count):
            count += 1
        return count


def _coefficient(
    B: Estimate,
    angles_rad: tuple[float, ...],
    angle_error_rad: float,
    sweeps: int,
    probability: float,
) -> tuple[Estimate, _Uncertainty]:
    """C_R from B of two reels, whose contacts lie one after the other."""
    angles = np.array(angles_rad)

    def coefficient(ratio: float, turn: float = 0.0) -> float:
        ratio = min(max(ratio, _LEAST_B), 1.0)
        return float(friction_coefficient(ratio**2, *np.clip(angles + turn, 0.0, np.pi)))

    value, step = coefficient(B.value), B.standard_error
    # Towards smaller ratios alone, as there are none beyond 1.
    scatter = coefficient(min(B.value, 1.0) - step) - value
    bent = np.clip(angles + angle_error_rad, 0.0, np.pi)
    if np.pi - bent.min() <= angle_error_rad:
        raise InvalidInput(
            f"angles {angles_rad} rad are straight to within their uncertainty of "
            f"{angle_error_rad:g} rad: friction cannot be told, bend the cable more"
        )
    turned = 0.5 * (coefficient(B.value, angle_error_rad) - coefficient(B.value, -angle_error_rad))
    error = _Uncertainty(scatter, abs(turned), sweeps)
    half = error.half_width(probability)
    total = float(np.hypot(error.scatter, error.angle))
    return Estimate(value, total, max(value - half, 0.0), value + half, ""), error


def _remarks(
    B: Estimate, C: Estimate, error: _Uncertainty, tolerance: float, per_sweep: FloatArray
) -> list[str]:
    """Why C_R is not resolved, and what to do."""
    said = []
    half = error.half_width(RESOLVED_PROBABILITY)
    if B.value + student_quantile(RESOLVED_PROBABILITY, error.sweeps - 1) * B.standard_error >= 1.0:
        said.append(
            f"the loss 1 - B of {1.0 - B.value:.2g} does not stand out from its scatter of "
            f"{B.standard_error:.2g}: no friction can be told; bend the cable more, raise the "
            "setpoints, or let the gauges warm up"
        )
    elif half > tolerance * C.value:
        what = f"C_R is known to {100.0 * half / C.value:.2g} %, not {100.0 * tolerance:.2g} %"
        needed = error.sweeps_needed(tolerance * C.value)
        said.append(
            f"{what}, for the angles; measure them better, or bend the cable more"
            if needed is None
            else f"{what}; take about {needed} sweeps, read for longer, or bend the cable more"
        )
    order = np.arange(per_sweep.size, dtype=np.float64)
    order -= order.mean()
    slope = float(order @ per_sweep / (order @ order))
    rest = per_sweep - per_sweep.mean() - slope * order
    spread = float(np.sqrt(rest @ rest / (per_sweep.size - 2) / (order @ order)))
    if two_sided_p_value(slope, spread, per_sweep.size - 2) < SIGNIFICANCE_LEVEL:
        said.append(
            f"B drifts by {slope:.2g} per sweep, so that the intervals do not hold; let gauges "
            "and eyelets settle, and measure again"
        )
    return said
