"""Verdicts of `explain` on measured machines; the data are not part of the project."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import plants
from estune.hardware.compensation.tables import AngleMapTable
from experiments import emps, oven, silverbox
from experiments.measured_data import folder

DATA = folder(None)


def measured(name: str) -> Path:
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is absent; name the folder with ESTUNE_DATA")
    return path.parent


@pytest.mark.parametrize(("pieces", "rate_Hz"), [(5, 250), (3, 100)])
def test_friction_of_a_measured_drive_is_named_however_its_record_is_cut(pieces, rate_Hz):
    found = emps.diagnose(measured("emps/DATA_EMPS.mat"), pieces, rate_Hz)
    assert found.is_friction, found.said
    assert found.held_out_N <= emps.HELD_OUT_N


MOTOR = replace(
    plants.servo(2.5e-4, 1e-4, torque_constant_Nm_A=0.0094, encoder_counts=8192.0),
    sampling_Hz=430.0,
)


@pytest.fixture(scope="module")
def winch(tmp_path_factory):
    """The diagnosis of two slow records of a winch motor, a third one held out."""
    data, folder = measured("winch_motor/nocomp_0.csv"), tmp_path_factory.mktemp("winch")
    for n in (0, 1):
        (folder / f"{n}.csv").write_bytes((data / f"nocomp_{n}.csv").read_bytes())
    return plants.explain(MOTOR, folder, hold_out=data / "nocomp_2.csv")


def test_a_map_of_the_diagnosis_removes_the_cogging_of_a_record_it_has_not_seen(winch):
    time_s, current, angle = np.loadtxt(
        DATA / "winch_motor" / "nocomp_2.csv", delimiter=",", skiprows=1, unpack=True
    )
    # The motor swings into its slow motion, by more than a turn in the first 0.3 s.
    current, angle = current[time_s > 0.3], angle[time_s > 0.3]
    reel = plants.reference_reel().scale  # a map in the loop is a reel's
    (remedy, _) = type(winch.effects[0].effect).remedies(winch.effects[0].effect, reel)
    table = AngleMapTable(**remedy.tables["angle_map"] | {"fraction": 1.0, "lead_s": 0.0})
    mapped = table.map(drum_radius_m=1.0)
    fed = np.array([mapped.force_N(one, 0.0, 0.0) for one in angle]) / MOTOR.torque_constant_Nm_A
    # Friction, which is constant in one direction, is no part of the map.
    assert np.std(current) > 0.6
    assert np.std(current - fed) <= 0.16


def test_cogging_of_a_measured_winch_motor_is_named_with_its_orders(winch):
    found = winch
    assert [e.name for e in found.effects] == ["cogging"]
    orders = [found.effects[0].effect.__dict__[f"per_turn_{k}"] for k in (1, 2, 3, 4)]
    assert sorted(orders) == [7.0, 12.0, 14.0, 28.0]
    assert float(re.search(r"held-out records ([\d.]+) A of", found.sentence)[1]) <= 0.16
    assert "one_direction" in [one.kind for one in found.limitations]
    assert not [one for one in found.findings if one.level == "refused"]


def missed(targets):
    return [name for name, one in targets.items() if not one.met]


@pytest.mark.parametrize(("pieces", "rate_Hz"), [(3, 1000), (1, 250), (1, 100)])
def test_numbers_of_a_measured_drive_are_those_of_inverse_dynamics(pieces, rate_Hz):
    data = measured("emps/DATA_EMPS.mat")
    found = emps.diagnose(data, pieces, rate_Hz)
    plain = emps.InverseDynamics.of(emps.record(data / emps.FITTED)).numbers()
    assert found.is_friction, found.said
    assert not missed(emps.targets([found], plain))


@cache
def oscillator():
    measured("silverbox/Silverbox.mat")
    return silverbox.targets(silverbox.figures(DATA))


def test_cubic_spring_of_a_measured_oscillator_is_identified():
    assert oscillator()["silverbox_stiffening_first"].met


@pytest.mark.xfail(strict=True, reason="0.0225 of the standard deviation; 0.022 is asked")
def test_oscillator_with_its_cubic_spring_predicts_other_data():
    assert oscillator()["silverbox_nrmse_after"].met


@cache
def chamber():
    files = sorted(measured("oven/README.md").glob("run*.csv"))
    return {int(file.name[3:5]): oven.read_run(file) for file in files}


@pytest.mark.parametrize("number", range(2, 13))
def test_effort_of_a_measured_chamber_is_replayed_or_the_gains_that_ran_are_found(number):
    run = chamber()[number]
    assert run.replayed <= oven.REPLAYED
    assert sum(part.stretch.samples for part in run.parts) > 600
    stated, ran = run.log.gains.P, run.gains.P
    assert ran == pytest.approx(3.0 if number in {6, 7} else stated, rel=1e-3)
    assert ("not what ran" in run.sentence) == (number in {6, 7})  # their names state a P of 4


@cache
def left_out(number):
    runs = [*chamber().values()]
    return oven.left_out(runs, runs.index(chamber()[number]))


@pytest.mark.parametrize("number", [5, 10, 11, 12])
def test_steps_of_a_measured_chamber_are_predicted_by_its_other_runs(number):
    assert left_out(number)["about_steps_K"] <= oven.ABOUT_STEPS_K


LEFT = pytest.mark.xfail(strict=True, reason="0.84 % of its range; 0.8 % is asked")


@pytest.mark.parametrize("number", [5, 10, pytest.param(4, marks=LEFT)])
def test_a_measured_chamber_is_predicted_from_its_first_seconds(number):
    assert left_out(number)["predicted"] <= oven.PREDICTED


@pytest.mark.slow
@pytest.mark.parametrize("number", [4, 8, 12])
def test_verdict_on_a_measured_chamber_is_the_same_in_hundredths_of_its_unit(number):
    run = chamber()[number]
    (part,), gains = run.log.parts, run.gains
    larger = {name: 100.0 * part[name] for name in ("setpoint", "measurement")}
    smaller = replace(gains, P=gains.P / 100.0, I=gains.I / 100.0, D=gains.D / 100.0)
    logs = [
        run.log._replace(gains=gains),
        run.log._replace(gains=smaller, parts=({**part, **larger},)),
    ]
    said = [oven.suggest(oven.Logs((log,), (), oven.SETTINGS)).verdict for log in logs]
    assert said[0] == said[1] == "change"


@pytest.mark.slow
def test_single_runs_and_all_runs_of_a_measured_chamber_are_told():
    runs = chamber()
    pooled = oven.suggest(oven.Logs(tuple(r.log for r in runs.values()), (), oven.SETTINGS))
    assert pooled.verdict == "change"
    assert not pooled.cause.is_machine
    assert pooled.cause.numbers.get("direction") != "tight"  # Ms 1.3 with the gains in use
    # Run 2 goes 11 K up, and shows that readings of a thermistor are not straight.
    alone = {n: oven.alone(run, pooled.fit.model) for n, run in runs.items() if n != 2}
    apart = {n: one["Ms"] / one["pooled_Ms"] - 1.0 for n, one in alone.items() if one["Ms"]}
    assert apart.keys() == alone.keys()
    assert max(map(abs, apart.values())) <= 0.1
