"""Files of a joint: MJCF of MuJoCo, URDF, and the fields of Isaac Sim as a table."""

import csv
import io
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from estune.errors import InvalidInput
from plants.effects.plant_scale import PlantScale
from plants.joint_export.joint import Joint, JointNumber, joint_of
from plants.models.unloaded_reel import UnloadedReel

GRAVITY_m_s2 = 9.80665
SHARE = 1e-3
"""Share of the inertia that a body without a link keeps, for simulators refuse one without."""
STICKS = "0.999 0.9999 0.001"
"""Impedance of dry friction in MuJoCo: with its default a joint creeps below the friction."""


def export(diagnosis: Any, path: Path) -> Path:
    """Writes the joint of a diagnosis; the ending says in which format.

    Raises:
        InvalidInput: the ending is none of `ENDINGS`, the model is no joint, or the file cannot be
            written.
    """
    check_export(diagnosis.augmented, path)
    text = ENDINGS[path.suffix.lower()](joint_of(diagnosis))
    try:
        path.write_text(text, "utf-8")
    except OSError as error:
        raise InvalidInput(f"--export {path}: it cannot be written: {error.strerror}") from error
    return path


def check_export(model: Any, path: Path) -> None:
    """Checks that a model can be exported to a file.

    Raises:
        InvalidInput: the ending is none of `ENDINGS`, or the model is no joint.
    """
    if path.suffix.lower() not in ENDINGS:
        raise InvalidInput(f"--export {path}: the ending must be one of {', '.join(ENDINGS)}")
    if not isinstance(model, UnloadedReel):
        raise InvalidInput(
            f"--export: a {PlantScale.of(model).subject} is no joint of other simulators; give "
            "the model of a servo, a stage or an unloaded reel"
        )


def mjcf(joint: Joint) -> str:
    """A model of MuJoCo with one joint and its motor, angles in radians."""
    mass, x, z, own = _link(joint)
    step_s = min(0.5 * joint.step_s, 1e-3)
    one = _digits(SHARE * joint.inertia.value)
    root = ET.Element("mujoco", model="joint")
    _remark(root, joint)
    _add(root, "compiler", angle="radian", autolimits="true")
    down = f"0 0 {_digits(-GRAVITY_m_s2)}"
    _add(root, "option", timestep=step_s, integrator="implicitfast", gravity=down)
    link = _add(_add(root, "worldbody"), "body", name="link")
    _add(
        *(link, "joint"),
        name="joint",
        type="slide" if joint.slides else "hinge",
        axis=_axis(joint),
        damping=joint.damping.value,
        frictionloss=joint.friction.value,
        armature=own,
        solreffriction=f"{_digits(2.0 * step_s)} 1",
        solimpfriction=STICKS,
    )
    _add(
        *(link, "inertial"),
        pos=f"{_digits(x)} 0 {_digits(z)}",
        mass=mass,
        diaginertia=f"{one} {one} {one}",
    )
    motor: dict[str, str | float] = {"name": "motor", "joint": "joint", "gear": joint.gear.value}
    if math.isfinite(joint.limit.value):
        motor["ctrlrange"] = f"{_digits(-joint.limit.value)} {_digits(joint.limit.value)}"
    if joint.lag_s.value > 0.0:
        motor |= {"dyntype": "filter", "dynprm": joint.lag_s.value}
    bias = joint.constant.value / joint.gear.value
    motor |= {"gainprm": "1", "biastype": "affine", "biasprm": f"{_digits(bias)} 0 0"}
    _add(_add(root, "actuator"), "general", **motor)
    return _text(root)


def urdf(joint: Joint) -> str:
    """A robot of one joint as URDF; the inertia of the motor is part of the link's."""
    mass, x, z, own = _link(joint)
    # Of a link that turns about its joint the inertia about its centre is what is not m l^2.
    least = SHARE * joint.inertia.value
    inertia = least if joint.slides else own + least
    effort = joint.limit.value * joint.gear.value
    root = ET.Element("robot", name="joint")
    limited = math.isfinite(effort)
    none = [] if limited else ["The model states no greatest effort: 0 stands for none."]
    _remark(root, joint, (*none, *_constant(joint), *_lag(joint)))
    _add(root, "link", name="base")
    inertial = _add(_add(root, "link", name="link"), "inertial")
    _add(inertial, "origin", xyz=f"{_digits(x)} 0 {_digits(z)}")
    _add(inertial, "mass", value=mass)
    about = {"ixx": inertia, "ixy": 0.0, "ixz": 0.0, "iyy": inertia, "iyz": 0.0, "izz": inertia}
    _add(inertial, "inertia", **about)
    kind = "prismatic" if joint.slides else "continuous"
    turned = _add(root, "joint", name="joint", type=kind)
    _add(turned, "parent", link="base")
    _add(turned, "child", link="link")
    _add(turned, "axis", xyz=_axis(joint))
    low, high = joint.travel
    ends = {"lower": low, "upper": high} if joint.slides else {}
    _add(turned, "limit", **ends, effort=effort if limited else 0.0, velocity=joint.speed)
    _add(turned, "dynamics", damping=joint.damping.value, friction=joint.friction.value)
    return _text(root)


def isaac(joint: Joint) -> str:
    """The fields of an actuator of Isaac Lab and of a joint drive in USD, as CSV.

    Angles of Isaac Lab are in radians, those of a drive in USD in degrees.
    """
    torque = "N" if joint.slides else "N m"
    per = "m" if joint.slides else "rad"
    inertia = "kg" if joint.slides else "kg m2"
    kind, usd_per = ("linear", "m") if joint.slides else ("angular", "deg")
    of_drive = 1.0 if joint.slides else math.pi / 180.0
    effort = joint.limit.times(joint.gear.value)
    rows: list[tuple[str, JointNumber, str]] = [
        ("ActuatorCfg.stiffness", JointNumber(0.0, 0.0, 0.0), f"{torque}/{per}"),
        ("ActuatorCfg.damping", joint.damping, f"{torque} s/{per}"),
        ("ActuatorCfg.armature", joint.inertia, inertia),
        ("ActuatorCfg.friction", joint.friction, torque),
        ("ActuatorCfg.dynamic_friction", joint.friction, torque),
        ("ActuatorCfg.viscous_friction", joint.damping, f"{torque} s/{per}"),
        ("ActuatorCfg.effort_limit", effort, torque),
        ("ActuatorCfg.velocity_limit", JointNumber(joint.speed), f"{per}/s"),
        (f"drive:{kind}:physics:stiffness", JointNumber(0.0, 0.0, 0.0), f"{torque}/{usd_per}"),
        (f"drive:{kind}:physics:damping", joint.damping.times(of_drive), f"{torque} s/{usd_per}"),
        (f"drive:{kind}:physics:maxForce", effort, torque),
        ("physxJoint:armature", joint.inertia, inertia),
        ("gear", joint.gear, f"{torque} per unit of the command"),
        ("actuator lag", joint.lag_s, "s"),
    ]
    written = io.StringIO()
    table = csv.writer(written, lineterminator="\n")
    for line in ("Give damping or viscous_friction, not both.", *_constant(joint), *joint.unsaid):
        written.write(f"# {line}\n")
    if joint.gravity.value > 0.0:
        mass, x, z, own = _link(joint)
        written.write(
            f"# Gravity: give the link a mass of {mass:.6g} kg at ({x:.6g}, 0, {z:.6g}) m about "
            f"the axis y, and the joint an armature of {own:.6g} {inertia} in the place of its "
            f"own. Torque {joint.gravity.value:.6g} {torque}, {joint.gravity.interval}.\n"
        )
    table.writerow(("field", "value", "low", "high", "unit"))
    for name, at, unit in rows:
        table.writerow((name, *(_cell(one) for one in at), unit))
    return written.getvalue()


ENDINGS: dict[str, Callable[[Joint], str]] = {".xml": mjcf, ".urdf": urdf, ".csv": isaac}
"""Formats by the ending of the file: MJCF, URDF, and the table for Isaac Sim."""


def _cell(value: float) -> str:
    return f"{value:.9g}" if math.isfinite(value) else ""


def _link(joint: Joint) -> tuple[float, float, float, float]:
    """Mass, place of its centre, and the inertia that is none of a point mass there.

    The weight of a link tells the product of mass and length. Half of the inertia is taken for
    that of the mass, which makes both definite and moves alike.
    """
    whole, weight = joint.inertia.value, joint.gravity.value
    if joint.slides:
        return whole * (1.0 - SHARE), 0.0, 0.0, SHARE * whole
    if not weight > 0.0:
        return 1.0, 0.0, 0.0, whole * (1.0 - SHARE)
    length, phase = 0.5 * whole * GRAVITY_m_s2 / weight, joint.phase_rad.value
    mass = weight / (GRAVITY_m_s2 * length)
    return mass, -length * math.sin(phase), -length * math.cos(phase), whole * (0.5 - SHARE)


def _add(parent: ET.Element, tag: str, **values: str | float) -> ET.Element:
    """A further element; numbers to nine digits."""
    texts = {n: v if isinstance(v, str) else _digits(v) for n, v in values.items()}
    return ET.SubElement(parent, tag, texts)


def _digits(value: float) -> str:
    return f"{value:.9g}"


def _axis(joint: Joint) -> str:
    return "1 0 0" if joint.slides else "0 1 0"


def _text(root: ET.Element) -> str:
    ET.indent(root)
    return f"{ET.tostring(root, 'unicode')}\n"


def _remark(root: ET.Element, joint: Joint, more: Iterable[str] = ()) -> None:
    """Comments: numbers with their intervals, then what the format cannot say."""
    torque, per = ("N", "m") if joint.slides else ("N m", "rad")
    named = {
        f"inertia, {'kg' if joint.slides else 'kg m2'}": joint.inertia,
        f"damping, {torque} s/{per}": joint.damping,
        f"dry friction, {torque}": joint.friction,
        f"torque of gravity, {torque}": joint.gravity,
        "its angle from hanging down at zero, rad": joint.phase_rad,
        f"gear, {torque} per unit of the command": joint.gear,
        "lag of the actuator, s": joint.lag_s,
        f"constant torque, {torque}": joint.constant,
    }
    numbers = [f"{n}: {at.value:.6g}, {at.interval}" for n, at in named.items() if at.value]
    for line in (*numbers, *more, *joint.unsaid):
        root.append(ET.Comment(f" {line.replace('--', '- -')} "))


def _constant(joint: Joint) -> list[str]:
    if not joint.constant.value:
        return []
    return [f"The drive has a constant torque of {joint.constant.value:.6g}, which no field says."]


def _lag(joint: Joint) -> list[str]:
    if not joint.lag_s.value:
        return []
    return [f"The actuator lags by {joint.lag_s.value:.6g} s, which no field says."]
