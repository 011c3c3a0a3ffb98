"""A rig's file: its mistakes are reported at once; its values reach the loop."""

import json
import math
import tomllib

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from estune.errors import InvalidInput
from estune.hardware import read_config
from estune.hardware.config import config_from
from estune.hardware.scales import CurrentScale, GaugeScale
from estune.hardware.trial_board.export import board_files
from estune.reel.calibration import CurrentCalibration, GaugeCalibration
from plants.emulator import RIG_FILE
from tests.support_hardware import config, tables


def faults(**changes) -> str:
    with pytest.raises(InvalidInput) as refused:
        config(**changes)
    return str(refused.value)


def test_example_rig_file_is_valid():
    rig = read_config(RIG_FILE)
    assert rig == config_from(tomllib.loads(RIG_FILE.read_text()), "")
    description = rig.describe()
    description.limits.check(description.step)
    assert description.newtons_per_ampere == 20.0
    assert description.controller.output_max_N == 120.0


def test_read_config_reports_all_mistakes_with_their_paths():
    table = tables(
        sampling_Hz=-632.0,
        guard__tension_max_kN=0.06,
        limits__tension_min_N=50.0,
        gains__P="high",
        real_time__priority=120,
        guard__slack_s=float("nan"),
    )
    del table["guard"]["travel_max_rad"]
    with pytest.raises(InvalidInput) as refused:
        config_from(table, "my.toml")
    lines = str(refused.value).splitlines()
    for path in (
        *("sampling_Hz", "guard.tension_max_kN", "limits", "gains.P", "real_time.priority"),
        *("guard.slack_s", "guard.travel_max_rad"),
    ):
        assert any(line.startswith(f"my.toml: {path}: ") for line in lines)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"step__preload_N": 2.0}, "step.preload_N 2 N is outside limits.tension_N 5 to 40 N"),
        ({"step__step_N": 30.0}, "step.preload_N + step.step_N 45 N is outside"),
        ({"step__step_N": 0.0}, "step.step_N: must not be zero"),
        ({"motion__hold_N": 41.0}, "motion.hold_N 41 N"),
        ({"guard__tension_max_N": 40.0}, "must be above limits.tension_max_N 40 N"),
        ({"guard__slack_N": 3.0}, "guard.slack_N 3 must be below motion.taut_N 2"),
        ({"motion__take_up_A": 7.0}, "motion.take_up_A 7 A is outside limits.current_A 0 to 6 A"),
        ({"safe__current_A": -1.0}, "safe.current_A -1 A is outside"),
        ({"motion__taut_N": 4.0}, "motion.taut_N 4 N must be below"),
        ({"limits__current_max_A": 1.0}, "holds 20 N, less than limits.tension_max_N 40 N"),
        ({"step__duration_s": 11.0}, "longer than limits.duration_max_s 10 s"),
        ({"settling_time_s": 0.9}, "settling_time_s 0.9 s is longer"),
        ({"guard__gap_s": 0.001}, "shorter than a sampling period"),
        ({"limits__current_min_A": 6.0}, "not in order"),
        ({"guard__angle_min_rad": 1.0, "guard__angle_max_rad": 0.0}, "not in order"),
        ({"reel__encoder_counts_per_turn": 0.0}, "encoder_counts_per_turn is 0"),
        ({"gauge__file": "c2.json"}, "give either file, or counts_of_force, range_N"),
        ({"current__range_counts": None}, "give either file, or amperes_of_command"),
        ({"gauge__counts_of_force": [1.0, 0.0]}, "flat"),
        ({"current__amperes_of_command": [0.0, 1e-4, 1e-8]}, "not significantly monotone"),
    ],
)
def test_inconsistent_values_are_reported(changes, words):
    assert words in faults(**changes)


def another_machine(**more) -> dict:
    """Tables of a heater: what only a reel has is left out."""
    table = tables(measurement="temperature, degC", command="duty, %", **more)
    del table["reel"], table["guard"]["slack_N"]
    del table["motion"]["take_up_A"], table["motion"]["taut_N"], table["guard"]["frozen_s"]
    return table


def test_another_machine_has_names_and_units_of_its_own_and_nothing_to_take_up():
    rig = config_from(another_machine(motion__hold_N=20.0), "heater.toml")
    about, plan = rig.describe(), rig.plan()
    assert (about.measurement, about.command) == ("temperature, degC", "duty, %")
    assert about.newtons_per_ampere == 1.0
    assert plan.motion.taut_N == plan.guard.slack_N == -math.inf
    assert plan.guard.frozen_s == math.inf
    assert plan.guard.words == ("temperature", "degC", "duty", "%")
    with pytest.raises(InvalidInput, match=r"step_N 49 degC is outside limits"):
        config_from(another_machine(motion__hold_N=20.0, step__preload_N=39.0), "h.toml")
    with pytest.raises(InvalidInput, match="a board's program takes a cable up"):
        board_files(rig)


def test_reel_without_its_geometry_is_refused():
    table = another_machine()
    del table["measurement"]
    with pytest.raises(InvalidInput, match=r"give reel\.drum_radius_m, .*motion\.taut_N; or"):
        config_from(table, "reel.toml")


def test_calibrations_are_read_from_files_beside_the_rig_file(tmp_path):
    force = np.linspace(0.0, 90.0, 30)
    noise = np.random.default_rng(0).normal(size=(2, 30))
    gauge = GaugeCalibration.fit(force, 1e6 + 1.5e5 * force + 60.0 * force**2 + noise[0])
    command = np.linspace(-3e4, 3e4, 30)
    current = CurrentCalibration.fit(command, 2e-4 * command + 1e-3 * noise[1])
    text = RIG_FILE.read_text()
    for table, calibration, name in (("gauge", gauge, "c2"), ("current", current, "c1")):
        (tmp_path / f"{name}.json").write_text(json.dumps(calibration.as_dict()))
        start = text.index(f"[{table}]")
        end = text.index("\n\n", start)
        text = f'{text[:start]}[{table}]\nfile = "{name}.json"{text[end:]}'
    (tmp_path / "rig.toml").write_text(text)
    plan = read_config(tmp_path / "rig.toml").plan()
    assert plan.gauge == GaugeScale.of(gauge)
    assert plan.current == CurrentScale.of(current)
    (tmp_path / "c2.json").write_text("{}")
    with pytest.raises(InvalidInput, match="damaged"):
        read_config(tmp_path / "rig.toml")


def test_missing_and_torn_rig_files_are_reported(tmp_path):
    with pytest.raises(InvalidInput, match=r"nowhere.toml: No such file"):
        read_config(tmp_path / "nowhere.toml")
    (tmp_path / "torn.toml").write_text("name = ")
    with pytest.raises(InvalidInput, match=r"torn.toml: no TOML: Invalid value"):
        read_config(tmp_path / "torn.toml")


GAUGES = [
    GaugeCalibration.from_polynomial([1e6, 1.5e5, 60.0], -6.0, 95.0),
    GaugeCalibration.from_polynomial([8e6, -4e4, -20.0], 0.0, 60.0, margin=0.1),
    GaugeCalibration.from_polynomial([0.0, 10.0], 0.0, 100.0),
]
CURRENTS = [
    CurrentCalibration.from_polynomial([0.0, 2e-4], -32768.0, 32767.0),
    CurrentCalibration.from_polynomial([0.02, -3e-3, 0.0, 6e-11], -2000.0, 2000.0, margin=0.1),
]


@given(st.sampled_from(GAUGES), st.floats(0.0, 1.0))
def test_gauge_scale_equals_the_calibration(gauge, place):
    force = gauge.force.low + place * (gauge.force.high - gauge.force.low)
    counts = gauge.reading(force)
    assert GaugeScale.of(gauge).force_N(counts) == pytest.approx(gauge.force_N(counts), abs=1e-9)


@given(st.sampled_from(GAUGES), st.floats(allow_nan=True, allow_infinity=True))
@example(GAUGES[0], 3e302)  # the discriminant overflows
def test_gauge_scale_is_nan_outside_the_calibration(gauge, counts):
    force = GaugeScale.of(gauge).force_N(counts)
    try:
        assert force == pytest.approx(gauge.force_N(counts), abs=1e-6)
    except InvalidInput:
        assert np.isnan(force)


@given(st.sampled_from(CURRENTS), st.floats(0.0, 1.0))
def test_current_scale_gives_the_count_of_the_nearest_current(current, place):
    axis = current.command
    least, most = axis.natural(np.array([-axis.reach, axis.reach]))
    current_A = current.current_A(least + place * (most - least))
    counts = CurrentScale.of(current).counts(current_A)
    near = np.clip([counts, counts - 1, counts + 1], least, most)
    away = np.abs(current.current_A(near) - current_A)
    assert away[0] <= away[1:].min() + 1e-9


@given(st.sampled_from(CURRENTS), st.floats(-1e6, 1e6))
def test_current_scale_ends_at_the_calibrated_range(current, current_A):
    scale = CurrentScale.of(current)
    low, high = sorted(scale._curve(u)[0] for u in (-scale.scaled_max, scale.scaled_max))
    given_A = current.current_A(scale.counts(min(max(current_A, low), high)))
    assert current.current_A(scale.counts(current_A)) == pytest.approx(given_A, abs=1e-9)
