"""Damaged records: a diagnosis, or a refusal that says what to do."""

import numpy as np
import pytest

import plants
from estune.errors import EstuneError
from experiments.damaged_records.__main__ import VERDICTS, answers, is_helpful
from experiments.damaged_records.damages import DAMAGES
from experiments.damaged_records.machines import joint, process, reel, stage
from plants.diagnosis.data.records import drum_of, read_measurements
from plants.diagnosis.pipeline.check import check
from plants.diagnosis.residual.angle_periods import ResidualOverAngle, per_turn
from plants.diagnosis.residual.residuals import of_usual_rate
from tests.support_measurements import open_loop


@pytest.fixture(scope="module")
def kinds():
    return [reel(), joint(), stage(), process()]


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_records_are_checked_or_refused_with_a_remedy(damage, kinds, tmp_path):
    for seed, machine in enumerate(kinds):
        table = DAMAGES[damage](machine.tables[0], np.random.default_rng(seed))
        rows = np.column_stack(list(table.values()))
        np.savetxt(tmp_path / "r.csv", rows, "%.10g", ",", header=",".join(table), comments="")
        try:
            read = read_measurements(tmp_path, machine.columns, drum_of(machine.model))
            refused = [str(f) for f in check(read, machine.model).findings if f.level == "refused"]
        except EstuneError as error:
            refused = [str(error)]
        assert all(map(is_helpful, refused)), refused


def test_time_in_another_unit_is_refused_of_a_plant_too(kinds, tmp_path):
    machine = kinds[-1]
    table = machine.tables[0] | {"time_s": 1e3 * machine.tables[0]["time_s"]}
    rows = np.column_stack(list(table.values()))
    np.savetxt(tmp_path / "r.csv", rows, "%.10g", ",", header=",".join(table), comments="")
    with pytest.raises(EstuneError, match=r"column time_s.*give the time in s"):
        check(read_measurements(tmp_path, machine.columns, drum_of(machine.model)), machine.model)


def test_angle_that_turns_by_less_than_its_cells_shows_no_period():
    still = ResidualOverAngle(np.full(100, 1e-14) * np.arange(100), np.ones(100))
    assert per_turn([still], 0.1, 2.0) == []


def test_records_whose_rates_differ_a_little_are_of_one_controller():
    rates_Hz = [187.2, 400.0, 184.9, 188.4, 186.0]
    t = np.arange(100)
    records = [open_loop(0, rate, t / rate, angle_rad=t / rate) for rate in rates_Hz]
    assert of_usual_rate(records) == [0, 2, 3, 4]


def test_residual_of_records_whose_rates_differ_a_little_is_localised(kinds):
    machine = kinds[-1]
    one, two = (
        open_loop(n, 10.0 * (1.0 + 0.013 * n), t["current_A"], tension_N=t["tension_N"])
        for n, t in enumerate(machine.tables)
    )
    found = plants.explain(machine.model, [one, two], effects=["dead_time"])
    assert found.where.blocks


@pytest.mark.slow
def test_damaged_records_are_diagnosed_or_refused(kinds):
    for answer in answers(40, 0, kinds):
        assert answer.ending in (*VERDICTS, "refused"), answer
        assert all(map(is_helpful, answer.said)), answer
        assert answer.cpu_s < 30.0, answer
