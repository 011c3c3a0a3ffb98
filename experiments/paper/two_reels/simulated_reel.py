"""A reel of a simulated two-reel bench: its controllers, gauge and encoder."""

import math
from collections.abc import Callable

from estune.errors import InvalidInput
from experiments.paper.two_reels.bench_parts import ReelModel


class SimulatedReel:
    """A `BenchReel` of a simulated bench, made by the bench."""

    def __init__(self, model: ReelModel, tension_N: float, slid_m: float, path_N_m: float) -> None:
        self.model = model
        self.wound_m = tension_N / model.stiffness_N_m + slid_m
        self.slid_m = slid_m
        self.tension_N = tension_N
        self.reading = model.gauge.reading(tension_N)
        self.angle_rad = 0.0
        self.friction_due = True
        self._path_N_m = path_N_m
        self._law: Callable[[float, float], None] = self._control_position
        self._target = self._goal = self.wound_m
        self._slope = self._effort = 0.0
        self._last_tension_N = tension_N

    @property
    def drum_radius_m(self) -> float:
        """Radius of the drum, m."""
        return self.model.drum_radius_m

    def hold_tension(self, setpoint: float, within_s: float) -> None:
        """Controls the tension, in the gauge's unit; see `BenchReel`.

        Raises:
            InvalidInput: a value is not finite, or the time is not above zero.
        """
        if not (math.isfinite(setpoint) and math.isfinite(within_s) and within_s > 0.0):
            raise InvalidInput(
                f"setpoint {setpoint} within {within_s} s cannot be held; both must be finite and "
                "the time above zero"
            )
        if self._law != self._control_tension:
            # Bumpless: the integral starts at zero commanded motion.
            self._effort = self._motion_m_s(self.reading)
            self._target = self.reading
        self._goal = setpoint
        self._slope = abs(setpoint - self._target) / within_s
        self._law = self._control_tension
        self.friction_due = True

    def hold_position(self, angle_rad: float | None = None) -> None:
        """Controls the angle; see `BenchReel`."""
        here = self.wound_m if self._law != self._control_position else self._target
        self._target = here
        self._goal = here if angle_rad is None else angle_rad * self.drum_radius_m
        self._slope = self.model.drive.return_m_s
        self._law = self._control_position

    def hold_velocity(self, velocity_rad_s: float, force_ramp_N_s: float = 0.0) -> None:
        """Controls the velocity; see `BenchReel`."""
        self._goal = velocity_rad_s * self.drum_radius_m
        if force_ramp_N_s:
            self._law, self._target = self._yield_to_cable, self._goal
            self._slope, self._effort = force_ramp_N_s, self.tension_N
        else:
            self._target = self._target if self._law == self._control_velocity else 0.0
            self._law, self._slope = self._control_velocity, self.model.drive.acceleration_m_s2

    def advance(self, period_s: float) -> None:
        """Moves the drum by its controller for one period."""
        yield_m = self.model.drive.compliance_m_N * (self.tension_N - self._last_tension_N)
        self._last_tension_N = self.tension_N
        self._law(period_s, yield_m)

    def _approach(self, period_s: float) -> None:
        """Moves the setpoint towards the goal."""
        step = self._slope * period_s
        self._target += min(max(self._goal - self._target, -step), step)

    def _control_tension(self, period_s: float, _yield_m: float) -> None:
        """Integral action on the error, proportional action on the reading: no overshoot."""
        self._approach(period_s)
        error = self._motion_m_s(self._target - self.reading)
        self._effort += error * period_s / self.model.drive.force_integral_s
        self.wound_m += (self._effort - self._motion_m_s(self.reading)) * period_s

    def _motion_m_s(self, reading: float) -> float:
        """Velocity commanded by the tension controller for a reading."""
        drive = self.model.drive
        return reading / (self.model.gauge.sensitivity * self._path_N_m * drive.force_lag_s)

    def _control_position(self, period_s: float, yield_m: float) -> None:
        """Returns the drum to its position; it yields when the tension changes."""
        self._approach(period_s)
        share = 1.0 - math.exp(-period_s / self.model.drive.position_lag_s)
        self.wound_m += share * (self._target - self.wound_m) - yield_m

    def _control_velocity(self, period_s: float, yield_m: float) -> None:
        """Brings the drum to its velocity; it yields when the tension changes."""
        self._approach(period_s)
        self.wound_m += self._target * period_s - yield_m

    def _yield_to_cable(self, period_s: float, _yield_m: float) -> None:
        """Lowers the effort below the tension, so that the cable pulls the drum along."""
        self._effort += self._slope * period_s
        # Implicit in the tension of a sticking cable, the stiffest case.
        drag = self.model.drive.speed_damping_Ns_m / period_s + self.model.stiffness_N_m
        self.wound_m += (self._effort - self.tension_N) / drag + self._target * period_s

    def observe(self, disturbance_N: float) -> None:
        """Reads gauge and encoder."""
        gauge = self.model.gauge
        self.reading = gauge.reading(self.tension_N) + gauge.sensitivity * disturbance_N
        count_rad = 2.0 * math.pi / self.model.counts
        self.angle_rad = math.floor(self.wound_m / self.drum_radius_m / count_rad) * count_rad
