"""Compensations of a simulated trial: those of the hardware loop, and what they take away."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import plants
from estune.core import pidf
from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.hardware.compensation.plan import CompensationTerms, KnownMotion
from estune.hardware.compensation.runtime import PlainCompensation
from estune.hardware.compensation.tables import CompensationTable
from estune.proof.patch import Patch
from estune.proof.trials import prove
from estune.trial import TrialRequest
from estune.trial.profiles import StepProfile, TriangleProfile
from plants.effects import (
    Cogging,
    CurrentSaturation,
    DrumEccentricity,
    EyeletFriction,
    MainsInterference,
    StructuralMode,
    TorqueRipple,
)
from plants.remedies.offers import offers_for
from plants.simulation.compensation import trial_compensation
from plants.simulation.trial_loop import CasadiLoop, loop_functions
from tests.test_compensation import ALL
from tests.test_remedies import GAINS, found

STEP = StepProfile(15.0, 5.0, 0.1, 0.4)
TABLES = {name: table for name, table in ALL.items() if name not in {"gravity", "known_motion"}}
EYELET = {"eyelet": ALL["eyelet"]}
TABLES["inertia"] = {"inertia_kgm2": 2e-4}
TRIANGLE = TriangleProfile(20.0, 15.0, period_s=2.0, start_s=0.2, duration_s=4.2)


def run(reel, tables=None, profile=STEP, gains=GAINS):
    rig = reel.rig(gains=gains)
    text = json.dumps(tables) if tables else ""
    record = rig.run(TrialRequest("s", 0, gains, profile, compensation=text))
    rig.close()
    return record


def test_simulated_trial_has_the_terms_of_the_hardware_loop():
    reel = plants.reference_reel() + TorqueRipple(0.02, 7.0, 0.5)
    record = run(reel, TABLES)
    plan = trial_compensation(CompensationTable(**TABLES), reel.scale, reel.controller, "").plan
    pole = pidf.coefficients(reel.controller, GAINS).setpoint_pole
    filtered = 15.0 + lfilter([0.0, 1.0 - pole], [1.0, -pole], record.setpoint_N - 15.0)
    gauge = record.tension_N + record.notch_N + record.eyelet_N
    plain = PlainCompensation(plan)
    times = np.arange(gauge.size) * plan.period_s  # rounded as the loop does
    rows = zip(times, gauge, record.angle_rad, map(KnownMotion, filtered), strict=True)
    terms = CompensationTerms(*np.array([plain.sample(*row) for row in rows]).T)
    for name, column in terms.columns(1.0 / reel.newtons_per_ampere).items():
        if name != "gravity_N":
            np.testing.assert_allclose(record.optional_columns[name], column, atol=1e-9)
    own = pidf_effort(reel, record)
    np.testing.assert_allclose(record.controller_A * reel.newtons_per_ampere, own, atol=1e-7)
    assert abs(record.current_A[0] - record.current_A[20]) < 0.05  # it begins at rest


def pidf_effort(reel, record):
    """The controller's effort for the tension that is controlled."""
    c = pidf.coefficients(reel.controller, record.gains)
    first = float(record.controller_A[0]) * reel.newtons_per_ampere
    at_rest = pidf.state_at_rest(15.0, 0.0)
    state = pidf.bumpless(c, at_rest, record.setpoint_N[0], record.tension_N[0], first)
    efforts = []
    for setpoint, tension in zip(record.setpoint_N, record.tension_N, strict=True):
        state, effort, _ = pidf.step(c, state, setpoint, tension)
        efforts.append(effort)
    return np.array(efforts)


def test_the_virtual_machine_gives_the_same_trial(monkeypatch):
    reel = plants.reference_reel() + TorqueRipple(0.02, 7.0, 0.5)
    compiled = run(reel, TABLES)
    monkeypatch.setattr(
        "plants.models.plant_model.trial_loop",
        lambda structure: CasadiLoop(loop_functions(structure.equations())),
    )
    plain = run(reel, TABLES)
    for name in ("tension_N", "current_A", *compiled.optional_columns):
        np.testing.assert_allclose(getattr(plain, name), getattr(compiled, name), atol=1e-7)


def test_open_loop_is_not_compensated():
    record = run(plants.reference_reel(), TABLES, replace(STEP, loop="open"))
    assert not any(
        record.optional_columns[name].any()
        for name in set(record.optional_columns) - {"drum_velocity_rad_s"}
    )
    np.testing.assert_allclose(record.current_A * 20.0, record.setpoint_N)


@pytest.mark.parametrize(
    ("effect", "left"),
    [
        (TorqueRipple(0.02, 24.0, 0.5), 0.15),
        pytest.param(
            Cogging(amplitude_1_Nm=0.02, per_turn_1=24.0, amplitude_2_Nm=0.01, per_turn_2=36.0),
            0.15,
            marks=pytest.mark.slow,
        ),
        # The length wound in keeps its wave.
        pytest.param(DrumEccentricity(0.1, 0.4), 0.3, marks=pytest.mark.slow),
    ],
)
def test_a_map_removes_nearly_all_of_a_ripple(effect, left):
    reel = replace(plants.reference_reel(), gauge_noise_N=0.0)
    offer = next(one for one in offers_for(found(effect, 0.0), GAINS) if one.tables)
    tables = {"angle_map": {**offer.tables["angle_map"], "fraction": 1.0}}
    clean, spoilt, mended = (
        run(machine, table, TRIANGLE).tension_N
        for machine, table in ((reel, None), (reel + effect, None), (reel + effect, tables))
    )
    before, after = np.std(spoilt - clean), np.std(mended - clean)
    assert before > 0.03
    assert after <= left * before
    moved = {
        "angle_map": tables["angle_map"] | {"zero_rad": np.pi / tables["angle_map"]["orders"][0]}
    }
    assert np.std(run(reel + effect, moved, TRIANGLE).tension_N - clean) > 1.5 * before


def test_a_notch_keeps_the_hum_out_of_the_current():
    reel = plants.reference_reel() + MainsInterference(0.4, 50.0, 0.3)
    gains = Gains(0.78, 31.0, 0.0206, 0.01)
    calm, notched, off = (
        np.std(run(reel, tables, StepProfile(15.0, 0.0 + 1e-6, 0.1, 2.0), gains).current_A[600:])
        for tables in (None, {"hum": {"frequency_Hz": 50.0}}, {"hum": {"frequency_Hz": 51.0}})
    )
    assert notched < 0.45 * calm
    assert off < 0.7 * calm


def test_what_a_simulated_rig_has_not_is_refused():
    with pytest.raises(InvalidInput, match="leave gravity and known_motion out"):
        run(plants.reference_reel(), {"gravity": ALL["gravity"]})


@pytest.mark.slow
def test_a_notch_is_offered_only_where_it_gains():
    """A notch at a low mode lowers every measure at the same gains, and takes margin."""
    hum = offers_for(found(MainsInterference(0.4, 50.0, 0.3), 0.02), GAINS)
    assert any(offer.tables.get("hum") and offer.worth for offer in hum)
    mode = offers_for(found(StructuralMode(0.3, 20.0), 0.1), GAINS)
    assert not any("mode" in offer.tables and offer.worth for offer in mode)


@pytest.mark.parametrize(
    ("effect", "name", "left"),
    [
        (CurrentSaturation(1.45, 0.1), "current_limit", 0.7),
        (EyeletFriction(0.95, 0.2), "eyelet", 0.5),
    ],
)
def test_a_remedy_is_proven_as_it_was_predicted(effect, name, left):
    """The drive's limit on a triangle beyond it; the eyelet by the gauge outside."""
    offer = next(one for one in offers_for(found(effect, 0.01), GAINS) if name in one.tables)
    assert offer.worth
    patch = Patch(offer.effect, offer.title, offer.harm, offer.tables)
    proof = prove((plants.reference_reel() + effect).rig(gains=GAINS), patch)
    assert proof.proven
    predicted, achieved = offer.ratios["tracking"].value, proof.ratios["tracking"].value
    assert predicted < left
    assert achieved == pytest.approx(predicted, abs=0.05)


@pytest.mark.parametrize("effect", [CurrentSaturation(2.5), EyeletFriction(0.95, 0.05)])
def test_a_limit_never_reached_and_an_eyelet_worn_off_by_noise_are_not_worth_a_remedy(effect):
    assert not any(one.tables and one.worth for one in offers_for(found(effect, 0.01), GAINS))


def test_an_eyelet_is_proven_by_a_gauge_outside_alone():
    with pytest.raises(InvalidInput, match="no gauge outside its eyelet"):
        prove(plants.reference_reel().rig(gains=GAINS), Patch("e", "", "", EYELET))
