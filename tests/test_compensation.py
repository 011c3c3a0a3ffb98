"""Compensations of the hardware loop: in Python, as C, in the rig's file, and in records."""

import json
import math
import subprocess
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import bilinear, lfilter, lfilter_zi

from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.hardware.compensation.plan import KnownMotion
from estune.hardware.compensation.runtime import CompiledCompensation, PlainCompensation
from estune.hardware.config import read_config
from estune.hardware.controller import PlainController
from estune.reel.friction import FrictionFeedForward, StribeckFriction, slid
from estune.reel.gravity import gravity_force_by_position_N
from estune.reel.velocity import motion
from estune.run.results.export import write_record
from estune.support import c_compiler
from estune.trial import SATURATED, Outcome, TrialRecord, TrialRequest
from estune.trial.loop_records import loop_signals
from estune.trial.profiles import StepProfile, TriangleProfile
from estune.trial.records import COMPENSATION_COLUMNS
from experiments.virtual_loop import virtual_rig
from plants.diagnosis.data.records import read_measurements
from plants.emulator import RIG_FILE
from tests.support_hardware import config

FRICTION = {
    "coulomb_Nm": 0.06,
    "static_Nm": 0.09,
    "stribeck_rad_s": 0.5,
    "tension_per_rad_N": 190.0,
}
ALL = {
    "friction": FRICTION | {"spread": 3.0},
    "inertia": {"inertia_kgm2": 0.002},
    "known_motion": {"inertia_kgm2": 0.001, "viscous_Nms_rad": 0.01},
    "gravity": {"weight_N_m": 0.5, "rise_m": 0.4, "length_min_m": 0.5, "length_max_m": 1.4},
    "angle_map": {
        "zero": "index",
        "orders": [1, 7],
        "torque_Nm": [0.0, 0.02],
        "load_share": [0.02, 0.0],
        "phase_rad": [0.3, -1.0],
        "zero_rad": 0.1,
        "lead_s": 0.002,
    },
    "hum": {"frequency_Hz": 50.0},
    "mode": {"frequency_Hz": 90.0, "width_Hz": 20.0, "depth": 0.3},
    "eyelet": {"attenuation": 0.95, "memory_rad": 0.004, "tension_per_rad_N": 190.0},
    "current_limit": {"limit_A": 2.0},
}
COUNT = 2.0 * math.pi / 8192


def rig_file(**compensation):
    return config(compensation=compensation or ALL)


MAP = ALL["angle_map"]


@cache
def both():
    rig = rig_file()
    plan = rig.plan()
    return plan.compensation, plan.compensation_source


def drum(samples: int, rate_Hz: float = 632.0):
    """Times, tensions and angles of a drum that swings, in encoder counts."""
    times = np.arange(samples) / rate_Hz
    angles = COUNT * np.round(0.4 * np.sin(12.0 * times) / COUNT)
    return times, 15.0 + 8.0 * np.sin(31.0 * times), angles


@settings(max_examples=50)
@given(
    st.lists(
        st.tuples(
            st.sampled_from((1.0 / 632.0, 0.003, -0.01, math.nan)) | st.floats(1e-4, 1e-2),
            st.floats(-20.0, 80.0) | st.just(math.nan),
            st.integers(-40, 40) | st.just(math.nan),
            st.floats(5.0, 40.0) | st.just(math.nan),
            st.floats(-0.2, 0.2) | st.sampled_from((0.0, 0.1)),
        ),
        min_size=5,
        max_size=60,
    )
)
def test_compiled_compensation_equals_the_plain_one(steps):
    plan, source = both()
    plain, compiled = PlainCompensation(plan), CompiledCompensation(source)
    time = 100.0
    for interval, tension, counts, *known in steps:
        time = time + interval if math.isfinite(interval) else time
        at = time if math.isfinite(interval) else math.nan
        one = plain.sample(at, tension, counts * COUNT, KnownMotion(*known))
        two = compiled.sample(at, tension, counts * COUNT, KnownMotion(*known))
        np.testing.assert_allclose(two, one, rtol=1e-12, atol=1e-12)
        assert abs(one.feed_forward_N) <= plan.feed_forward_max_N * (1.0 + 1e-12)


def test_terms_are_those_of_the_equations():
    plan, source = both()
    times, tensions, angles = drum(300)
    compensation = CompiledCompensation(source)
    setpoint = 15.0 + 6.0 * np.cumsum(np.sin(7.0 * times)) / 632.0
    known = [KnownMotion(float(r), 0.02) for r in setpoint]
    rows = zip(times, tensions, angles, known, strict=True)
    terms = np.array([compensation.sample(*row) for row in rows])
    moved = motion(plan.windows, times, angles)
    radius = 0.025
    np.testing.assert_allclose(terms[:, 0], moved.velocity_rad_s, rtol=1e-12)
    np.testing.assert_allclose(
        terms[:, 1],
        gravity_force_by_position_N(0.5, 0.8 - radius * angles, rise_m=0.4, tension_1_N=tensions),
        rtol=1e-12,
    )
    velocity = np.diff(setpoint) * 632.0 / 190.0 - 0.02 / radius  # of the drum, as it is known
    friction = 0.8 * plan.friction.friction.torque_Nm(velocity) / radius
    settled = np.abs(np.cumsum(velocity) / 632.0) > 30.0 * plan.friction.memory_rad
    assert settled.sum() > 250
    np.testing.assert_allclose(terms[1:, 2][settled], friction[settled])
    measured = 0.002 * moved.acceleration_rad_s2 / radius
    announced = -0.01 * 0.02 / radius**2  # viscous friction of a drum that pays out at 0.02 m/s
    np.testing.assert_allclose(terms[4:, 3], measured[4:] + announced, atol=1e-12)
    forward, ahead = setpoint, angles - 0.1 + 0.002 * terms[:, 0]
    waves = 0.02 * forward * np.sin(ahead + 0.3) + 0.02 / radius * np.sin(7.0 * ahead - 1.0)
    np.testing.assert_allclose(terms[1:, 4], 0.8 * waves[1:], rtol=1e-12)
    shapes = ((50.0, 3.0, 0.0), (90.0, 20.0, 0.3))
    notched = tensions
    for frequency, width, depth in shapes:
        notched = filtered_by_a_notch(notched, frequency, width, depth)
    np.testing.assert_allclose(terms[:, 5], tensions - notched, atol=1e-9)
    outside = forward[1:] * 0.95 ** (-0.8 * np.sign(velocity))
    slid = np.abs(np.cumsum(velocity) / 632.0) > 30.0 * 0.004
    np.testing.assert_allclose(terms[1:, 6][slid], (outside - forward[1:])[slid])
    np.testing.assert_allclose(terms[:, 7], 2.0 * 20.0)
    assert np.abs(terms).max(axis=0).min() > 0.1


def filtered_by_a_notch(signal, frequency_Hz, width_Hz, depth):
    """By the bilinear transform of `(s^2 + d w s + W^2)/(s^2 + w s + W^2)`, from rest."""
    rate = 632.0
    center = 2.0 * rate * np.tan(np.pi * frequency_Hz / rate)
    wide = 2.0 * rate * np.tan(np.pi * width_Hz / rate)
    # The width is that of the discrete filter: the bilinear transform stretches it at the center.
    wide *= 1.0 + (center / (2.0 * rate)) ** 2
    b, a = bilinear([1.0, depth * wide, center**2], [1.0, wide, center**2], rate)
    return lfilter(b, a, signal, zi=lfilter_zi(b, a) * signal[0])[0]


def rig_with(compensation=None, take_up_A=0.5, **settings):
    """A rig in virtual time whose emulated drum has dry friction."""
    friction = {"name": "coulomb_friction", "torque_Nm": FRICTION["coulomb_Nm"]}
    settings = {"effects": [friction], "electronics": {"watchdog_s": 0.02}, "seed": 1} | settings
    changes = {"driver__settings": settings, "motion__take_up_A": take_up_A}
    if compensation:
        changes["compensation"] = compensation
    return virtual_rig(config(**changes))


# With the whole inertia the emulated reel oscillates within the limit of the feed-forward.
GENTLE = ALL | {"inertia": {"inertia_kgm2": 0.0003}}


def trial(rig, profile=None) -> TrialRecord:
    about = rig.describe()
    return rig.run(TrialRequest("c", 0, about.gains, profile or about.step))


def test_trial_without_compensation_is_as_before():
    with rig_with() as rig, rig_with({"gravity": ALL["gravity"] | {"weight_N_m": 1e-9}}) as other:
        one, two = trial(rig), trial(other)
    assert not one.optional_columns
    assert set(two.optional_columns) == {"gravity_N"}
    np.testing.assert_allclose(one.tension_N, two.tension_N, atol=1e-6)


def test_record_shows_each_compensation_and_the_current_is_their_sum():
    with rig_with(GENTLE) as rig:
        record = trial(rig)
        description = rig.describe()
    assert set(record.optional_columns) == set(COMPENSATION_COLUMNS)
    assert all(np.abs(column).max() > 0.0 for column in record.optional_columns.values())
    fed = record.friction_A + record.inertia_A + record.angle_map_A
    assert np.abs(fed).max() <= 0.2 * 6.0 + 1e-9
    np.testing.assert_allclose(record.controller_A, record.current_A - fed)
    assert loop_signals(record, description.step, description).record is not None


def test_exported_record_with_compensations_is_read_back_without_remarks(tmp_path):
    with rig_with(GENTLE) as rig:
        record = trial(rig)
    exported = write_record(record, tmp_path)
    assert "gravity_N" in exported.read_text().partition("\n")[0]
    read = read_measurements(tmp_path)
    assert not read.findings
    assert np.array_equal(read.measurements[0].tension_N, record.tension_N)


FRICTIONS = {
    "Coulomb, small": ({"name": "coulomb_friction", "torque_Nm": 0.01}, {}),
    "Coulomb, large": ({"name": "coulomb_friction", "torque_Nm": 0.08}, {}),
    "Stribeck": (
        {
            "name": "stribeck_friction",
            "coulomb_Nm": 0.04,
            "excess_Nm": 0.03,
            "stribeck_rad_s": 0.5,
        },
        {"static_Nm": 0.07},
    ),
    "Dahl": (
        {"name": "dahl_hysteresis", "torque_Nm": 0.05, "presliding_rad": 0.004},
        {"memory_rad": 0.004},
    ),
}
TRIANGLE = TriangleProfile(20.0, 3.0, period_s=2.0, start_s=0.2, duration_s=4.2)


def friction_table(name, fraction):
    hidden, changes = FRICTIONS[name]
    size = hidden.get("torque_Nm", hidden.get("coulomb_Nm"))
    table = FRICTION | {"coulomb_Nm": size, "static_Nm": size, "fraction": fraction} | changes
    return hidden, {"friction": table, "share_max": 0.5}


REST, TRACKING = (StepProfile(15.0, 2.0, 0.2, 3.0), 1264), (TRIANGLE, 632)
"""A step and a triangle, and the sample from which on their errors count."""


def error_N(motion, hidden, compensation):
    """Standard deviation of the control error."""
    # Not the gains of the file: slow ones leave the tension creeping.
    gains = Gains(0.78, 31.0, 0.0206, 0.0003)
    profile, begin = motion
    with rig_with(compensation, effects=[hidden], take_up_A=1.0) as rig:
        record = rig.run(TrialRequest("c", 0, gains, profile))
    assert record.outcome is Outcome.DONE
    return np.std((record.tension_N - record.setpoint_N)[begin:])


@pytest.mark.parametrize(
    "name",
    ["Stribeck", *(pytest.param(n, marks=pytest.mark.slow) for n in FRICTIONS if n != "Stribeck")],
)
def test_friction_along_the_known_motion_improves_tracking_and_keeps_the_rest_calm(name):
    hidden, _ = friction_table(name, 0.8)
    calm = error_N(REST, hidden, None)
    for fraction in (0.8, 1.2):
        assert error_N(REST, *friction_table(name, fraction)) <= 1.2 * calm
    tracking = error_N(TRACKING, hidden, None)
    error = error_N(TRACKING, *friction_table(name, 0.8))
    frictionless = error_N(TRACKING, FRICTIONLESS, None)
    # Four fifths of what friction adds to the squared error, as the fraction says.
    assert tracking**2 - error**2 >= 0.65 * (tracking**2 - frictionless**2)


FRICTIONLESS = {"name": "coulomb_friction", "torque_Nm": 0.0}


def test_friction_law_turns_its_direction_over_the_presliding_distance():
    law = FrictionFeedForward(StribeckFriction(0.05, 0.05, 1.0), memory_rad=0.004)
    direction = 1.0
    for _ in range(40):  # at any pace
        direction = slid(direction, -0.0001, law.memory_rad)
    assert direction == pytest.approx(-1.0 + 2.0 * math.exp(-1.0))
    assert slid(direction, 0.0, law.memory_rad) == direction
    assert law.force_N(direction, 0.1, 15.0, 0.025) == pytest.approx(0.8 * direction * 2.0)


def test_load_friction_follows_the_known_tension():
    table = FRICTION | {"coulomb_Nm": 0.0, "static_Nm": 0.0, "load_share": 0.1}
    compensation = PlainCompensation(rig_file(friction=table).compensations())
    for k, setpoint in enumerate((20.0, 21.0, 22.0)):
        terms = compensation.sample(k / 632.0, 5.0, 0.0, KnownMotion(setpoint))
    assert terms.friction_N == pytest.approx(0.8 * 0.1 * 22.0)


def test_the_drives_limit_holds_and_the_record_shows_it():
    with rig_with({"current_limit": {"limit_A": 1.0}}) as rig:
        record = trial(rig)
    assert set(record.optional_columns) == {"current_limit_A"}
    np.testing.assert_allclose(record.current_limit_A, 1.0)
    assert record.current_A.max() == pytest.approx(1.0)
    assert (record.flags[record.current_A > 0.999] & SATURATED).all()


def test_open_loop_is_not_compensated():
    with rig_with(GENTLE) as rig:
        record = trial(rig, StepProfile(15.0, 5.0, 0.2, 0.5, loop="open"))
    assert not record.friction_A.any()
    np.testing.assert_allclose(record.current_A * 20.0, record.setpoint_N)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"friction": {"coulomb_Nm": 0.02, "tension_per_rad_N": 1.0}}, "give either file"),
        ({"friction": FRICTION | {"tension_per_rad_N": 0.0}}, "tension_per_rad_N"),
        ({"friction": FRICTION | {"fraction": 1.5}}, "fraction"),
        ({"friction": FRICTION | {"static_Nm": 0.01}}, "the static one not below"),
        ({"friction": FRICTION | {"static_Nm": 9.0}}, "check the unit of static_Nm"),
        ({"friction": FRICTION | {"coulomb_Nm": math.nan}}, "coulomb_Nm"),
        ({"friction": {"file": "missing.json", "tension_per_rad_N": 1.0}}, "missing.json"),
        ({"gravity": ALL["gravity"] | {"length_min_m": 0.9}}, "is outside compensation.gravity"),
        ({"gravity": ALL["gravity"] | {"rise_m": 0.6}}, "the cable would not reach"),
        ({"gravity": ALL["gravity"] | {"weight_N_m": 50.0}}, "check the unit of weight_N_m"),
        ({"angle_map": MAP | {"phase_rad": [0.0]}}, "phase_rad has 1 numbers and orders has 2"),
        ({"angle_map": MAP | {"torque_Nm": [0.0, 9.0]}}, "check the unit of torque_Nm"),
        ({"angle_map": MAP | {"torque_Nm": [], "load_share": []}}, "give torque_Nm"),
        ({"angle_map": {k: v for k, v in MAP.items() if k != "zero"}}, "zero"),
        ({"hum": {"frequency_Hz": 315.0}}, "half the sampling rate"),
        ({"mode": {"frequency_Hz": 30.0, "width_Hz": 40.0}}, "half the sampling rate"),
        ({"eyelet": ALL["eyelet"] | {"attenuation": 1.1}}, "attenuation"),
        ({"eyelet": ALL["eyelet"], "friction": FRICTION | {"tension_per_rad_N": 9.0}}, "same one"),
        ({"current_limit": {"limit_A": 6.0}}, "is not below the rig's own greatest current"),
        ({"velocity": {"weak": 3.0}, "friction": FRICTION}, "thresholds weak"),
        ({"share_max": 0.3}, "switches nothing on"),
    ],
)
def test_wrong_compensation_is_refused_when_the_file_is_read(changes, words):
    with pytest.raises(InvalidInput, match=words):
        rig_file(**changes)


def test_friction_is_read_from_a_file_beside_the_rigs_file(tmp_path):
    numbers = {name: FRICTION[name] for name in ("coulomb_Nm", "static_Nm", "stribeck_rad_s")}
    (tmp_path / "friction.json").write_text(json.dumps(numbers))
    table = '[compensation.friction]\nfile = "friction.json"\ntension_per_rad_N = 190.0\n'
    text = RIG_FILE.read_text() + f"\n{table}"
    (tmp_path / "rig.toml").write_text(text)
    plan = read_config(tmp_path / "rig.toml").compensations()
    assert plan.friction.friction.static_Nm == 0.09


def test_gravity_needs_the_cables_length():
    reel = {"drum_radius_m": 0.025, "torque_constant_Nm_A": 0.5, "encoder_counts_per_turn": 8192}
    with pytest.raises(InvalidInput, match=r"needs reel\.cable_length_m"):
        config(compensation={"gravity": ALL["gravity"]}, reel=reel)


def test_compensation_compiles_alone_without_warnings(tmp_path):
    rig = rig_file()
    (tmp_path / "estune_pidf.c").write_text(rig.plan().controller)
    (tmp_path / "estune_compensation.c").write_text(rig.plan().compensation_source)
    (tmp_path / "main.c").write_text(
        '#include <stdio.h>\n#include "estune_pidf.c"\n#include "estune_compensation.c"\n'
        "int main(void) { static estune_compensation c; estune_pidf p; double a;\n"
        "  estune_pidf_init(&p); estune_pidf_at_rest(&p, 15.0, 15.0);\n"
        '  while (scanf("%lf", &a) == 1) {\n'
        "    static int k; estune_compensation_sample(&c, ++k / 632.0, 15.0, a,\n"
        "                               estune_pidf_setpoint(&p), 0.3 * a);\n"
        "    a = estune_pidf_step_beside(&p, estune_compensation_forward(&c), c.limit, 15.0,\n"
        "                                15.0 - estune_compensation_off(&c), 0);\n"
        "    double counts = estune_current_counts(a / ESTUNE_NEWTONS_PER_AMPERE);\n"
        '    printf("%.17g %.17g\\n", a, counts); }\n'
        "  return 0; }\n"
    )
    command = [*c_compiler.compiler(), "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    program = str(tmp_path / "main")
    subprocess.run([*command, "-o", program, str(tmp_path / "main.c"), "-lm"], check=True)
    _, _, angles = drum(200)
    text = "\n".join(map(repr, angles.tolist()))
    done = subprocess.run(program, input=text, capture_output=True, text=True, check=True)
    printed = np.array([line.split() for line in done.stdout.splitlines()], float)
    plan, plain = rig.plan(), PlainCompensation(rig.plan().compensation)
    controller = PlainController()
    controller.use(plan.live)
    controller.rest(15.0, 15.0)
    for k, angle in enumerate(angles.tolist(), start=1):
        known = KnownMotion(controller.filtered_setpoint_N, 0.3 * angle)
        terms = plain.sample(k / 632.0, 15.0, angle, known)
        controller.beside(terms.feed_forward_N, terms.limit_N)
        effort = controller.step(15.0, 15.0 - terms.off_gauge_N)
        counts = plan.current.counts(effort / plan.newtons_per_ampere)
        assert printed[k - 1] == pytest.approx((effort, counts), rel=1e-9, abs=1e-9)
