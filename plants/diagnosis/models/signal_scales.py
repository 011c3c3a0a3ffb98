"""How large the signals of some records are, so that a search begins at their size."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estune.core.quantities import FloatArray
from plants.effects import Parameter, Port

FRICTION = 0.1
"""Where friction begins, relative to the torque's rms."""
FADE = 0.3
"""Where a velocity begins, relative to the velocity's rms."""
CREEP = 0.01
"""Where the velocity of a cable's creep begins, relative to the velocity's rms."""
TRAVEL = 0.05
"""Where an angle begins, relative to the angle's rms."""
LIMIT = 0.8
"""Where a limit begins, relative to the greatest command or its greatest change."""
MOST = 2.0
"""What a torque or a velocity can be at most, relative to the greatest there is."""


@dataclass(frozen=True, slots=True)
class Sizes:
    """Sizes of the signals in the units of the effects.

    Attributes:
        torque_rms: Commanded torque about its mean, N m; 0 where it does not change.
        torque_max: Greatest size of the commanded torque, N m.
        angle_rms: Angle about its mean, rad.
        velocity_rms: Velocity, rad/s.
        velocity_max: Greatest velocity, rad/s.
        current_max: Greatest size of the command, A.
        current_rate: Greatest change of the command in a sample, A/s.
    """

    torque_rms: float
    torque_max: float
    angle_rms: float
    velocity_rms: float
    velocity_max: float
    current_max: float
    current_rate: float

    @classmethod
    def of(
        cls,
        currents: Sequence[FloatArray],
        torque_constant: float,
        angles: Sequence[FloatArray],
        rates_Hz: Sequence[float],
    ) -> "Sizes":
        """The sizes of some records' commands and angles; any angle may be missing.

        Args:
            currents: Command of each record, A.
            torque_constant: Torque per command, N m/A.
            angles: Angle of each record, rad.
            rates_Hz: Sampling rate of each.
        """
        moved = [current - current.mean() for current in currents]
        velocities = [
            _velocity(a, rate) for a, rate in zip(angles, rates_Hz, strict=True) if a.size
        ]
        steps = [
            float(np.abs(np.diff(i)).max(initial=0.0)) * rate
            for i, rate in zip(currents, rates_Hz, strict=True)
        ]
        return cls(
            torque_rms=abs(torque_constant) * _rms(moved),
            torque_max=abs(torque_constant) * _max(currents),
            angle_rms=_rms([angle - angle.mean() for angle in angles if angle.size]),
            velocity_rms=_rms(velocities),
            velocity_max=_max(velocities),
            current_max=_max(currents),
            current_rate=max(steps, default=0.0),
        )

    def of_effect(self, port: Port, p: Parameter, usual: float) -> tuple[float, float]:
        """Where a parameter of an effect begins, and the most it can be.

        Args:
            port: Where the effect sits.
            p: What is declared of it.
            usual: Its usual value.
        """
        start, most = usual, p.high
        if port is Port.DRUM and p.unit == "N m":
            start, most = FRICTION * self.torque_rms, MOST * self.torque_max
        elif port is Port.DRUM and p.unit == "rad/s":
            start, most = FADE * self.velocity_rms, MOST * self.velocity_max
        elif port is Port.EYELET and p.unit == "rad/s":
            start, most = CREEP * self.velocity_rms, MOST * self.velocity_max
        elif port is Port.DRUM and p.unit == "rad" and p.low >= 0.0:
            start, most = TRAVEL * self.angle_rms, MOST * self.angle_rms
        elif port is Port.ACTUATOR and p.unit == "A":
            start = LIMIT * self.current_max
        elif port is Port.ACTUATOR and p.unit == "A/s":
            start = LIMIT * self.current_rate
        if not (math.isfinite(start) and start > 0.0 and most > p.low):
            return usual, p.high
        most = min(most, p.high)
        return min(max(start, p.low), most), most


def _velocity(angle: FloatArray, rate_Hz: float) -> FloatArray:
    """The velocity, over eight samples so that an encoder's steps do not make it."""
    span = min(8, angle.size - 1)
    return np.asarray((angle[span:] - angle[:-span]) * (rate_Hz / span))


def _rms(parts: Sequence[FloatArray]) -> float:
    count = sum(part.size for part in parts)
    return math.sqrt(sum(float(part @ part) for part in parts) / count) if count else 0.0


def _max(parts: Sequence[FloatArray]) -> float:
    return max((float(np.abs(part).max(initial=0.0)) for part in parts), default=0.0)


def units(
    inputs: Sequence[FloatArray], outputs: Sequence[FloatArray | None]
) -> tuple[float, float]:
    """Powers of ten in which signals are as large as a reel's.

    Args:
        inputs: Input of each record.
        outputs: Output of each record, where there is one.

    Returns:
        Input that stands for a newton metre, output that stands for a radian.
    """
    moved = [y - y.mean() for y in outputs if y is not None]
    return _above(_rms([u - u.mean() for u in inputs])), 10.0 * _above(_rms(moved))


def _above(value: float) -> float:
    """The power of ten at or next above a value."""
    return float(10.0 ** math.ceil(math.log10(value))) if value > 0.0 else 1.0
