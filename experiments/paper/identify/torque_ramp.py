"""Record of a torque ramp on an unloaded reel, checked for a friction fit."""

import math
from dataclasses import dataclass

import numpy as np

from estune.core.quantities import FloatArray, check_not_negative, check_positive
from estune.errors import InvalidInput

SAMPLES_MIN = 20
"""Minimum samples at rest, below and above the Stribeck velocity: four per parameter."""
COUNTS_MIN = 100
"""Minimum turn of the drum, in encoder counts."""
FALL_MAX = 1e-3
"""Allowed fall of a ramp as a share of its range, for noise of a measured torque."""


@dataclass(frozen=True, eq=False)
class RampRecord:
    """A torque ramp on an unloaded reel. Columns have shape (samples,).

    Raises:
        InvalidInput: the record is invalid or cannot show friction.
    """

    time_s: FloatArray  # time, at a constant rate
    # Commanded motor torque at the drum, from zero beyond break-away, up or down.
    torque_Nm: FloatArray
    angle_rad: FloatArray  # measured angle, constant at first
    encoder_counts: float  # encoder counts per turn of the drum
    # Dead time from command to torque; a sampled and held current adds half a sample.
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
        if self.time_s.size < 4 * SAMPLES_MIN:
            raise InvalidInput(
                f"the ramp has {self.time_s.size} samples; record {4 * SAMPLES_MIN} or more"
            )
        if not all(np.isfinite(column).all() for column in columns):
            raise InvalidInput("the ramp record holds a value that is not finite; leave it out")
        check_positive("encoder counts per turn", self.encoder_counts)
        check_not_negative("dead time", self.dead_time_s, "s")
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
        """Delayed torque on the drum at each sample, in the direction of the ramp."""
        acting = np.interp(self.time_s - self.dead_time_s, self.time_s, self.torque_Nm)
        return np.asarray(self.direction * acting)

    @property
    def turned_rad(self) -> FloatArray:
        """Angle turned since the start in the direction of the ramp."""
        return np.asarray(self.direction * (self.angle_rad - self.angle_rad[0]))

    @property
    def breakaway_index(self) -> int:
        """First sample from which the drum stays beyond one and a half counts."""
        return int(np.flatnonzero(self.turned_rad < 1.5 * self.count_rad)[-1]) + 1

    def _check_ramp(self) -> None:
        if self.direction == 0.0:
            raise InvalidInput("the torque ramp ends at 0 N m; end it above break-away")
        torque = self.direction * self.torque_Nm
        fall = np.maximum.accumulate(torque) - torque
        worst = int(np.argmax(fall))
        if fall[worst] > FALL_MAX * np.ptp(torque):
            raise InvalidInput(
                f"the torque ramp is not monotone: it falls by {fall[worst]:.3g} N m until "
                f"{self.time_s[worst]:.4g} s; command one that only rises, or cut the record there"
            )

    def _check_motion(self) -> None:
        turned = self.turned_rad[-1]
        if turned < COUNTS_MIN * self.count_rad:
            raise InvalidInput(
                f"no break-away: the drum turned {turned:.3g} rad, less than {COUNTS_MIN} "
                f"counts, at up to {abs(self.torque_Nm[-1]):.3g} N m; end the ramp higher"
            )
        if self.breakaway_index < SAMPLES_MIN:
            raise InvalidInput(
                f"the drum moves from sample {self.breakaway_index} on; begin the ramp at zero "
                f"torque and {SAMPLES_MIN} samples or more before break-away"
            )
