"""The compensations as the loop runs them: compiled from the text for firmware, or in Python."""

import ctypes
import math
from typing import Protocol

from estune.errors import PlantError
from estune.hardware.compensation.plan import (
    NO_COMPENSATION,
    NOTHING_KNOWN,
    CompensationPlan,
    CompensationTerms,
    KnownMotion,
)
from estune.reel import velocity
from estune.reel.friction import slid
from estune.reel.gravity import gravity_force_by_position_N
from estune.reel.velocity import MotionState
from estune.support import c_compiler

_EXPORT = """
__attribute__((visibility("default"))) int estune_compensation_size(void) {
  return (int)sizeof(estune_compensation);
}
__attribute__((visibility("default")))
void estune_compensation_terms(estune_compensation *c, double time, double tension, double angle,
                               double setpoint, double far_end, double *terms) {
  estune_compensation_sample(c, time, tension, angle, setpoint, far_end);
  terms[0] = c->velocity; terms[1] = c->gravity; terms[2] = c->friction; terms[3] = c->inertia;
  terms[4] = c->map; terms[5] = c->notch; terms[6] = c->eyelet; terms[7] = c->limit;
}
"""


class Compensation(Protocol):
    """The compensations with their state."""

    def sample(
        self, time_s: float, gauge_N: float, angle_rad: float, known: KnownMotion = NOTHING_KNOWN
    ) -> CompensationTerms:
        """The compensations at a sample; none where it is out of order or not finite."""


class NoCompensation:
    """A loop without compensations."""

    def sample(
        self,
        _time_s: float,
        _gauge_N: float,
        _angle_rad: float,
        _known: KnownMotion = NOTHING_KNOWN,
    ) -> CompensationTerms:
        """No compensation."""
        return NO_COMPENSATION


class PlainCompensation:
    """`estune.reel` on floats."""

    def __init__(self, plan: CompensationPlan) -> None:
        self._plan = plan
        self._state = MotionState()
        self._setpoint_N, self._passing = math.nan, 0.0
        self._sliding = 0.0, 0.0
        self._far_end = self._far_acceleration = 0.0
        self._unchanged = self._interval = 0
        self._rung: list[list[float]] = []  # the last two of each notch, in and out

    def sample(
        self, time_s: float, gauge_N: float, angle_rad: float, known: KnownMotion = NOTHING_KNOWN
    ) -> CompensationTerms:
        """The compensations at a sample; none where it is out of order or not finite."""
        plan = self._plan
        moved = self._known_move_rad(known)
        friction = plan.limited_N(self._friction_N(known, moved))
        along_N = self._known_motion_N(known)
        velocity_rad_s, acceleration_rad_s2 = self._motion(time_s, angle_rad)
        # Positive feedback through two windows: with half of its inertia the example's reel
        # oscillates, a quarter helps (`experiments.compensation`).
        torque_Nm = plan.inertia_kgm2 * acceleration_rad_s2
        inertia = plan.limited_N(torque_Nm / plan.drum_radius_m + along_N)
        inertia = plan.limited_N(friction + inertia) - friction
        mapped, forward = 0.0, friction + inertia
        if plan.angle_map is not None and math.isfinite(known.setpoint_N + angle_rad):
            mapped = plan.angle_map.force_N(angle_rad, velocity_rad_s, known.setpoint_N)
        mapped = plan.limited_N(forward + mapped) - forward
        gravity, notch = self._gravity_N(gauge_N, angle_rad), self._notch_N(gauge_N)
        eyelet = plan.limited_N(self._eyelet_N(known, moved))
        fed = velocity_rad_s, gravity, friction, inertia, mapped
        return CompensationTerms(*fed, notch, eyelet, plan.effort_limit_N)

    def _motion(self, time_s: float, angle_rad: float) -> tuple[float, float]:
        """Velocity and acceleration of the drum; begins anew where a sample is out of order."""
        times = self._state.times_s
        finite = math.isfinite(time_s) and math.isfinite(angle_rad)
        if not finite or (times and not time_s > times[0]):
            self._state = MotionState()
            return 0.0, 0.0
        self._state, motion = velocity.step(self._plan.windows, self._state, time_s, angle_rad)
        return motion.velocity_rad_s, motion.acceleration_rad_s2

    def _known_motion_N(self, known: KnownMotion) -> float:
        """Inertia and viscous friction along the far end's motion; see the C text."""
        plan = self._plan
        far_end = known.far_end_m_s if math.isfinite(known.setpoint_N) else 0.0
        self._unchanged += 1
        if far_end != self._far_end:
            self._interval, self._unchanged = self._unchanged, 0
            span_s = self._interval * plan.period_s
            self._far_acceleration = (far_end - self._far_end) / span_s
            self._far_end = far_end
        elif self._unchanged > 2 * self._interval:
            self._far_acceleration = 0.0
        inertial_N = plan.known_inertia_kgm2 * self._far_acceleration
        return -(inertial_N + plan.known_viscous_Nms_rad * far_end) / plan.drum_radius_m**2

    def _known_move_rad(self, known: KnownMotion) -> float:
        plan, before = self._plan, self._setpoint_N
        self._setpoint_N = known.setpoint_N
        wound_m = -known.far_end_m_s * plan.period_s
        moved = (known.setpoint_N - before) / plan.tension_per_rad_N + wound_m / plan.drum_radius_m
        return moved if math.isfinite(moved) else math.nan

    def _friction_N(self, known: KnownMotion, moved_rad: float) -> float:
        """Friction along the known motion; begins anew where the loop was open."""
        plan = self._plan
        if plan.friction is None:
            return 0.0
        longer, sooner = self._sliding
        memory_rad = plan.friction.memory_rad
        longer = slid(longer, moved_rad, memory_rad)
        sooner = slid(sooner, moved_rad, memory_rad / plan.friction.spread)
        self._sliding = longer, sooner
        velocity, direction = moved_rad / plan.period_s, 0.5 * (longer + sooner)
        return plan.friction.force_N(direction, velocity, known.setpoint_N, plan.drum_radius_m)

    def _eyelet_N(self, known: KnownMotion, moved_rad: float) -> float:
        """What the gauge reads more than there is outside the eyelet; see the C text."""
        eyelet = self._plan.eyelet
        if eyelet is None:
            return 0.0
        self._passing = slid(self._passing, moved_rad, eyelet.memory_rad)
        return max(0.0, known.setpoint_N) * math.expm1(eyelet.exponent * self._passing)

    def _notch_N(self, gauge_N: float) -> float:
        if not math.isfinite(gauge_N):
            self._rung = []
            return 0.0
        x, fresh = gauge_N, not self._rung
        for n, k in enumerate(self._plan.notches):
            if fresh:
                self._rung.append([x, x, x, x])
            x_1, x_2, y_1, y_2 = self._rung[n]
            y = k.b0 * x + k.b1 * x_1 + k.b2 * x_2 - k.a1 * y_1 - k.a2 * y_2
            self._rung[n] = [x, x_1, y, y_1]
            x = y
        return gauge_N - x

    def _gravity_N(self, gauge_N: float, angle_rad: float) -> float:
        # Off the reading: in the effort the integral would cancel it, and the far end's tension
        # would stay wrong by the weight.
        gravity = self._plan.gravity
        if gravity is None or not (math.isfinite(gauge_N) and math.isfinite(angle_rad)):
            return 0.0
        length = gravity.length_at(angle_rad, self._plan.drum_radius_m)
        force = gravity_force_by_position_N(
            gravity.weight_N_m, length, rise_m=gravity.rise_m, tension_1_N=gauge_N
        )
        return float(force)


class CompiledCompensation:
    """The C text, compiled.

    Attributes:
        size: Bytes of its state, which is all zero at the start.
        function: Address of `estune_compensation_terms`.
    """

    def __init__(self, source: str) -> None:
        """Compiles the text, or takes it from the cache.

        Raises:
            PlantError: no compiler, or it failed.
        """
        library = c_compiler.load(source + _EXPORT)
        self._sample = library.estune_compensation_terms
        number, address = ctypes.c_double, ctypes.c_void_p
        self._sample.argtypes, self._sample.restype = (address, *5 * (number,), address), None
        self.size = library.estune_compensation_size()
        self.function = ctypes.cast(self._sample, address).value
        self._state = ctypes.create_string_buffer(self.size)
        self._terms = (number * len(CompensationTerms._fields))()
        self._addresses = ctypes.addressof(self._state), ctypes.addressof(self._terms)

    def sample(
        self, time_s: float, gauge_N: float, angle_rad: float, known: KnownMotion = NOTHING_KNOWN
    ) -> CompensationTerms:
        """The compensations at a sample; none where it is out of order or not finite."""
        state, terms = self._addresses
        self._sample(state, time_s, gauge_N, angle_rad, *known, terms)
        return CompensationTerms(*self._terms)


def make_compensation(plan: CompensationPlan | None, source: str) -> Compensation:
    """The compensations compiled from their C text; in Python where there is no compiler."""
    if plan is None:
        return NoCompensation()
    try:
        return CompiledCompensation(source)
    except PlantError:  # the loop's note on its controller gives the reason
        return PlainCompensation(plan)
