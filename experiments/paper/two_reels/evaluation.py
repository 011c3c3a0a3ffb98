"""Evaluation of the two-reel procedure: B, C_R and the gauge of Y, with confidence intervals.

Each sweep over the setpoints is one estimate of the friction curve; the result is their mean with
Student's interval. It covers noise and friction that varies between approaches, provided that the
sweeps are independent; drift is tested.

One measurement cannot show whether the reels are equal: the cable passes both eyelets in series,
so that with unequal reels B is the geometric mean. `experiments.paper.two_reels.reel_comparison`
separates them by two measurements with different angles.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estune.core.quantities import FloatArray, check_not_negative
from estune.errors import InvalidInput
from estune.reel.calibration import GaugeCalibration
from experiments.paper.identify.estimate import Estimate, mean_estimate
from experiments.paper.two_reels.coefficient import (
    ATTENUATION_MIN,
    mean_coefficient,
    resolution_warnings,
)
from experiments.paper.two_reels.friction_curve import (
    FrictionCurve,
    curve_warnings,
    fit_loss_curve,
    mean_curve,
)
from experiments.paper.two_reels.index import WEBER_LIMIT, StaticTransparency, static_transparency
from experiments.paper.two_reels.procedure import SETPOINTS_MIN, SWEEPS_MIN, SetpointReadings


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class TwoReelResult:
    """Result of the two-reel procedure. Arrays have shape (sweeps, setpoints)."""

    attenuation: Estimate  # attenuation ratio B at the mean tension
    friction_coefficient: Estimate  # friction coefficient C_R there
    mean_tension_N: float  # mean of all tensions at which friction acted, N
    resolved: bool  # whether C_R is known to within the tolerance
    sweeps_needed: int | None  # sweeps for which it would be; None where no number is enough
    # Reasons why it is not resolved, and deviations from the model, with remedies.
    warnings: tuple[str, ...]
    curve: FrictionCurve  # loss of tension against tension
    setpoint_N: FloatArray  # commanded tensions, N, shape (setpoints,)
    # Mean tension at which friction acted at each setpoint, N, shape (setpoints,).
    tension_N: FloatArray
    ratios: FloatArray  # attenuation ratios `(x_2/x_1)^(1/4)`: the data of Fig. 7
    reading_y: FloatArray  # readings of Y's gauge, in its own unit
    tension_y_N: FloatArray  # tension at Y's gauge at these readings, N
    probability: float  # confidence level of the intervals
    angles_x_rad: tuple[float, ...]  # angle gamma of each contact at X, rad
    angles_y_rad: tuple[float, ...]  # angle gamma of each contact at Y, rad

    def __repr__(self) -> str:
        state = "resolved" if self.resolved else "not resolved"
        return f"TwoReelResult(B {self.attenuation}, C_R {self.friction_coefficient}, {state})"

    def ratio_at_setpoints(self) -> tuple[Estimate, ...]:
        """B at each setpoint, without a model curve: Fig. 7 with its error bars."""
        return tuple(
            mean_estimate(self.ratios[:, k], self.probability) for k in range(self.ratios.shape[1])
        )

    def calibration_y(self, margin: float = 0.0) -> GaugeCalibration:
        """Calibration of Y's gauge, from its readings and the tensions at them.

        The print takes `y_2 = B x_2`, but with x_1 at X the tension at Y is `B^2 x_1`, equal to
        `x_2/B^2` and `sqrt(x_1 x_2)`. The last form is used, times `sqrt(B(x_1)/B(x_2))` for a B
        that changes with tension.

        Each reading is moved along the curve to the mean tension of its setpoint: the sweeps are
        then repeats, against which the calibration tests its form.

        Args:
            margin: Share of the range by which the calibration extends beyond either end.

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
        estimates = self.ratio_at_setpoints()
        columns = np.array([(e.value, e.low, e.high) for e in estimates])
        value, low, high = np.clip(columns, ATTENUATION_MIN, 1.0).T
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
        measurements: Result of `TwoReelProcedure.run`; every sweep with all setpoints.
        angles_x_rad: Angle gamma of each contact between gauge and free cable at X, rad.
        angles_y_rad: The angles at Y; None if equal to those at X.
        angle_error_rad: Standard uncertainty of the angles, common to all, rad.
        tolerance: Maximum relative error of a resolved C_R.
        probability: Confidence level of the intervals.

    Raises:
        InvalidInput: too few measurements, sweeps that differ in their setpoints, readings that
            are not above zero, or angles or limits out of their range.
    """
    _check_options(tolerance, probability, angle_error_rad)
    angles_x = tuple(map(float, angles_x_rad))
    angles_y = angles_x if angles_y_rad is None else tuple(map(float, angles_y_rad))
    table = _table(measurements)
    setpoint, x_1, y_1 = table[0, :, 0], table[..., 2], table[..., 3]
    x_2 = _corrected_x_2(table)
    ratios = np.asarray((x_2 / x_1) ** 0.25)
    # Friction acts four times, with x_1, B^2 x_1 twice and B^4 x_1 inside.
    tension = 0.25 * x_1 * (1.0 + ratios**2) ** 2
    sweeps = zip(tension, ratios, strict=True)
    fits = np.array([fit_loss_curve(T, (1.0 - B) * T) for T, B in sweeps])
    middle = float(tension.mean())
    per_sweep = 1.0 - fits @ np.array([0.0, 1.0, middle])
    B = mean_estimate(per_sweep, probability)
    C, error = mean_coefficient(
        B, (*angles_x, *angles_y), angle_error_rad, per_sweep.size, probability
    )
    warnings = resolution_warnings(B, C, error, tolerance, per_sweep)
    curve = mean_curve(fits, probability)
    return TwoReelResult(
        attenuation=B,
        friction_coefficient=C,
        mean_tension_N=middle,
        resolved=not warnings,
        sweeps_needed=error.sweeps_needed(tolerance * C.value),
        warnings=(*warnings, *curve_warnings(curve, middle)),
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


def _check_options(tolerance: float, probability: float, angle_error_rad: float) -> None:
    for name, value in (("tolerance", tolerance), ("probability", probability)):
        if not 0.0 < value < 1.0:
            raise InvalidInput(f"{name} is {value}; it must lie between 0 and 1")
    check_not_negative("angle_error_rad", angle_error_rad)


def _table(measurements: Sequence[SetpointReadings]) -> FloatArray:
    """The measurements, shape (sweeps, setpoints, 6), setpoints rising."""
    rows = sorted(measurements, key=lambda m: (m.sweep, m.setpoint_N))
    sweeps, setpoints = len({m.sweep for m in rows}), len({m.setpoint_N for m in rows})
    if sweeps < SWEEPS_MIN:
        raise InvalidInput(
            f"{sweeps} sweeps do not show the repeatability; take {SWEEPS_MIN} or more"
        )
    if setpoints < SETPOINTS_MIN:
        raise InvalidInput(f"{setpoints} setpoints; {SETPOINTS_MIN} or more are needed")
    if len(rows) != sweeps * setpoints:
        raise InvalidInput(
            f"{len(rows)} measurements are not {sweeps} whole sweeps of {setpoints} setpoints; "
            "leave out the broken ones"
        )
    shape = sweeps, setpoints, len(SetpointReadings._fields)
    table = np.array(rows, dtype=np.float64).reshape(shape)
    if not np.isfinite(table).all():
        raise InvalidInput("a measurement is not finite; leave out its sweep")
    if np.ptp(table[..., 0], axis=0).any() or np.ptp(table[..., 1], axis=1).any():
        raise InvalidInput(
            "the sweeps differ in their setpoints; leave out those that are not whole"
        )
    if not (table[..., [2, 4]] > 0.0).all():
        raise InvalidInput("a tension read at X is not above zero; set its gauge's zero")
    return table


def _corrected_x_2(table: FloatArray) -> FloatArray:
    """Readings x_2, corrected for the control error of Y's reading, y_2 - y_1.

    A reading higher by d means a tension at Y higher by d dx_1/dy, and x_2 in proportion.
    """
    x_1, y_1, x_2, y_2 = np.moveaxis(table[..., 2:], -1, 0)
    middle, scale = float(y_1.mean()), float(np.ptp(y_1))
    if scale == 0.0:
        raise InvalidInput("reel Y read the same at every setpoint; check its gauge")
    curve = np.polyfit((y_1.ravel() - middle) / scale, x_1.ravel(), 2)
    between = (0.5 * (y_1 + y_2) - middle) / scale
    error_N = np.polyval(np.polyder(curve), between) / scale * (y_1 - y_2)
    far = np.abs(error_N) > 0.2 * x_1
    if far.any():
        raise InvalidInput(
            f"reel Y read {y_2[far][0]:.4g} when it was to pull to {y_1[far][0]:.4g}, too far off "
            "to correct for; let it settle longer, or tune its tension controller"
        )
    return np.asarray(x_2 * x_1 / (x_1 - error_N))
