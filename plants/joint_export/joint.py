"""One joint by the numbers that simulators of robots know."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from estune.trial.description import UNLIMITED_N
from plants.effects import (
    CoulombFriction,
    CurrentLag,
    CurrentSaturation,
    Effect,
    LinkGravity,
    StribeckFriction,
    ViscousDamping,
)
from plants.effects.plant_scale import PlantScale
from plants.models.unloaded_reel import UnloadedReel


class JointNumber(NamedTuple):
    """A number of a joint with its 95 % interval; without one where it was not fitted."""

    value: float
    low: float = math.nan
    high: float = math.nan

    def times(self, factor: float) -> "JointNumber":
        """The same in another unit."""
        return JointNumber(self.value * factor, self.low * factor, self.high * factor)

    @property
    def interval(self) -> str:
        """The interval in words; empty without one."""
        known = math.isfinite(self.low) and math.isfinite(self.high)
        return f"95 % interval {self.low:.6g} to {self.high:.6g}" if known else "not fitted"


ZERO = JointNumber(0.0)


class Joint(NamedTuple):
    """A joint that turns, or of a stage one that slides: then rad is m and N m is N.

    Attributes:
        inertia: Of all that moves, kg m2 or kg.
        damping: Viscous friction, N m s/rad.
        friction: Dry friction in motion, N m.
        gravity: Greatest torque of gravity, N m.
        phase_rad: Angle from hanging down where the encoder reads zero.
        gear: Torque per unit of the command, N m/A.
        limit: Greatest command, A; infinite where there is none.
        lag_s: Lag of the actuator, s.
        constant: Constant torque of the drive, N m.
        travel: Least and greatest angle in the records, rad.
        speed: Greatest speed in the records, rad/s.
        step_s: Sampling interval of the records, s.
        unsaid: What no field of a simulator says, one sentence each.
    """

    slides: bool
    inertia: JointNumber
    damping: JointNumber
    friction: JointNumber
    gravity: JointNumber
    phase_rad: JointNumber
    gear: JointNumber
    limit: JointNumber
    lag_s: JointNumber
    constant: JointNumber
    travel: tuple[float, float]
    speed: float
    step_s: float
    unsaid: tuple[str, ...]


def joint_of(diagnosis: Any) -> Joint:
    """The joint of a servo, stage or unloaded reel that was identified, with its effects."""
    model: UnloadedReel = diagnosis.augmented
    intervals = _intervals(diagnosis)

    def number(name: str, value: float) -> JointNumber:
        low, high = intervals.get(PlantScale.of(model).name(name), (math.nan, math.nan))
        return JointNumber(value, low, high)

    limit = model.current_limit_A
    travel, speed = _motion(diagnosis)
    joint = Joint(
        slides=PlantScale.of(model).unit("rad") == "m",
        inertia=number("drum_inertia_kg_m2", model.drum_inertia_kg_m2),
        damping=number("viscous_friction_Nms", model.viscous_friction_Nms),
        friction=ZERO,
        gravity=ZERO,
        phase_rad=ZERO,
        gear=JointNumber(model.torque_constant_Nm_A),
        limit=JointNumber(limit if limit < UNLIMITED_N else math.inf),
        lag_s=ZERO,
        constant=ZERO,
        travel=travel,
        speed=speed,
        step_s=1.0 / model.sampling_Hz,
        unsaid=(),
    )
    if model.dead_time_s > 0.0:
        joint = _not_said(joint, f"The drive has a dead time of {model.dead_time_s:.4g} s.")
    for effect in model.effects:
        joint = _with(joint, effect, intervals, model)
    return joint


def _with(
    joint: Joint, effect: Effect, intervals: Mapping[str, tuple[float, float]], model: Any
) -> Joint:
    def number(name: str) -> JointNumber:
        at = intervals.get(f"{effect.name}.{name}", (math.nan, math.nan))
        return JointNumber(getattr(effect, name), *at)

    match effect:
        case CoulombFriction():
            joint = joint._replace(friction=number("torque_Nm"))
        case StribeckFriction():
            joint = joint._replace(friction=number("coulomb_Nm"))
            rest = "at rest and in slow motion the friction is larger"
            joint = _not_said(joint, _sentence(effect, model, rest))
        case LinkGravity():
            phase = number("phase_rad")
            joint = joint._replace(gravity=number("torque_Nm"), phase_rad=phase)
        case ViscousDamping():
            both = zip(joint.damping, number("damping_Nms"), strict=True)
            joint = joint._replace(damping=JointNumber(*(a + b for a, b in both)))
        case CurrentLag():
            joint = joint._replace(lag_s=number("lag_s"))
        case CurrentSaturation():
            joint = joint._replace(limit=number("limit_A"))
        case _ if effect.name == "calibration":
            own, ends = vars(effect), intervals.get("torque_offset_Nm", (math.nan, math.nan))
            constant = JointNumber(own["torque_offset_Nm"], *ends)
            gear = joint.gear.times(own["torque_gain"])
            joint = joint._replace(gear=gear, constant=constant)
        case _:
            joint = _not_said(joint, _sentence(effect, model, "it is left out"))
    return joint


def _not_said(joint: Joint, sentence: str) -> Joint:
    return joint._replace(unsaid=(*joint.unsaid, sentence))


def _sentence(effect: Effect, model: Any, left_out: str) -> str:
    told = effect.sentence(vars(effect), model).rstrip(".")
    return f"{told}: no field says so, {left_out}."


def _intervals(diagnosis: Any) -> dict[str, tuple[float, float]]:
    """Ends of the intervals of base numbers, and of effects by slug and parameter."""
    found = {c.name: (c.with_effects.low, c.with_effects.high) for c in diagnosis.calibrations}
    found["torque_offset_Nm"] = found.get(
        "force_offset_N", found.get("torque_offset_Nm", ZERO[1:])
    )
    for effect in (*diagnosis.effects, *diagnosis.declared):
        found |= {f"{effect.name}.{n}": (at.low, at.high) for n, at in effect.parameters.items()}
    return found


def _motion(diagnosis: Any) -> tuple[tuple[float, float], float]:
    """Least and greatest angle, and greatest speed, in the records."""
    traces = [t for t in diagnosis.traces if t.channel == "angle_rad"]
    if not traces:
        return (-math.inf, math.inf), math.inf
    low = min(float(t.measured.min()) for t in traces)
    high = max(float(t.measured.max()) for t in traces)
    speed = max(
        float(np.quantile(np.abs(np.gradient(t.measured, t.time_s)), 0.99)) for t in traces
    )
    return (low, high), speed
