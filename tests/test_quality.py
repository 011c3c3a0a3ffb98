"""Checks of measurements before any fit: refusals and warnings with their reasons."""

from dataclasses import replace

import numpy as np
import pytest

import plants
from estune.errors import InvalidInput
from estune.trial import SATURATED, TrialRequest
from estune.trial.profiles import MultisineProfile
from experiments.paper.identify.excitation import Band, chirp, multisine
from experiments.paper.identify.open_loop import open_loop_record
from plants import reference_reel
from plants.diagnosis.checks.sensors import faults
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.records import FolderContents
from plants.diagnosis.pipeline import check as step
from plants.effects import CoulombFriction
from tests.support_measurements import open_loop

RATE = 632.0
REEL = reference_reel()
SINES = multisine(RATE, Band(1.0, 60.0, periods=2), 4.0)


def check(measurements, model):
    """The measurements that can be used, and all issues."""
    usable = step.check(FolderContents(tuple(measurements), ()), model)
    return usable.measurements, usable.findings


def measure(excitation, seed=0, name="bad"):
    return replace(MeasuredRecord.of(open_loop_record(REEL, excitation, seed=seed)), source=name)


GOOD = measure(SINES, name="good")
SWEPT = measure(chirp(RATE, Band(1.0, 40.0, periods=2), 4.0))


def closed_loop_record():
    rig = REEL.rig()
    about = rig.describe()
    return replace(
        MeasuredRecord.of(rig.run(TrialRequest("r", 0, about.gains, about.step))), source="c"
    )


def findings(m, model=REEL, good=GOOD):
    """Issues of a measurement; a good one beside it must have none."""
    accepted, issues = check([good, m], model)
    assert good in accepted
    assert not [f for f in issues if f.source == "good"]
    assert (m in accepted) == (not any(f.level == "refused" for f in issues))
    return issues


@pytest.mark.parametrize("m", [SWEPT, closed_loop_record()], ids=["open loop", "closed loop"])
def test_healthy_record_has_no_issues(m):
    assert findings(replace(m, rig=GOOD.rig)) == ()


UNITS = {
    "angle in degrees": ({"angle_rad": np.rad2deg}, "angle_rad", "degrees"),
    "tension in kN": ({"tension_N": lambda x: x / 1e3}, "tension_N", "kN"),
    "setpoint in mN": ({"setpoint_N": lambda x: x * 1e3}, "setpoint_N", "mN"),
}


@pytest.mark.parametrize("case", UNITS)
@pytest.mark.parametrize("wrong_by", [0.8, 1.25])
def test_column_in_another_unit_is_refused_with_a_wrong_model(case, wrong_by):
    changed, column, unit = UNITS[case]
    bad = replace(
        SWEPT, **{name: change(getattr(SWEPT, name)) for name, change in changed.items()}
    )
    model = replace(
        REEL, torque_constant_Nm_A=REEL.torque_constant_Nm_A * wrong_by, current_limit_A=9
    )
    _, issues = check([GOOD, bad], model)
    (finding,) = [f for f in issues if f.level == "refused"]
    assert (finding.source, finding.column) == ("bad", column)
    assert unit in finding.sentence


STAGE = plants.stage(95.0, 200.0)


def stage_record(**changed):
    """A carriage driven to and fro."""
    t = np.arange(3000) / 1000.0
    force = 60.0 * np.sin(3.0 * t) + 20.0 * np.sin(11.0 * t)
    states, x, v = [], 0.0, 0.0
    for f in force:
        states.append(x)
        v += (f - 200.0 * v) / 95.0 / 1000.0
        x += v / 1000.0
    return replace(open_loop(1, 1000.0, force, angle_rad=np.array(states)), **changed)


def test_stage_in_the_units_of_its_model_has_no_issues():
    assert findings(stage_record(), STAGE, stage_record(source="good")) == ()


@pytest.mark.parametrize(
    ("change", "column", "told"),
    [
        (lambda m: {"angle_rad": 1e3 * m.angle_rad}, "angle_rad", "in thousandths, as mm"),
        (
            lambda m: {"time_s": 1e3 * m.time_s, "sampling_Hz": 1.0},
            "time_s",
            "seems to be in ms; give s",
        ),
        (lambda m: {"current_A": -m.current_A}, "current_A", "its sign seems to be reversed"),
        (lambda m: {"current_A": 1e3 * m.current_A}, "current_A", "in thousandths, as mN m, mN"),
        (lambda m: {"current_A": 1e-3 * m.current_A}, "angle_rad", "or the command in kN"),
        (lambda m: {"angle_rad": 57.3 * m.angle_rad}, "angle_rad", "in degrees"),
    ],
)
def test_record_in_another_unit_or_of_another_sign_is_refused(change, column, told):
    m = stage_record()
    found = findings(replace(m, **change(m)), STAGE, replace(m, source="good"))
    (issue,) = [i for i in found if i.level == "refused"]
    assert issue.column == column
    assert told in issue.sentence


def test_angle_that_may_be_in_turns_is_told_and_used():
    m = stage_record()
    turned = replace(m, angle_rad=m.angle_rad / (2.0 * np.pi))
    (issue,) = findings(turned, STAGE, replace(m, source="good"))
    assert issue.level == "warning"
    assert "turns" in issue.sentence


@pytest.mark.parametrize(
    ("setpoint", "told"),
    [
        (lambda x: x, "it is the position in the unit of the position"),
        (lambda x: np.gradient(x, 1e-3), "it is the velocity in the unit of the position"),
        (lambda x: 1e3 * np.gradient(x, 1e-3), "it is the velocity in thousandths"),
    ],
)
def test_setpoint_of_an_inner_loop_is_said_to_be_one(setpoint, told):
    m = stage_record()
    assert m.angle_rad is not None
    late = 8  # the loop follows after 8 ms
    asked = np.concatenate([m.angle_rad[late:], np.full(late, m.angle_rad[-1])])
    noise = np.random.default_rng(0).normal(0.0, 0.02, m.samples)
    command = setpoint(asked) * (1.0 + noise)
    good = stage_record(source="good")
    (issue,) = findings(replace(m, loop="closed", setpoint_N=None, current_A=command), STAGE, good)
    assert (issue.level, issue.column) == ("refused", "current_A")
    assert told in issue.sentence


def test_torque_that_holds_a_link_against_gravity_is_no_setpoint():
    """0.75 N m/rad, 0.2 s ahead for the friction: no loop follows to three quarters."""
    t = np.arange(3000) / 200.0
    angle, ahead = (1.3 * np.sin(0.6 * np.pi * (t + lead)) for lead in (0.0, 0.2))
    command = 0.75 * ahead + 0.01 * np.random.default_rng(0).standard_normal(t.size)
    held = replace(open_loop(0, 200.0, command, angle_rad=angle), loop="closed", source="held")
    _, issues = check([held], plants.servo(0.011, 0.05, sampling_Hz=200.0))
    assert not [issue for issue in issues if "setpoint" in issue.sentence]


def test_noisy_command_that_moves_a_drive_is_not_called_still():
    m = stage_record()
    noise = np.random.default_rng(0).normal(0.0, m.current_A.std(), m.samples)
    noisy = replace(m, current_A=m.current_A + noise)
    assert findings(noisy, STAGE, replace(m, source="good")) == ()


def test_reel_whose_current_has_the_other_sign_is_refused():
    m = closed_loop_record()
    (issue,) = findings(replace(m, current_A=-m.current_A, rig=GOOD.rig))
    assert (issue.level, issue.column) == ("refused", "current_A")
    assert "reversed" in issue.sentence


def test_drum_that_friction_holds_shows_no_sign():
    """Its tension creeps by 0.15 N, and the controller's integral answers by 2.6 N."""
    m = closed_loop_record()
    short = 0.15 * m.time_s / m.time_s[-1] + 0.04 * np.random.default_rng(0).standard_normal(
        m.samples
    )
    asked = 0.66 + 0.45 * np.cumsum(short) / RATE
    angle = np.where(m.time_s > 0.2, 0.0775, 0.0782)
    held = replace(m, rig=GOOD.rig, tension_N=15.0 - short, current_A=asked, angle_rad=angle)
    issues = findings(replace(held, setpoint_N=np.where(m.time_s > 0.2, 15.1, 15.0)))
    assert not [issue for issue in issues if issue.level == "refused"]


def arm(seconds, effort_Nm, *, load_share=0.4, beginning=0.0):
    """A geared joint with a link: gravity, and friction that grows with its load."""
    angle, speed, angles = beginning, 0.0, []
    for u in effort_Nm(np.arange(round(200.0 * seconds)) / 200.0):
        for _ in range(20):
            load = 0.48 * np.sin(angle)
            held = 0.02 + load_share * abs(load)
            speed += (u - load - 0.01 * speed) / 0.006 / 4000.0
            speed = np.sign(speed) * max(abs(speed) - held / 0.006 / 4000.0, 0.0)
            angle += speed / 4000.0
        angles.append(angle)
    t = np.arange(len(angles)) / 200.0
    torque = effort_Nm(t)
    rounded = np.rint(np.array(angles) / 1.5e-3) * 1.5e-3
    return replace(open_loop(0, 200.0, torque, angle_rad=rounded), loop="closed", setpoint_N=None)


def test_torque_of_the_other_sign_is_told_of_a_joint_with_a_link():
    moving = arm(8.0, lambda t: 0.45 * np.sin(2.0 * t) + 0.35 * np.sin(5.3 * t))
    resting = arm(8.0, lambda t: np.where(t < 1.0, 0.3 * t, 0.3 - 0.05 * np.exp(1.0 - t)))
    right = [replace(m, source=name) for m, name in ((moving, "moving"), (resting, "resting"))]
    joint = plants.servo(0.005, 0.01, sampling_Hz=200.0)
    accepted, _ = check(right, joint)
    assert len(accepted) == 2
    with pytest.raises(InvalidInput, match=r"moving, column current_A: .* reversed.*resting, col"):
        check([replace(m, current_A=-m.current_A) for m in right], joint)


def test_closed_loop_current_in_mA_is_refused():
    m = closed_loop_record()
    (finding,) = findings(replace(m, rig=GOOD.rig, current_A=m.current_A * 1e3, flags=None))[:1]
    assert finding.column == "current_A"


def test_records_of_another_rig_are_refused():
    (finding,) = findings(replace(SWEPT, rig="another"))
    assert finding.level == "refused"
    assert "another" in finding.sentence


def test_fast_multisine_moves():
    fast = measure(multisine(RATE, Band(63.0, 284.0, periods=2), 6.0))
    assert findings(fast) == ()


def cut(m, samples, **changed):
    names = ("time_s", "setpoint_N", "current_A", "tension_N", "angle_rad", "flags")
    return replace(m, **{n: getattr(m, n)[:samples] for n in names}, **changed)


def test_record_shorter_than_half_a_period_is_refused():
    slow = replace(REEL, drum_inertia_kg_m2=4.0)
    _, issues = check([GOOD, cut(SWEPT, 100)], slow)
    assert [f.level for f in issues if f.source == "bad"] == ["refused"]


def test_record_without_motion_is_refused():
    rng = np.random.default_rng(0)
    still = replace(
        SWEPT,
        setpoint_N=np.full(SWEPT.samples, 15.0),
        current_A=np.full(SWEPT.samples, 0.75),
        tension_N=15.0 + rng.normal(0.0, 0.04, SWEPT.samples),
        angle_rad=np.full(SWEPT.samples, 0.1),
    )
    (finding,) = findings(still)
    assert (finding.level, "excite" in finding.sentence) == ("refused", True)


def test_gauge_faults_are_reported_with_the_row():
    rng = np.random.default_rng(1)
    railed = np.minimum(SWEPT.tension_N, np.quantile(SWEPT.tension_N, 0.97))
    (finding,) = findings(replace(SWEPT, tension_N=railed))
    assert "end of the range" in finding.sentence
    frozen = SWEPT.tension_N.copy()
    frozen[700:760] = frozen[700]
    (finding,) = findings(replace(SWEPT, tension_N=frozen))
    assert finding.row == 701
    assert "stand still" in finding.sentence
    lost = SWEPT.tension_N.copy()
    rows = np.sort(rng.choice(lost.size - 100, 5, replace=False)) + 50
    lost[rows] = 0.0
    (finding,) = findings(replace(SWEPT, tension_N=lost))
    assert finding.row == rows[0] + 1
    assert "jump" in finding.sentence


def test_frozen_encoder_is_reported_with_the_row():
    stuck = SWEPT.angle_rad.copy()
    begin = 1 + int(np.flatnonzero(np.diff(stuck[:700]))[-1])
    stuck[begin:900] = stuck[begin]
    (finding,) = findings(replace(SWEPT, angle_rad=stuck))
    assert (finding.level, finding.column, finding.row) == ("warning", "angle_rad", begin + 1)
    assert f"still for {900 - begin} samples while the tension moves" in finding.sentence
    issues = findings(replace(SWEPT, angle_rad=np.full(SWEPT.samples, SWEPT.angle_rad[0])))
    assert ("refused", "angle_rad") in [(f.level, f.column) for f in issues]


def test_encoder_stands_still_where_the_drum_turns_less_than_a_step():
    coarse = 0.008  # rad
    still = measure(chirp(RATE, Band(1.0, 40.0, periods=2), 0.2))
    middle = replace(still, angle_rad=still.angle_rad - still.angle_rad.mean())
    rough = [replace(m, angle_rad=coarse * np.round(m.angle_rad / coarse)) for m in (GOOD, middle)]
    assert np.ptp(rough[1].angle_rad) == 0.0
    _, issues = check(rough, REEL)
    assert not [f for f in issues if "stand still" in f.sentence]


def test_encoder_of_a_drum_that_friction_holds_is_not_at_the_end_of_its_range():
    rig = replace(REEL, effects=(CoulombFriction(0.05),)).rig()
    sines = MultisineProfile(20.0, 2.2, period_s=1.0, first_line=1, last_line=60, duration_s=3.0)
    held = MeasuredRecord.of(rig.run(TrialRequest("r", 0, rig.describe().gains, sines)))
    assert np.unique(held.angle_rad).size == 2
    assert findings(replace(held, rig=GOOD.rig)) == ()


def test_drive_that_sticks_is_no_broken_sensor():
    # It rests for a second, and goes on from where it stood.
    t = np.arange(4000) / 500.0
    moving = (t % 2.0) > 1.0
    angle = np.cumsum(np.where(moving, np.sin(2.0 * np.pi * t) ** 2, 0.0)) / 500.0
    angle += np.where(moving, 1e-3 * np.random.default_rng(1).standard_normal(t.size), 0.0)
    assert not list(faults("angle_rad", angle))
    frozen = np.where((t > 3.2) & (t < 3.6), angle[1600], angle)
    assert ["stand still" in fault.sentence for fault in faults("angle_rad", frozen)] == [True]


@pytest.mark.parametrize(("share", "level"), [(0.2, "warning"), (0.8, "refused")])
def test_record_at_the_current_limit_is_reported(share, level):
    flags = np.where(np.arange(SWEPT.samples) < share * SWEPT.samples, SATURATED, 0)
    (finding,) = findings(replace(SWEPT, flags=flags.astype(np.uint8)))
    assert (finding.level, finding.column, finding.row) == (level, "current_A", 1)


def test_shifted_channels_are_reported():
    (finding,) = findings(replace(SWEPT, tension_N=np.roll(SWEPT.tension_N, 7)))
    assert (finding.column, "7 samples after" in finding.sentence) == ("tension_N", True)


def test_noisy_measured_current_is_no_reason_to_refuse_a_record():
    rng = np.random.default_rng(2)
    steps = 0.75 + 0.1 * np.sign(np.sin(4.0 * GOOD.time_s))  # A, under noise of 0.5 A rms
    noisy = steps + 0.5 * rng.normal(size=steps.size)
    m = replace(GOOD, setpoint_N=20.0 * steps, current_A=noisy, source="noisy")
    assert not [f for f in findings(m) if f.column == "current_A"]


def test_wrong_loop_label_is_reported():
    shuffled = np.random.default_rng(2).permutation(SWEPT.current_A)
    (finding,) = findings(replace(SWEPT, current_A=shuffled))
    assert (finding.level, "labelled open" in finding.sentence) == ("refused", True)
    (finding,) = findings(replace(SWEPT, loop="closed"))
    assert (finding.level, "labelled closed" in finding.sentence) == ("warning", True)


def test_torque_as_a_function_of_position_is_reported():
    t = SWEPT.time_s
    angle = 0.1 + 0.05 * np.sin(2.0 * np.pi * 0.7 * t)
    slow = replace(
        SWEPT,
        loop="closed",
        setpoint_N=None,
        current_A=0.75 + 4.0 * (angle - 0.1),
        tension_N=None,
        angle_rad=angle,
        flags=None,
    )
    assert any("function of the angle" in f.sentence for f in findings(slow))


def test_error_reports_every_refused_record():
    still = replace(SWEPT, flags=np.full(SWEPT.samples, SATURATED, np.uint8))
    with pytest.raises(InvalidInput, match=r"one.*two"):
        check([replace(still, source="one"), replace(still, source="two")], REEL)
