"""The machines that effects are hidden in, and whether the workflow finds what is hidden."""

import ast
import json
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from experiments import hidden_machines
from experiments.hidden_machines import machine as machines
from experiments.hidden_machines.bases import REEL, UNLOADED
from experiments.hidden_machines.machine import DriveSignals, NoCompiler, Run
from experiments.hidden_scores import measurement
from plants.diagnosis.data.measured_record import CHANNELS
from plants.diagnosis.data.records import read_measurements

ROOT = Path(__file__).parents[1]
RATE = 632.0
MASS, STIFFNESS, RADIUS = 3.2, 7700.0, 0.025
PLAIN = {
    "mass": MASS,
    "stiffness": STIFFNESS,
    "radius": RADIUS,
    "gauge_rate": 1800.0,
    "gauge_damping": 0.5,
    "encoder_step": 1e-9,
    "lag": 6e-5,
}


@pytest.fixture(autouse=True)
def _compiler():
    try:
        machines.library()
    except NoCompiler as error:
        pytest.skip(str(error))


def respond(setpoint, rest_N=0.0, **settings) -> Run:
    nothing = np.zeros(len(setpoint))
    drive = DriveSignals(np.asarray(setpoint, float), nothing, nothing)
    return machines.run(PLAIN | settings, drive, RATE, rest_N=rest_N)


def test_undamped_machine_swings_with_the_period_of_mass_and_spring():
    setpoint = np.r_[np.full(100, 15.0), np.full(6000, 18.0)]
    x = respond(setpoint, rest_N=15.0).angle[200:]
    t, w = np.arange(x.size) / RATE, np.sqrt(STIFFNESS / MASS)

    def left_over(w):
        waves = np.column_stack([np.cos(w * t), np.sin(w * t), np.ones(t.size)])
        return np.std(x - waves @ np.linalg.lstsq(waves, x, rcond=None)[0])

    assert left_over(w) < 1e-3 * np.std(x)
    assert left_over(w * 1.001) > 10.0 * left_over(w)


def test_dead_time_of_a_sample_shifts_the_record_by_a_sample():
    setpoint = np.r_[np.full(100, 15.0), np.full(500, 18.0)]
    soon, late = (respond(setpoint, 15.0, drag=30.0, delay=n / RATE) for n in (1, 4))
    assert late.tension[103:] == pytest.approx(soon.tension[100:-3], abs=1e-9)


def settled(force, **settings) -> Run:
    """The machine held at each of some forces for two seconds; the last sample of each."""
    setpoint = np.repeat(np.asarray(force, float), 1264)
    run = respond(setpoint, force[0], drag=80.0, **settings)
    return Run(*(column[1263::1264] for column in run[:5]), run.warmth)


def test_cable_at_rest_stretches_by_tension_over_stiffness():
    at = settled([10.0, 20.0, 30.0])
    assert at.tension == pytest.approx([10.0, 20.0, 30.0], abs=1e-3)
    assert np.diff(at.angle) * RADIUS == pytest.approx(10.0 / STIFFNESS, rel=1e-4)


def test_stiffening_cable_follows_its_power_law():
    at = settled([5.0, 15.0, 35.0], stiffening=0.2, stiffening_at=4e-3, stiffening_power=2.0)
    # T = k e + (0.2 k/e0^2) e^3
    stretch = [
        np.roots([0.2 * STIFFNESS / 16e-6, 0.0, STIFFNESS, -T])[-1].real for T in (5.0, 15.0, 35.0)
    ]
    assert np.diff(at.angle) * RADIUS == pytest.approx(np.diff(stretch), rel=1e-4)


def test_sagging_cable_takes_up_the_length_of_its_parabola():
    q, T = 5e-3, np.array([3.0, 6.0, 12.0])
    length = T / STIFFNESS - q / T**2
    at = settled(list(T), sag=q)
    assert np.diff(at.angle) * RADIUS == pytest.approx(np.diff(length), rel=1e-4)


def test_swinging_cable_settles_at_the_sag_of_the_parabola():
    mu, L, T = 0.08, 0.8, np.array([8.0, 16.0, 32.0])
    at = settled(list(T), string_mass=mu, string_length=L, string_damping=0.3)
    # The sine of the string's first mode: 0.986 of the parabola's length.
    given = 4.0 * (mu * 9.81) ** 2 * L**3 / (np.pi**4 * T**2)
    assert np.diff(at.angle) * RADIUS == pytest.approx(np.diff(T / STIFFNESS - given), rel=1e-3)


def test_creeping_cable_stretches_more_in_the_end_than_at_once():
    at = settled([10.0, 20.0], slow1=0.2, slow1_s=0.05, slow2=0.1, slow2_s=0.1)
    assert np.diff(at.angle) * RADIUS == pytest.approx(10.0 / STIFFNESS, rel=1e-3)


DRAG, VISCOUS_N = 100.0, 100.0 * 12.0 / STIFFNESS
UP, DOWN = slice(int(632 * 4.0), int(632 * 4.8)), slice(int(632 * 6.0), int(632 * 6.8))


def triangle(**settings) -> tuple[np.ndarray, Run]:
    setpoint = 20.0 + 12.0 * np.interp(
        np.arange(8 * 632) / 632.0, [0, 1, 3, 5, 7, 8], [0, 1, -1, 1, -1, 0]
    )
    return setpoint, respond(setpoint, 20.0, drag=DRAG, **settings)


def loop_height(setpoint, run: Run) -> float:
    """How much more force the tension takes on the way up than on the way down."""
    # What is held for a sample, the current loop and the gauge are late.
    late_s = 0.5 / RATE + PLAIN["lag"] + 2.0 * PLAIN["gauge_damping"] / PLAIN["gauge_rate"]
    behind = setpoint - run.tension - late_s * np.gradient(setpoint) * RATE
    return float(np.mean(behind[UP]) - np.mean(behind[DOWN]))


def test_dry_friction_makes_a_force_loop_of_twice_its_size():
    setpoint, run = triangle(dry=1.5, bristle=5e-6)
    assert loop_height(setpoint, run) == pytest.approx(2.0 * (1.5 + VISCOUS_N), rel=1e-3)


def test_dry_friction_holds_the_drum_up_to_its_size():
    setpoint = np.linspace(1.3, 1.7, 6000)
    run = respond(setpoint, unloaded=1.0, dry=1.5, bristle=5e-6)
    gone = np.abs(run.angle * RADIUS) > 50e-6
    assert setpoint[np.argmax(gone)] == pytest.approx(1.5, abs=0.02)


def test_slip_elements_hold_up_to_their_sum():
    setpoint, run = triangle(slip_force=2.0, slip_length=1e-4)
    assert loop_height(setpoint, run) == pytest.approx(2.0 * (2.0 + VISCOUS_N), rel=1e-3)


def test_bristles_hold_up_to_their_strength():
    setpoint, run = triangle(bend_force=2.0, bend_length=1e-4, bend_power=1.3)
    assert loop_height(setpoint, run) == pytest.approx(2.0 * (2.0 + VISCOUS_N), rel=1e-2)


def test_electronics_delay_the_tension_by_their_dead_time():
    setpoint = 15.0 + np.arange(700.0) / RATE
    early, late = (respond(setpoint, 15.0, drag=80.0, chain=n) for n in (0.0, 3e-3))
    assert early.tension[-1] - late.tension[-1] == pytest.approx(3e-3, abs=1e-5)


def test_tensions_at_the_eyelet_have_the_ratio_of_the_capstan():
    _, run = triangle(hold=0.93, inner=0.3)
    ratio = run.outside / run.tension
    assert ratio[UP] == pytest.approx(0.93, abs=1e-3)
    assert ratio[DOWN] == pytest.approx(1.0 / 0.93, abs=1e-3)


def test_limited_drive_gives_no_more_than_the_limit():
    at = settled([10.0, 30.0], limit=22.0, limit_power=40.0)
    assert at.tension == pytest.approx([10.0, 22.0], abs=0.05)


def test_slew_limit_is_the_slope_of_a_large_step():
    setpoint = np.r_[np.full(50, 10.0), np.full(50, 30.0)]
    force = respond(setpoint, 10.0, drag=30.0, slew=400.0, slew_soft=3e-4).force
    middle = (force > 14.0) & (force < 26.0)
    assert np.diff(force[middle]) * RATE == pytest.approx(400.0, rel=1e-3)


def test_heat_reduces_the_force_by_its_share():
    at = settled([20.0] * 6, heat=0.1 / 400.0, heat_s=0.5)
    assert at.tension[-1] == pytest.approx(20.0 / 1.1, rel=1e-3)


def test_backlash_lets_the_motor_turn_while_the_drum_stands():
    gear = {
        "far_mass": 1.0,
        "play": 2e-4,
        "play_stiffness": 2e5,
        "play_damping": 100.0,
        "unloaded": 1.0,
        "drag": 600.0,
    }
    swing = 0.3 * np.sin(2.0 * np.pi * 0.25 * np.arange(2528) / RATE)
    held = respond(swing, far_dry=50.0, bristle=5e-6, **gear)
    assert np.ptp(held.angle * RADIUS) == pytest.approx(2e-4, rel=0.05)


def test_halved_substep_changes_tensions_by_less_than_noise(monkeypatch):
    _, whole = triangle(dry=1.0, bristle=8e-6, hold=0.95)
    monkeypatch.setattr(machines, "SUBSTEP_s", machines.SUBSTEP_s / 2.0)
    _, half = triangle(dry=1.0, bristle=8e-6, hold=0.95)
    assert np.std(whole.tension - half.tension) < 2e-4 * np.std(whole.tension)


def test_seed_determines_the_case():
    (first, told), (again, told_again), (other, _) = (hidden_machines.draw(n) for n in (7, 7, 8))
    assert told == told_again
    for one, two in zip(first.records, again.records, strict=True):
        assert one.metadata == two.metadata
        for name, column in one.columns.items():
            np.testing.assert_array_equal(column, two.columns[name])
    assert not np.array_equal(
        first.records[0].columns["current_A"], other.records[0].columns["current_A"]
    )


@cache
def without_any(variant) -> hidden_machines.Case:
    return hidden_machines.draw(3, variant, "none")[0]


@pytest.mark.parametrize("variant", ["plain", "no_encoder", "unloaded", "stage"])
def test_written_records_are_read_back_unchanged(variant, tmp_path):
    case, _ = hidden_machines.draw(2, variant)
    hidden_machines.write(list(case.records), tmp_path)
    reading = read_measurements(tmp_path)
    assert not reading.findings
    for found, record in zip(reading.measurements, case.records, strict=True):
        given = measurement(record)
        assert (found.name, found.loop, found.gains) == (given.name, given.loop, given.gains)
        for channel in CHANNELS:
            np.testing.assert_array_equal(found.channel(channel), given.channel(channel))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["none", *hidden_machines.CATALOGUE, *hidden_machines.OUTSIDE])
def test_hidden_effect_moves_the_machine_and_no_record_has_its_name(name):
    variant = "unloaded" if name == "amplifier_deadband" else "plain"
    case, secret = hidden_machines.draw(3, variant, name)
    seconds = sum(one.columns["time_s"].size for one in case.records) / case.given["sampling_Hz"]
    assert 25.0 < seconds < 32.0
    told = json.dumps([case.given, *(one.metadata for one in case.records)])
    assert not any(
        f'"{slug}"' in told for slug in (*hidden_machines.CATALOGUE, *hidden_machines.OUTSIDE)
    )
    assert secret.names == (() if name == "none" else (name,))
    if name == "none":
        return
    bare = without_any(variant)
    if secret.names[0] in ("backlash", "cable_slack", "cable_weight", "drum_eccentricity"):
        return  # on a bench of their own
    change = max(
        np.std(one.columns[channel] - two.columns[channel])
        for one, two in zip(case.records, bare.records, strict=True)
        for channel in ("angle_rad",) + (("tension_N",) if "tension_N" in one.columns else ())
    )
    assert change > 1e-3


def test_hidden_machines_share_no_code_with_the_models():
    files = list((ROOT / "experiments" / "hidden_machines").glob("*.py"))
    assert files
    for file in files:
        for name in imported(file):
            own = name.startswith("experiments.hidden_machines")
            assert own or name.split(".")[0] in {*sys.stdlib_module_names, "numpy"}, (file, name)
    script = (
        "import sys, experiments.hidden_machines\n"
        "print([m for m in sys.modules if m.split('.')[0] in ('estune', 'plants', 'casadi')])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def imported(file: Path):
    """The modules a file imports, by their absolute names."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, file
            yield node.module or ""


def test_given_numbers_exclude_hidden_calibrations():
    for base in (REEL, UNLOADED):
        assert not {"gain", "push_N", "zero_N"} & set(base.given())
