"""A gain schedule: its values, its exports to C and python-control, and its use on a reel."""

import json
import math
import subprocess
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import plants
from estune.core import pidf
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.schedule import FORMS, GainCurve, GainSchedule
from estune.errors import InvalidInput
from estune.hardware import HardwareRig, controller_source
from estune.hardware.controller import CompiledController, PlainController
from estune.hardware.driver import Reading
from estune.hardware.live_gains import LengthSource, LiveGains
from estune.hardware.schedule_file import read_schedule, schedule_header
from estune.hardware.shared_memory import MotionPhase
from estune.support import c_compiler
from estune.trial import Outcome, TrialRequest
from estune.trial.profiles import StepProfile
from tests.support_hardware import VirtualLoop, config, quick

SETTINGS = ControllerSettings(632.0, 0.002, -120.0, 120.0)
SCHEDULE = GainSchedule(
    P=GainCurve("linear", 1.0, slope=0.2),
    I=GainCurve("linear", 48.0, slope=-14.0, per_newton=0.05),
    D=GainCurve("inverse", 0.012, slope=0.002),
    setpoint_filter_s=GainCurve("log", 0.0022, slope=0.0007),
    length_m=(0.5, 1.4),
    tension_N=(5.0, 30.0),
)

length = st.floats(0.5, 1.4)
tension = st.floats(5.0, 30.0)
magnitude = st.floats(1e-3, 1e3)
some_gains = st.builds(Gains, magnitude, magnitude, magnitude, magnitude)
signal = st.floats(-200.0, 200.0)


# --- the value -------------------------------------------------------------------------------


@given(length, tension)
def test_gains_follow_their_curves(L, T):
    gains = SCHEDULE.gains(L, T)
    assert pytest.approx(1.0 + 0.2 * L) == gains.P
    assert pytest.approx(48.0 - 14.0 * L + 0.05 * T) == gains.I
    assert pytest.approx(0.012 + 0.002 / L) == gains.D
    assert gains.setpoint_filter_s == pytest.approx(0.0022 + 0.0007 * math.log(L))


def test_gains_outside_the_range_equal_those_of_the_nearest_end():
    assert SCHEDULE.gains(9.0, 99.0) == SCHEDULE.gains(1.4, 30.0)
    assert SCHEDULE.gains(0.1, 0.0) == SCHEDULE.gains(0.5, 5.0)
    assert SCHEDULE.gains(math.nan, 15.0) == SCHEDULE.gains(0.5, 15.0)


@given(st.sampled_from(FORMS[1:]), st.floats(-100.0, 100.0), st.floats(-1.0, 1.0))
def test_schedule_with_invalid_gains_anywhere_is_refused(form, slope, per_newton):
    def create():
        return replace(SCHEDULE, I=GainCurve(form, 20.0, slope, per_newton))

    corners = [
        GainCurve(form, 20.0, slope, per_newton).at(L, T) for L in (0.5, 1.4) for T in (5.0, 30.0)
    ]
    if min(corners) >= 0.0:
        within = create()
        assert all(within.gains(L, 17.0).I >= 0.0 for L in np.linspace(0.5, 1.4, 7))
    else:
        with pytest.raises(InvalidInput, match=r"cannot be used at .* m and .* N: gain I is"):
            create()


def test_schedule_survives_json_exactly(tmp_path):
    path = tmp_path / "schedule.json"
    path.write_text(json.dumps(SCHEDULE.as_dict()))
    assert read_schedule(path) == SCHEDULE
    law = {"sentence": "", "schedule": SCHEDULE.as_dict()}
    path.write_text(json.dumps({"laws": {"reel, newton": law}}))  # as a sweep writes it
    assert read_schedule(path) == SCHEDULE
    path.write_text(json.dumps({"laws": {"reel, newton": law, "reel, otis": law}}))
    with pytest.raises(InvalidInput, match=r"2 laws \(reel, newton; reel, otis\)"):
        read_schedule(path)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"gains": {}}', '{"laws": {"a": {"error": ""}}}']
)
def test_damaged_schedule_file_is_refused(tmp_path, text):
    (tmp_path / "s.json").write_text(text)
    with pytest.raises(InvalidInput, match=r"gain schedule .*s\.json: "):
        read_schedule(tmp_path / "s.json")


# --- without a jump --------------------------------------------------------------------------


@cache
def compiled() -> CompiledController:
    return CompiledController(controller_source(SETTINGS, SCHEDULE.gains(0.8, 15.0)))


@given(some_gains, some_gains, st.lists(st.tuples(signal, signal), min_size=2, max_size=20))
def test_bumpless_exchange_keeps_the_effort(one, other, signals):
    for controller in (
        PlainController(),
        compiled(),
    ):
        stays = PlainController()
        for each in (controller, stays):
            each.use(pidf.coefficients(SETTINGS, one))
            each.rest(signals[0][1], 3.0)
        for r, y in signals[:-1]:
            stays.step(r, y)
            controller.step(r, y)
        r, y = signals[-1]
        controller.exchange(pidf.coefficients(SETTINGS, other), r, y)
        scale = sum(g.P * 400.0 + g.D * 400.0 * 632.0 for g in (one, other)) + abs(
            stays._state.integral
        )
        expected = stays.step(r, y)
        assert controller.step(r, y) == pytest.approx(expected, rel=0.0, abs=1e-14 * scale)


_PROGRAM = r"""
#include <stdio.h>
#include "controller.c"
#include "estune_schedule.h"
int main(void) {
  estune_pidf reel;
  double L, T, r, y;
  casadi_real gains[4], would;
  estune_pidf_init(&reel);
  estune_pidf_at_rest(&reel, 15.0, 14.0);
  while (scanf("%lf %lf %lf %lf", &L, &T, &r, &y) == 4) {
    estune_pidf ahead = reel;
    would = estune_pidf_step(&ahead, r, y, 0);
    estune_schedule(L, T, gains);
    estune_pidf_exchange(&reel, gains[0], gains[1], gains[2], gains[3], r, y);
    printf("%.17g %.17g %.17g %.17g ", gains[0], gains[1], gains[2], gains[3]);
    printf("%.17g %.17g\n", would, estune_pidf_step(&reel, r, y, 0));
  }
  return 0;
}
"""


@pytest.mark.parametrize(
    ("flags", "tolerance"),
    [(["-std=c90"], 1e-12), (["-Dcasadi_real=float"], 2e-4)],
    ids=["C90", "single precision"],
)
def test_firmware_header_gives_equal_and_continuous_gains(tmp_path, flags, tolerance):
    (tmp_path / "controller.c").write_text(controller_source(SETTINGS, SCHEDULE.gains(0.8, 15.0)))
    (tmp_path / "estune_schedule.h").write_text(schedule_header(SCHEDULE))
    (tmp_path / "main.c").write_text(_PROGRAM)
    outputs = [str(tmp_path / "main"), str(tmp_path / "main.c"), "-lm"]
    strict = ["-Wall", "-Wextra", "-Werror", "-pedantic"]
    subprocess.run([*c_compiler.compiler(), *flags, *strict, "-o", *outputs], check=True)
    rng = np.random.default_rng(0)
    queries = np.column_stack(
        [rng.uniform(0.3, 1.7, 200), rng.uniform(0.0, 40.0, 200), np.full(200, 20.0)]
    )
    queries = np.column_stack([queries, 20.0 + rng.normal(0.0, 0.5, 200)])
    queries[7, 0] = math.nan
    text = "\n".join(" ".join(map(repr, row)) for row in queries.tolist())
    done = subprocess.run(outputs[0], input=text, capture_output=True, text=True, check=True)
    computed = np.array([line.split() for line in done.stdout.splitlines()], dtype=float)
    expected = [SCHEDULE.gains(*row[:2]).as_tuple() for row in queries.tolist()]
    np.testing.assert_allclose(computed[:, :4], expected, rtol=max(tolerance, 1e-14) / 10.0)
    np.testing.assert_allclose(computed[:, 5], computed[:, 4], rtol=0.0, atol=100.0 * tolerance)


# --- on a rig --------------------------------------------------------------------------------


def scheduled_rig(tmp_path, make, schedule=SCHEDULE, **changes):
    """Emulated rig whose live gains follow a schedule."""
    path = tmp_path / "schedule.json"
    path.write_text(json.dumps(schedule.as_dict()))
    return make(schedule={"file": str(path), "length": "angle"}, gains=None, **changes)


def test_live_gains_follow_the_drum_without_a_jump(tmp_path):
    rig = scheduled_rig(tmp_path, config, guard__travel_max_rad=100.0)
    loop = VirtualLoop(rig, noise_N=0.04)
    own = Gains(1.0, 40.0, 0.015, 0.005)
    step = StepProfile(15.0, 10.0, 0.2, 1.0)
    loop.ask(own, step)
    loop.until(lambda: loop.machine.phase is MotionPhase.TRIAL)
    loop.step()
    reel, control = loop.machine._reel, loop.machine._reel.control
    assert control._controller._coefficients == pidf.coefficients(rig.settings(), own)
    loop.answer()
    for _ in range(300):
        loop.step()
    machine, live_gains = loop.machine, set()
    for k in range(400):  # the drum unwinds 0.3 m over the samples
        gauge, encoder = loop.board.read(loop.time_s)
        paid_out = -round(0.3 / 0.025 * k / 400 * 8192 / (2.0 * math.pi))
        before, state = control._controller._coefficients, control._controller._state
        loop.step(Reading(loop.time_s + 1 / 632, gauge, encoder + paid_out))
        after = control._controller._coefficients
        if after == before:
            continue
        live_gains.add(after)
        _, stayed, _ = pidf.step(before, state, reel.setpoint.tension_N, loop.tension_N[-1])
        assert reel.effort_N == pytest.approx(stayed, rel=0.0, abs=1e-11)
    assert len(live_gains) > 100
    assert machine.phase is MotionPhase.HOLD
    angle = (loop.board.read(loop.time_s)[1] + paid_out) * rig.plan().radians_per_count
    expected = SCHEDULE.gains(0.8 - 0.025 * angle, 15.0)
    now = control._live.coefficients
    assert pytest.approx(expected.P, rel=1e-3) == now.P
    assert pytest.approx(expected.I / 632.0, rel=2e-3) == now.I_per_sample


def test_rig_reports_scheduled_gains_until_others_are_applied(tmp_path):
    schedule = replace(SCHEDULE, I=GainCurve("linear", 48.0, slope=-14.0))  # at any tension
    with HardwareRig(scheduled_rig(tmp_path, quick, schedule)) as rig:
        before = rig.describe()
        assert before.gains == schedule.gains(0.8, 15.0)
        gains = Gains(0.7, 12.0, 0.004, 0.01)
        record = rig.run(TrialRequest("scheduled", 0, gains, before.step))
        assert record.outcome is Outcome.DONE
        after = rig.describe()
        assert after.cable_length_m == pytest.approx(0.8, abs=0.02)
        assert after.cable_length_m == pytest.approx(record.cable_length_m, abs=0.002)
        assert after.gains == schedule.gains(after.cable_length_m, 15.0)
        rig.apply(before.gains)
        assert rig.describe().gains == before.gains


def test_rig_file_with_unusable_schedule_is_refused(tmp_path):
    path = tmp_path / "schedule.json"
    path.write_text(json.dumps(replace(SCHEDULE, length_m=(1.0, 1.4)).as_dict()))
    table = {"file": str(path)}
    with pytest.raises(InvalidInput, match=r"cable_length_m 0.8 m is outside .* 1 to 1.4 m"):
        config(schedule=table, gains=None)
    with pytest.raises(InvalidInput, match=r"either \[gains\] or a \[schedule\] of them"):
        config(schedule=table)
    with pytest.raises(InvalidInput, match=r"give live gains as \[gains\], or a \[schedule\]"):
        config(gains=None)
    with pytest.raises(InvalidInput, match=r"none\.json: No such file"):
        config(schedule={"file": str(tmp_path / "none.json")}, gains=None)


# --- on the simulated reel with a lengthening cable ----------------------------------------------


def way(samples: int) -> np.ndarray:
    """Cable length from 0.5 to 1.4 m, changing smoothly within a trial."""
    along = np.clip((np.arange(samples) / samples - 0.2) / 0.6, 0.0, 1.0)
    return 0.5 + 0.9 * (along - np.sin(2.0 * np.pi * along) / (2.0 * np.pi))


LONG = StepProfile(15.0, 10.0, 0.2, 3.0)


def test_constant_length_simulation_equals_the_fixed_reel():
    reel, gains = plants.reference_reel(0.8), SCHEDULE.gains(0.8, 15.0)
    expected = plants.simulate(reel, gains)
    moving = plants.simulate_moving(reel, gains, np.full(632, 0.8))
    for name in ("tension_N", "effort_N", "angle_rad"):
        assert np.array_equal(getattr(moving, name), getattr(expected, name))


def test_moving_cable_end_obeys_the_equations_of_the_drum():
    """The reference integrates the equations of the drum's angle by the Runge-Kutta method.

    J phi'' + b phi' + R T = Kt i,  T' = k (R phi' + s'),  g'' + 2 zeta w g' + w^2 g = w^2 T.
    """
    reel, rate = plants.reference_reel(encoder_counts=1e9), 632.0
    L = way(LONG.samples(rate))
    simulated = plants.simulate_moving(reel, SCHEDULE, L, LONG)
    w, sag = 2.0 * math.pi * 290.0, (9.80665 * 0.007) ** 2 / (12.0 * 15.0**3)
    speed = (np.diff(L, append=L[-1]) * rate).tolist()
    lengths, efforts = L.tolist(), [15.0, *simulated.effort_N.tolist()]  # one sample of dead time
    x = np.array([simulated.angle_rad[0], 0.0, 15.0, 15.0, 0.0])
    h, states = 1.0 / (10.0 * rate), []
    for k, (length, effort) in enumerate(zip(lengths, efforts, strict=False)):
        states.append(x)
        stiffness = 1.0 / (1.0 / 20e3 + length / 10e3 + sag * length**3)
        friction = 0.010 + 0.015 * length
        A = np.zeros((5, 5))
        A[0, 1] = A[3, 4] = 1.0
        A[1, 1], A[1, 2] = -friction / 2e-3, -0.025 / 2e-3
        A[2, 1] = stiffness * 0.025
        A[4, 2], A[4, 3], A[4, 4] = w**2, -(w**2), -2.0 * 0.03 * w
        b = np.array([0.0, 0.025 * effort / 2e-3, stiffness * speed[k], 0.0, 0.0])
        for _ in range(10):
            k1 = A @ x + b
            k2 = A @ (x + 0.5 * h * k1) + b
            k3 = A @ (x + 0.5 * h * k2) + b
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + A @ (x + h * k3) + b)
    solved = np.array(states)
    assert np.abs(solved[:, 3] - simulated.tension_N).max() < 0.02
    assert np.abs(solved[:, 0] - simulated.angle_rad).max() < 0.01
    assert np.ptp(simulated.angle_rad) > 35.0  # the drum has unwound 0.9 m


def test_scheduled_gains_follow_the_moving_cable_without_a_jump():
    """At each sample the effort equals that of the previous sample's gains."""
    reel = plants.reference_reel()
    steep = replace(SCHEDULE, P=GainCurve("linear", 0.2, slope=1.0))
    L = way(LONG.samples(632.0))
    simulated = plants.simulate_moving(reel, steep, L, LONG)
    state, changes = pidf.state_at_rest(15.0, 15.0), 0
    before = pidf.coefficients(reel.controller, steep.gains(0.5, 15.0))
    live = LiveGains(before, LengthSource(steep, reel.controller, 0.5, 0.025))
    for r, y, effort, angle in zip(
        simulated.setpoint_N,
        simulated.tension_N,
        simulated.effort_N,
        simulated.angle_rad,
        strict=True,
    ):
        _, would, _ = pidf.step(before, state, r, y)
        assert effort == pytest.approx(would, rel=0.0, abs=1e-12)
        if live.update(angle, 15.0):
            changes += 1
            state = pidf.bumpless_exchange(before, live.coefficients, state, r, y)
            before = live.coefficients
        state, _, _ = pidf.step(before, state, r, y)
    assert changes > 500
    assert pytest.approx(0.2 + 1.4, rel=0.01) == before.P


def test_unsupported_simulation_of_a_moving_cable_is_refused():
    reel, gains = plants.reference_reel(), SCHEDULE.gains(0.8, 15.0)
    with pytest.raises(InvalidInput, match=r"shape \(5,\) where the trial has 632 samples"):
        plants.simulate_moving(reel, gains, np.full(5, 0.8))
    with pytest.raises(InvalidInput, match="above zero at every sample"):
        plants.simulate_moving(reel, gains, np.full(632, 0.0))
    with pytest.raises(InvalidInput, match="with CoulombFriction cannot be simulated while"):
        plants.simulate_moving(reel + plants.CoulombFriction(), gains, np.full(632, 0.8))
