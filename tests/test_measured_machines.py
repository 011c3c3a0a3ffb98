"""Verdicts of `explain` on measured machines; the data are not part of the project."""

from pathlib import Path

import pytest

from experiments import emps, silverbox
from experiments.measured_data import folder

DATA = folder(None)


def measured(name: str) -> Path:
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is absent; name the folder with ESTUNE_DATA")
    return path.parent


@pytest.mark.parametrize(("pieces", "rate_Hz"), [(1, 250), (5, 250), (1, 100), (3, 100)])
def test_friction_of_a_measured_drive_is_named_however_its_record_is_cut(pieces, rate_Hz):
    found = emps.diagnose(measured("emps/DATA_EMPS.mat"), pieces, rate_Hz)
    assert found.is_friction, found.said
    assert found.held_out_N <= emps.HELD_OUT_N


def test_numbers_of_a_measured_drive_are_those_of_inverse_dynamics():
    data = measured("emps/DATA_EMPS.mat")
    found = emps.diagnose(data, 3, emps.RECORDED_Hz)
    plain = emps.InverseDynamics.of(emps.record(data / emps.FITTED)).numbers()
    assert found.is_friction, found.said
    assert not [name for name, one in emps.targets([found], plain).items() if not one.met]


def test_cubic_spring_of_a_measured_oscillator_is_identified():
    measured("silverbox/Silverbox.mat")
    figures = silverbox.figures(DATA)
    assert figures["silverbox_stiffening_first"] == 1.0
    assert figures["silverbox_nrmse_after"] <= 0.025
