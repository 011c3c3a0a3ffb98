"""The identified joint in MJCF, URDF and the fields of Isaac Sim."""

import csv
import math
from types import SimpleNamespace
from xml.etree import ElementTree as ET

import numpy as np
import pytest

import plants
from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.trial.profiles import TriangleProfile
from plants.diagnosis.interval import Interval
from plants.diagnosis.models.calibration import Calibration
from plants.diagnosis.result import BaseParameter, NamedEffect
from plants.effects import CoulombFriction, CurrentLag, LinkGravity, LoadFriction, TorqueRipple
from plants.joint_export import export

SERVO = plants.servo(0.01, 0.02, torque_constant_Nm_A=0.5, current_limit_A=6.0, sampling_Hz=500.0)
STAGE = plants.stage(95.0, 200.0, force_constant_N_A=35.0, sampling_Hz=500.0)


def diagnosed(model, *effects):
    """A diagnosis of a model, as far as an export reads it."""
    inertia = Interval(model.drum_inertia_kg_m2, 0.009, 0.011, "kg m2")
    named = tuple(
        NamedEffect(
            e.name, e.title, {"torque_Nm": Interval(e.torque_Nm, 0.04, 0.06, "N m")}, "", e
        )
        for e in effects
    )
    model = model if not effects else model + effects[0]
    return SimpleNamespace(
        augmented=model,
        calibrations=(BaseParameter("inertia_kg_m2", "kg m2", 0.01, inertia, inertia),),
        effects=named,
        declared=(),
        traces=(),
    )


def written(diagnosis, path):
    return export(diagnosis, path).read_text("utf-8")


@pytest.mark.parametrize(
    ("model", "size"),
    [
        (SERVO, 0.8),
        (SERVO + CoulombFriction(torque_Nm=0.15), 0.8),
        (SERVO + LinkGravity(torque_Nm=0.6) + CoulombFriction(torque_Nm=0.1), 0.8),
        (SERVO + CurrentLag(lag_s=0.02), 0.8),
        (STAGE + CoulombFriction(torque_Nm=20.0), 60.0),
    ],
    ids=["servo", "dry friction", "link", "lag", "stage"],
)
def test_exported_joint_moves_in_mujoco_as_the_model_does(model, size, tmp_path):
    import mujoco  # noqa: PLC0415  slow to import, and no part of the product

    profile = TriangleProfile(0.0, size, 0.8, 3.2, 0.2, loop="open")
    moved = plants.simulate(model, Gains(1.0, 0.0, 0.0, 0.0), profile)
    joint = mujoco.MjModel.from_xml_string(written(diagnosed(model), tmp_path / "joint.xml"))
    state, angle = mujoco.MjData(joint), np.empty(moved.angle_rad.size)
    per_sample = round(1.0 / model.sampling_Hz / joint.opt.timestep)
    for n, setpoint in enumerate(profile.setpoint(model.sampling_Hz)):
        angle[n] = state.qpos[0]
        state.ctrl[0] = setpoint / model.torque_constant_Nm_A
        for _ in range(per_sample):
            mujoco.mj_step(joint, state)
    apart = angle - moved.angle_rad
    assert np.sqrt(np.mean(apart**2)) < 0.02 * np.std(moved.angle_rad)


def test_intervals_are_comments_and_what_mjcf_cannot_say_is_named(tmp_path):
    model = SERVO + LoadFriction(load_share=0.3) + TorqueRipple(amplitude_Nm=0.02, per_turn=24.0)
    text = written(diagnosed(model, CoulombFriction(torque_Nm=0.05)), tmp_path / "joint.xml")
    assert "dry friction, N m: 0.05, 95 % interval 0.04 to 0.06" in text
    assert "inertia, kg m2: 0.01, 95 % interval 0.009 to 0.011" in text
    assert "grows with the load, 30 % of it against the motion" in text
    assert "24 times a turn" in text
    assert text.count("no field says so, it is left out") == 2


def test_urdf_has_the_mass_of_a_link_and_the_constant_torque_as_a_remark(tmp_path):
    model = SERVO + LinkGravity(torque_Nm=0.6, phase_rad=0.3) + Calibration(torque_offset_Nm=0.02)
    text = written(diagnosed(model), tmp_path / "joint.urdf")
    robot = ET.fromstring(text)  # noqa: S314  written above
    inertial = robot.find("link[@name='link']/inertial")
    mass = float(inertial.find("mass").get("value"))
    x, _, z = map(float, inertial.find("origin").get("xyz").split())
    assert mass * 9.80665 * math.hypot(x, z) == pytest.approx(0.6)
    assert math.atan2(-x, -z) == pytest.approx(0.3)
    about_centre = float(inertial.find("inertia").get("iyy"))
    assert about_centre + mass * (x**2 + z**2) == pytest.approx(0.01)
    assert float(robot.find("joint/limit").get("effort")) == pytest.approx(3.0)
    assert "a constant torque of 0.02" in text


def test_fields_of_isaac_sim_are_in_their_own_units(tmp_path):
    text = written(diagnosed(SERVO, CoulombFriction(torque_Nm=0.05)), tmp_path / "joint.csv")
    rows = {r["field"]: r for r in csv.DictReader(x for x in text.splitlines() if x[0] != "#")}
    assert float(rows["ActuatorCfg.damping"]["value"]) == 0.02
    damping = rows["drive:angular:physics:damping"]
    assert float(damping["value"]) == pytest.approx(0.02 * math.pi / 180.0)
    assert damping["unit"] == "N m s/deg"
    friction = rows["ActuatorCfg.friction"]
    assert [float(friction[n]) for n in ("value", "low", "high")] == [0.05, 0.04, 0.06]


@pytest.mark.parametrize(
    ("model", "name", "said"),
    [
        (SERVO, "joint.sdf", r"must be one of \.xml, \.urdf, \.csv"),
        (plants.reference_reel(), "joint.xml", "a reel is no joint"),
    ],
)
def test_export_says_what_it_cannot_write(model, name, said, tmp_path):
    with pytest.raises(InvalidInput, match=said):
        export(SimpleNamespace(augmented=model), tmp_path / name)
