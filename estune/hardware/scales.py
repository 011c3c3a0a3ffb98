"""Calibrations C1 and C2 for the loop: single floats, a few microseconds, no exceptions.

The curves are those of `estune.reel.calibration`, whose arrays and checks take 25 and 110 us of
the 1580 us of a sample at 632 Hz. A value outside its calibration is a NaN, on which the guard
acts (gauge), or the end of the range (current).
"""

import math
from dataclasses import dataclass
from typing import Self

from estune.errors import InvalidInput
from estune.reel.calibration import Axis, CurrentCalibration, GaugeCalibration

_ROUNDING = 1e-9  # of the scaled ends: a value at the end of the range is in it
_NEWTON_STEPS = 20


def _middle(axis: Axis) -> tuple[float, float]:
    return 0.5 * (axis.low + axis.high), 0.5 * (axis.high - axis.low)


@dataclass(frozen=True, slots=True)
class GaugeScale:
    """C2: counts to newtons, the root of the quadratic in the calibrated range."""

    coefficients: tuple[float, float, float]
    middle_N: float
    half_N: float
    scaled_max: float

    @classmethod
    def of(cls, calibration: GaugeCalibration) -> Self:
        """The scale of a calibration.

        Raises:
            InvalidInput: the calibration needs a contact position, which a rig does not measure.
        """
        if calibration.position is not None:
            raise InvalidInput(
                "this gauge calibration needs the cable's contact position, which the rig does "
                "not measure; calibrate without position (C2) for the angle the cable has"
            )
        c0, c1, c2 = calibration.regression.coefficients
        return cls((c0, c1, c2), *_middle(calibration.force), calibration.force.reach)

    def force_N(self, counts: float) -> float:
        """Force that gives these counts, N; NaN where no calibrated force does."""
        c0, c1, c2 = self.coefficients
        discriminant = c1 * c1 + 4.0 * c2 * (counts - c0)
        if not 0.0 <= discriminant < math.inf:
            return math.nan
        # This form of the root neither cancels nor fails for a straight line.
        u = 2.0 * (counts - c0) / (c1 + math.copysign(math.sqrt(discriminant), c1))
        if not abs(u) <= self.scaled_max * (1.0 + _ROUNDING):
            return math.nan
        return self.middle_N + self.half_N * u


@dataclass(frozen=True, slots=True)
class CurrentScale:
    """C1: amperes to counts, by Newton's method on the monotone curve."""

    coefficients: tuple[float, ...]
    middle: float
    half: float
    scaled_max: float

    @classmethod
    def of(cls, calibration: CurrentCalibration) -> Self:
        """The scale of a calibration."""
        axis = calibration.command
        return cls(calibration.regression.coefficients, *_middle(axis), axis.reach)

    def counts(self, current_A: float) -> int:
        """Calibrated command whose current is nearest, counts."""
        low, high = -self.scaled_max, self.scaled_max
        rising = self.coefficients[1] > 0.0
        u = 0.0
        for _ in range(_NEWTON_STEPS):
            value, slope = self._curve(u)
            if (value > current_A) == rising:
                high = u
            else:
                low = u
            candidate = u - (value - current_A) / slope if slope else u
            if not low <= candidate <= high:
                candidate = 0.5 * (low + high)
            settled = abs(candidate - u) <= 1e-12 * self.scaled_max
            u = candidate
            if settled:
                break
        return round(self.middle + self.half * u)

    def _curve(self, u: float) -> tuple[float, float]:
        """Current and its slope at a scaled command."""
        value = slope = 0.0
        for coefficient in reversed(self.coefficients):
            slope = slope * u + value
            value = value * u + coefficient
        return value, slope
