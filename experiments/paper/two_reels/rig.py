"""Interface of a two-reel bench, simulated or real: two reels on one cable, and their readings.

Angles increase when the drum winds in; gauge readings are in the reel's own unit, newtons where
the gauge is calibrated.
"""

from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple, Protocol, Self

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import RigError

Side = Literal["x", "y"]
SIDES: tuple[Side, Side] = ("x", "y")


class BenchReading(NamedTuple):
    """Readings of one reel; columns have shape (samples,)."""

    gauge: FloatArray  # tension at the gauge, in the reel's own unit
    angle_rad: FloatArray  # angle of the drum by its encoder, rad


class BenchRecord(NamedTuple):
    """Simultaneous readings of both reels."""

    time_s: FloatArray  # time since the bench was started, s, shape (samples,)
    x: BenchReading  # reel X
    y: BenchReading  # reel Y

    def of(self, side: Side) -> BenchReading:
        """Readings of one reel."""
        return self.x if side == "x" else self.y

    @classmethod
    def joined(cls, records: Sequence[Self], start: int) -> Self:
        """Successive records as one, from a sample on."""

        def join(columns: Iterable[FloatArray]) -> FloatArray:
            return np.concatenate(list(columns))[start:]

        readings = (
            BenchReading(
                join(r.of(s).gauge for r in records), join(r.of(s).angle_rad for r in records)
            )
            for s in SIDES
        )
        return cls(join(r.time_s for r in records), *readings)


class BenchReel(Protocol):
    """One reel of a bench. A command returns at once and is in force until the next one."""

    @property
    def drum_radius_m(self) -> float:
        """Radius at which the cable lies on the drum, m."""

    def hold_tension(self, setpoint: float, within_s: float) -> None:
        """Controls the tension, with a setpoint ramp from the present reading.

        Args:
            setpoint: Tension at the gauge, in the reel's own unit.
            within_s: Duration of the ramp, s.
        """

    def hold_position(self, angle_rad: float | None = None) -> None:
        """Controls the angle of the drum; None holds the present angle."""

    def hold_velocity(self, velocity_rad_s: float, force_ramp_N_s: float = 0.0) -> None:
        """Controls the velocity of the drum; zero holds it at rest.

        Args:
            velocity_rad_s: Velocity, rad/s, positive when winding in.
            force_ramp_N_s: Slope of a force added to the present effort, N/s at the cable; when
                negative, the drum yields until the cable pulls it along.
        """


class Bench(Protocol):
    """Two reels face to face on one cable, each with its eyelet."""

    @property
    def x(self) -> BenchReel:
        """The reel whose gauge is calibrated."""

    @property
    def y(self) -> BenchReel:
        """The reel whose gauge is not."""

    def record(self, duration_s: float) -> BenchRecord:
        """Runs the bench for a time, s, and returns the readings of both reels."""


def reel_of(bench: Bench, side: Side) -> BenchReel:
    """One reel of a bench."""
    return bench.x if side == "x" else bench.y


def mean_reading(column: FloatArray) -> float:
    """Mean of a column.

    Raises:
        RigError: the column is empty, or a value is not finite.
    """
    if column.size == 0 or not np.isfinite(column).all():
        raise RigError(
            "a reel gave no reading, or one that is not finite; check gauge and encoder"
        )
    return float(column.mean())
