"""What the two-reel procedure needs of a bench: two reels on one cable, and their readings.

Anything with these methods can be measured, simulated or real. Angles grow when the drum winds in;
gauge readings are in the reel's own unit, newtons where the gauge is calibrated.
"""

from typing import NamedTuple, Protocol

from estune.core.quantities import FloatArray


class BenchReading(NamedTuple):
    """What one reel reads; columns have shape (samples,).

    Attributes:
        gauge: Tension at the gauge, in the reel's own unit.
        angle_rad: Angle of the drum, rad, as the encoder counts it; grows when winding in.
    """

    gauge: FloatArray
    angle_rad: FloatArray


class BenchRecord(NamedTuple):
    """Both reels over the same time.

    Attributes:
        time_s: Time since the bench was started, s, shape (samples,).
        x: Reel X.
        y: Reel Y.
    """

    time_s: FloatArray
    x: BenchReading
    y: BenchReading


class BenchReel(Protocol):
    """One reel of a bench. A command returns at once and holds until the next one."""

    @property
    def drum_radius_m(self) -> float:
        """Radius at which the cable lies on the drum, m."""

    def hold_tension(self, setpoint: float, within_s: float) -> None:
        """Controls the tension: its setpoint goes steadily from the present reading to this one.

        Args:
            setpoint: Tension at the gauge, in the reel's own unit.
            within_s: Time for the setpoint to get there, s.
        """

    def hold_position(self, angle_rad: float | None = None) -> None:
        """Controls the angle of the drum; None holds it where it is."""

    def hold_velocity(self, velocity_rad_s: float, force_ramp_N_s: float = 0.0) -> None:
        """Controls the velocity of the drum; zero holds it at rest without returning anywhere.

        Args:
            velocity_rad_s: Velocity, rad/s, above zero when winding in.
            force_ramp_N_s: Slope of a force that is added to the present effort, N/s at the cable;
                below zero it gives way until the cable pulls the drum along.
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
        """Lets the bench work for a time, s, and returns what both reels read meanwhile."""
