"""Diagnosis of many records: a search on those that differ the most, its outcome on all."""

import math
from dataclasses import replace

import numpy as np
import pytest

import plants
from estune.core.gains import Gains
from experiments.scale.records import trials
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.search import more_records
from plants.diagnosis.search.more_records import differing
from tests.support_hidden import drawn, skip_without_compiler


def records(number):
    time_s = np.arange(1000) / 500.0
    one = MeasuredRecord.of(next(iter(trials(1))))
    columns = {"time_s": time_s, "tension_N": np.sin(time_s), "angle_rad": np.cos(time_s)}
    columns |= dict.fromkeys(("setpoint_N", "current_A"), np.sin(time_s))
    one = replace(one, reference_N=None, flags=None, **columns)
    return tuple(replace(one, name=str(n), gains=Gains(1.0, 1.0, 0.0, 0.0)) for n in range(number))


def test_few_records_are_all_searched():
    few = records(3)
    assert differing(few) == few


def test_records_searched_differ_in_gains_and_profile(monkeypatch):
    fewer = CONSTANTS._replace(searched=3500)
    monkeypatch.setattr(more_records, "CONSTANTS", fewer)
    many = list(records(20))
    many[7] = replace(many[7], gains=Gains(3.0, 1.0, 0.0, 0.0))
    many[13] = replace(many[13], profile="chirp")
    some = differing(many)
    assert len(some) == 3
    assert {"7", "13"} <= {one.name for one in some}
    assert [int(one.name) for one in some] == sorted(int(one.name) for one in some)


@pytest.mark.slow
def test_effect_found_on_some_records_is_fitted_to_all_of_them(monkeypatch):
    skip_without_compiler()
    given, measured = drawn(502, "unloaded", "coulomb_friction")
    whole = plants.explain(given, measured)
    samples = max(m.samples for m in measured)
    fewer = CONSTANTS._replace(searched=3 * samples)
    monkeypatch.setattr(more_records, "CONSTANTS", fewer)
    found = plants.explain(given, measured)
    names = [effect.name for effect in found.effects]
    assert (found.verdict, names) == (whole.verdict, [e.name for e in whole.effects])
    assert {one.name for one in found.traces} == {m.name for m in measured}
    assert math.isclose(found.after.ratio, whole.after.ratio, rel_tol=0.02)
    one, other = (e.effects[0].parameters["torque_Nm"].value for e in (found, whole))
    assert one == pytest.approx(other, rel=1e-3)
