"""The record of a torque ramp on an unloaded reel, checked for what a friction fit needs."""

import math
from dataclasses import dataclass

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput

LEAST_SAMPLES = 20
"""Samples wanted at rest, below and above the Stribeck velocity: four for each parameter."""
LEAST_COUNTS = 100
"""Turn of the drum, in encoder counts, below which its motion has no shape."""
MAY_FALL = 1e-3
"""Share of its range by which a ramp may fall: a measured torque has some noise."""


@dataclass(frozen=True, eq=False)
class RampRecord:
    """A torque ramp on an unloaded reel. Columns have shape (samples,).

    Attributes:
        time_s: Time, at a constant rate.
        torque_Nm: Motor torque commanded, at the drum; it rises, or falls, from zero past
            break-away.
        angle_rad: Angle read, still at first.
        encoder_counts: Counts of the encoder per turn of the drum.
        dead_time_s: Time from the command to the torque; a current that is held from sample to
            sample adds half a sample to it.

    Raises:
        InvalidInput: the record cannot show friction, or is not one; the message says why.
    """

    time_s: FloatArray
    torque_Nm: FloatArray
    angle_rad: FloatArray
    encoder_counts: float
    dead_time_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("time_s", "torque_Nm", "angle_rad"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        columns = (self.time_s, self.torque_Nm, self.angle_rad)
        if any(column.shape != (self.time_s.size,) for column in columns):
            raise InvalidInput(
                f"ramp columns have shapes {[column.shape for column in columns]}; "
                "they must be one-dimensional and equally long"
            )
        if self.time_s.size < 4 * LEAST_SAMPLES:
            raise InvalidInput(
                f"the ramp has {self.time_s.size} samples; record {4 * LEAST_SAMPLES} or more"
            )
        if not all(np.isfinite(column).all() for column in columns):
            raise InvalidInput("the ramp record holds a value that is not finite; leave it out")
        if not (math.isfinite(self.encoder_counts) and self.encoder_counts > 0.0):
            raise InvalidInput(
                f"encoder counts per turn are {self.encoder_counts}; they must be above zero"
            )
        if not (math.isfinite(self.dead_time_s) and self.dead_time_s >= 0.0):
            raise InvalidInput(
                f"dead time is {self.dead_time_s} s; it must be finite, and zero or above"
            )
        steps = np.diff(self.time_s)
        if not (steps > 0.0).all() or np.ptp(steps) > 0.01 * steps.mean():
            raise InvalidInput(
                f"times step by {steps.min():g} to {steps.max():g} s; resample at a constant rate"
            )
        self._check_ramp()
        self._check_motion()

    @property
    def direction(self) -> float:
        """Sign of the torque, 1 or -1."""
        return float(np.sign(self.torque_Nm[-1]))

    @property
    def count_rad(self) -> float:
        """Angle of one encoder count, rad."""
        return 2.0 * math.pi / self.encoder_counts

    @property
    def sample_s(self) -> float:
        """Sampling interval, s."""
        return float(self.time_s[-1] - self.time_s[0]) / (self.time_s.size - 1)

    @property
    def acting_torque_Nm(self) -> FloatArray:
        """Torque on the drum at each sample in the direction of the ramp, dead time taken in."""
        acting = np.interp(self.time_s - self.dead_time_s, self.time_s, self.torque_Nm)
        return np.asarray(self.direction * acting)

    @property
    def turned_rad(self) -> FloatArray:
        """Angle turned since the start in the direction of the ramp."""
        return np.asarray(self.direction * (self.angle_rad - self.angle_rad[0]))

    @property
    def breakaway_index(self) -> int:
        """The first sample at which the drum has turned two counts for good."""
        return int(np.flatnonzero(self.turned_rad < 1.5 * self.count_rad)[-1]) + 1

    def _check_ramp(self) -> None:
        if self.direction == 0.0:
            raise InvalidInput("the torque ramp ends at 0 N m; end it above break-away")
        torque = self.direction * self.torque_Nm
        fall = np.maximum.accumulate(torque) - torque
        worst = int(np.argmax(fall))
        if fall[worst] > MAY_FALL * np.ptp(torque):
            raise InvalidInput(
                f"the torque ramp is not monotone: it falls by {fall[worst]:.3g} N m until "
                f"{self.time_s[worst]:.4g} s; command one that only rises, or cut the record there"
            )

    def _check_motion(self) -> None:
        turned = self.turned_rad[-1]
        if turned < LEAST_COUNTS * self.count_rad:
            raise InvalidInput(
                f"no break-away: the drum turned {turned:.3g} rad, less than {LEAST_COUNTS} "
                f"counts, at up to {abs(self.torque_Nm[-1]):.3g} N m; end the ramp higher"
            )
        if self.breakaway_index < LEAST_SAMPLES:
            raise InvalidInput(
                f"the drum moves from sample {self.breakaway_index} on; begin the ramp at zero "
                f"torque and {LEAST_SAMPLES} samples or more before break-away"
            )
