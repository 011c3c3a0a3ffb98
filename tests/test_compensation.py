"""Compensations of the hardware loop: in Python, as C, in the rig's file, and in records."""

import json
import math
import subprocess
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estune.errors import InvalidInput
from estune.hardware.compensation.runtime import CompiledCompensation, PlainCompensation
from estune.hardware.config import read_config
from estune.hardware.controller import PlainController
from estune.reel.gravity import gravity_force_by_position_N
from estune.reel.velocity import motion
from estune.run.results.export import write_record
from estune.support import c_compiler
from estune.trial import TrialRecord, TrialRequest
from estune.trial.loop_records import loop_signals
from estune.trial.profiles import StepProfile
from plants.diagnosis.data.records import read_measurements
from plants.emulator import RIG_FILE
from plants.emulator.virtual_loop import virtual_rig
from tests.support_hardware import config

FRICTION = {"coulomb_Nm": 0.06, "static_Nm": 0.09, "stribeck_rad_s": 0.5}
ALL = {
    "friction": FRICTION,
    "inertia": {"inertia_kgm2": 0.002},
    "gravity": {"weight_N_m": 0.5, "rise_m": 0.4, "length_min_m": 0.5, "length_max_m": 1.4},
}
COUNT = 2.0 * math.pi / 8192


def rig_file(**compensation):
    return config(compensation=compensation or ALL)


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
        ),
        min_size=5,
        max_size=60,
    )
)
def test_compiled_compensation_equals_the_plain_one(steps):
    plan, source = both()
    plain, compiled = PlainCompensation(plan), CompiledCompensation(source)
    time = 100.0
    for interval, tension, counts in steps:
        time = time + interval if math.isfinite(interval) else time
        at = time if math.isfinite(interval) else math.nan
        one = plain.sample(at, tension, counts * COUNT)
        two = compiled.sample(at, tension, counts * COUNT)
        np.testing.assert_allclose(two, one, rtol=1e-12, atol=1e-12)
        assert abs(one.feed_forward_N) <= plan.feed_forward_max_N * (1.0 + 1e-12)


def test_terms_are_those_of_the_equations():
    plan, source = both()
    times, tensions, angles = drum(300)
    compensation = CompiledCompensation(source)
    terms = np.array(
        [compensation.sample(*row) for row in zip(times, tensions, angles, strict=True)]
    )
    moved = motion(plan.windows, times, angles)
    radius = 0.025
    np.testing.assert_allclose(terms[:, 0], moved.velocity_rad_s, rtol=1e-12)
    np.testing.assert_allclose(
        terms[:, 1],
        gravity_force_by_position_N(0.5, 0.8 - radius * angles, rise_m=0.4, tension_1_N=tensions),
        rtol=1e-12,
    )
    np.testing.assert_allclose(terms[:, 2], plan.feed_forward.friction_Nm(moved) / radius)
    np.testing.assert_allclose(
        terms[:, 3], plan.feed_forward.inertia_Nm(moved) / radius, atol=1e-12
    )
    assert np.abs(terms).max(axis=0).min() > 0.1


def rig_with(compensation=None, **settings):
    """A rig in virtual time whose emulated drum has dry friction."""
    friction = {"name": "coulomb_friction", "torque_Nm": FRICTION["coulomb_Nm"]}
    settings = {"effects": [friction], "electronics": {"watchdog_s": 0.02}, "seed": 1} | settings
    changes = {"driver__settings": settings, "motion__settle_N": 8.0, "motion__take_up_A": 0.5}
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
    assert set(record.optional_columns) == {
        *("drum_velocity_rad_s", "gravity_N", "friction_A", "inertia_A")
    }
    assert all(np.abs(column).max() > 0.0 for column in record.optional_columns.values())
    assert np.abs(record.friction_A + record.inertia_A).max() <= 0.2 * 6.0 + 1e-9
    np.testing.assert_allclose(
        record.controller_A, record.current_A - record.friction_A - record.inertia_A
    )
    assert loop_signals(record, description.step, description).record is not None
    hidden = replace(record, friction_A=None, inertia_A=None)
    assert "effort" in loop_signals(hidden, description.step, description).reason


def test_exported_record_with_compensations_is_read_back_without_remarks(tmp_path):
    with rig_with(GENTLE) as rig:
        record = trial(rig)
    exported = write_record(record, tmp_path)
    assert "gravity_N" in exported.read_text().partition("\n")[0]
    read = read_measurements(tmp_path)
    assert not read.findings
    assert np.array_equal(read.measurements[0].tension_N, record.tension_N)


def test_friction_feed_forward_reduces_the_error_at_a_moving_far_end():
    far_end = {"amplitude_m": 0.01, "frequency_Hz": 1.0}
    held = StepProfile(15.0, 1.0, 2.99, 3.0)
    errors = []
    for compensation in (None, {"friction": FRICTION | {"static_Nm": 0.06}}):
        with rig_with(compensation, far_end=far_end) as rig:
            record = trial(rig, held)
        errors.append(np.std((record.tension_N - record.setpoint_N)[316:-10]))
    assert errors[1] < 0.7 * errors[0]


def test_open_loop_is_not_compensated():
    with rig_with(GENTLE) as rig:
        record = trial(rig, StepProfile(15.0, 5.0, 0.2, 0.5, loop="open"))
    assert not record.friction_A.any()
    np.testing.assert_allclose(record.current_A * 20.0, record.setpoint_N)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"friction": {"coulomb_Nm": 0.02}}, "give either file, or coulomb_Nm"),
        ({"friction": FRICTION | {"static_Nm": 0.01}}, "the static one not below"),
        ({"friction": FRICTION | {"static_Nm": 9.0}}, "check the unit of static_Nm"),
        ({"friction": FRICTION | {"coulomb_Nm": math.nan}}, "coulomb_Nm"),
        ({"friction": {"file": "missing.json"}}, "missing.json"),
        ({"gravity": ALL["gravity"] | {"length_min_m": 0.9}}, "is outside compensation.gravity"),
        ({"gravity": ALL["gravity"] | {"rise_m": 0.6}}, "the cable would not reach"),
        ({"gravity": ALL["gravity"] | {"weight_N_m": 50.0}}, "check the unit of weight_N_m"),
        ({"velocity": {"weak": 3.0}, "friction": FRICTION}, "thresholds weak"),
        ({"share_max": 0.3}, "switches nothing on"),
    ],
)
def test_wrong_compensation_is_refused_when_the_file_is_read(changes, words):
    with pytest.raises(InvalidInput, match=words):
        rig_file(**changes)


def test_friction_is_read_from_a_file_beside_the_rigs_file(tmp_path):
    (tmp_path / "friction.json").write_text(json.dumps(FRICTION))
    text = RIG_FILE.read_text() + '\n[compensation.friction]\nfile = "friction.json"\n'
    (tmp_path / "rig.toml").write_text(text)
    plan = read_config(tmp_path / "rig.toml").compensations()
    assert plan.feed_forward.friction.static_Nm == 0.09


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
        "    static int k; estune_compensation_sample(&c, ++k / 632.0, 15.0, a);\n"
        "    a = estune_pidf_step_beside(&p, c.friction + c.inertia, 15.0, 15.0 - c.gravity, 0);\n"
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
        terms = plain.sample(k / 632.0, 15.0, angle)
        controller.feed_forward(terms.feed_forward_N)
        effort = controller.step(15.0, 15.0 - terms.gravity_N)
        counts = plan.current.counts(effort / plan.newtons_per_ampere)
        assert printed[k - 1] == pytest.approx((effort, counts), rel=1e-9, abs=1e-9)
