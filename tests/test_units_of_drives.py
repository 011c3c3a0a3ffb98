"""Columns of a drive in another unit than the model's, with gravity, friction or a spring."""

from dataclasses import replace

import numpy as np
import pytest

import plants
from plants.diagnosis.data.records import FolderContents
from plants.diagnosis.pipeline.check import check
from tests.support_joints import INERTIA, VISCOUS, Joint, RATE_Hz, record, turned

JOINTS = {
    "pendulum": Joint(weight=0.05),
    "dry": Joint(dry=0.02),
    "cogging": Joint(cogging=8e-3),
    "geared": Joint(share=0.3, weight=0.02),
}
UNITS = {
    "degrees": (57.29578, 1.0, {"angle_rad": "--unit angle=deg"}),
    "mN m": (1.0, 1e3, {"current_A": "--scale current=0.001"}),
    "both": (
        57.29578,
        1e3,
        {"angle_rad": "--unit angle=deg", "current_A": "--scale current=0.001"},
    ),
}


@pytest.fixture(scope="module")
def joints():
    return dict(zip(JOINTS, turned(JOINTS.values()), strict=True))


def said(m, angle=1.0, command=1.0, inertia=1.1 * INERTIA, viscous=0.7 * VISCOUS):
    """Issues of units of a record beside a sound one."""
    model = plants.servo(inertia, viscous, sampling_Hz=RATE_Hz)
    changed = replace(
        m, source="changed", angle_rad=angle * m.angle_rad, current_A=command * m.current_A
    )
    sound = replace(m, source="sound")
    found = check(FolderContents((sound, changed), ()), model).findings
    return [issue for issue in found if "seems to be in" in issue.sentence]


@pytest.mark.parametrize(
    ("kind", "unit"),
    # Without gravity degrees and mN m are one factor of 17.
    [*(("pendulum", unit) for unit in UNITS), ("dry", "degrees"), ("dry", "mN m")],
)
def test_column_of_a_drive_in_another_unit_is_refused_with_what_mends_it(joints, kind, unit):
    angle, command, remedies = UNITS[unit]
    issues = said(record(joints[kind], 14)[0], angle, command)
    assert {issue.source for issue in issues} == {"changed"}
    assert {issue.level for issue in issues} == {"refused"}
    assert {issue.column for issue in issues} == set(remedies)
    assert all(issue.sentence.endswith(remedies[issue.column]) for issue in issues)


@pytest.mark.parametrize("kind", JOINTS)
@pytest.mark.parametrize(("inertia", "viscous"), [(0.25, 0.1), (1.0, 1.0), (4.0, 10.0)])
def test_sound_record_of_a_drive_is_kept_whatever_its_law_and_its_model(
    joints, kind, inertia, viscous
):
    m, _ = record(joints[kind], 14)
    assert said(m, inertia=inertia * INERTIA, viscous=viscous * VISCOUS) == []


def test_drive_on_a_spring_is_not_taken_for_one_in_degrees():
    t = np.arange(4000) / RATE_Hz
    angle = 2.0 * np.sin(0.5 * t) + 0.5 * np.sin(1.7 * t)
    slope = np.gradient(angle, t)
    torque = INERTIA * np.gradient(slope, t) + VISCOUS * slope + 0.02 * angle
    assert said(record((angle, torque), 14)[0]) == []
