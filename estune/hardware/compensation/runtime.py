"""The compensations as the loop runs them: compiled from the text for firmware, or in Python."""

import ctypes
import math
from typing import Protocol

from estune.errors import PlantError
from estune.hardware.compensation.plan import (
    NO_COMPENSATION,
    CompensationPlan,
    CompensationTerms,
)
from estune.reel import velocity
from estune.reel.gravity import gravity_force_by_position_N
from estune.reel.velocity import MotionState
from estune.support import c_compiler

_EXPORT = """
__attribute__((visibility("default"))) int estune_compensation_size(void) {
  return (int)sizeof(estune_compensation);
}
__attribute__((visibility("default")))
void estune_compensation_terms(estune_compensation *c, double time, double tension, double angle,
                               double *terms) {
  estune_compensation_sample(c, time, tension, angle);
  terms[0] = c->velocity; terms[1] = c->gravity; terms[2] = c->friction; terms[3] = c->inertia;
}
"""


class Compensation(Protocol):
    """The compensations with their state."""

    def sample(self, time_s: float, gauge_N: float, angle_rad: float) -> CompensationTerms:
        """The compensations at a sample; none where it is out of order or not finite."""


class NoCompensation:
    """A loop without compensations."""

    def sample(self, _time_s: float, _gauge_N: float, _angle_rad: float) -> CompensationTerms:
        """No compensation."""
        return NO_COMPENSATION


class PlainCompensation:
    """`estune.reel` on floats."""

    def __init__(self, plan: CompensationPlan) -> None:
        self._plan = plan
        self._state = MotionState()

    def sample(self, time_s: float, gauge_N: float, angle_rad: float) -> CompensationTerms:
        """The compensations at a sample; none where it is out of order or not finite."""
        plan, times = self._plan, self._state.times_s
        gravity = self._gravity_N(gauge_N, angle_rad)
        finite = math.isfinite(time_s) and math.isfinite(angle_rad)
        if not finite or (times and not time_s > times[0]):
            self._state = MotionState()
            return NO_COMPENSATION._replace(gravity_N=gravity)
        self._state, motion = velocity.step(plan.windows, self._state, time_s, angle_rad)
        forward, radius = plan.feed_forward, plan.drum_radius_m
        friction = plan.limited_N(forward.friction_Nm(motion) / radius)
        inertia = plan.limited_N(forward.inertia_Nm(motion) / radius)
        inertia = plan.limited_N(friction + inertia) - friction
        return CompensationTerms(motion.velocity_rad_s, gravity, friction, inertia)

    def _gravity_N(self, gauge_N: float, angle_rad: float) -> float:
        gravity = self._plan.gravity
        if gravity is None or not (math.isfinite(gauge_N) and math.isfinite(angle_rad)):
            return 0.0
        length = gravity.length_at(angle_rad, self._plan.drum_radius_m)
        force = gravity_force_by_position_N(
            gravity.weight_N_m, length, rise_m=gravity.rise_m, tension_1_N=gauge_N
        )
        return float(force)


class CompiledCompensation:
    """The C text, compiled."""

    def __init__(self, source: str) -> None:
        """Compiles the text, or takes it from the cache.

        Raises:
            PlantError: no compiler, or it failed.
        """
        library = c_compiler.load(source + _EXPORT)
        self._sample = library.estune_compensation_terms
        number, address = ctypes.c_double, ctypes.c_void_p
        self._sample.argtypes, self._sample.restype = (address, *3 * (number,), address), None
        self._state = ctypes.create_string_buffer(library.estune_compensation_size())
        self._terms = (number * len(CompensationTerms._fields))()
        self._addresses = ctypes.addressof(self._state), ctypes.addressof(self._terms)

    def sample(self, time_s: float, gauge_N: float, angle_rad: float) -> CompensationTerms:
        """The compensations at a sample; none where it is out of order or not finite."""
        state, terms = self._addresses
        self._sample(state, time_s, gauge_N, angle_rad, terms)
        return CompensationTerms(*self._terms)


def make_compensation(plan: CompensationPlan | None, source: str) -> Compensation:
    """The compensations compiled from their C text; in Python where there is no compiler."""
    if plan is None:
        return NoCompensation()
    try:
        return CompiledCompensation(source)
    except PlantError:  # the loop's note on its controller gives the reason
        return PlainCompensation(plan)
