"""Predictions of a reel's records: residuals, derivatives, windows."""

from copy import copy
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

import plants
from estune.errors import InvalidInput, PlantError
from estune.trial.profiles import TriangleProfile
from plants.diagnosis.models.calibration import Calibration
from plants.diagnosis.models.diagnosed_model import diagnosed
from plants.diagnosis.prediction.prediction import Predictor
from plants.effects import (
    EFFECTS,
    CoulombFriction,
    DeadTime,
    EyeletFriction,
)
from tests.support_prediction import LINES, PROFILES, REEL, SMALL, floor, measure, sweep, truth
from tests.test_prediction_of_plants import swinging

OF_REELS = [n for n, one in EFFECTS.items() if not one.without_cable and not one.of_process]


@pytest.mark.usefixtures("interpreted")
@pytest.mark.parametrize("name", [None, *OF_REELS])
def test_free_run_with_true_parameters_equals_the_simulation(name):
    effects = [] if name is None else [EFFECTS[name]()]
    records = sweep(REEL + effects[0] if effects else REEL)
    predictor = Predictor(
        diagnosed(REEL, records), [type(e) for e in effects], records, None, SMALL
    )
    for record, predicted in zip(
        records, predictor.predict(truth(predictor, *effects)[None]), strict=True
    ):
        assert predicted.tension_N[0] == pytest.approx(record.tension_N, abs=2e-8)
        assert predicted.angle_rad[0] == pytest.approx(record.angle_rad, abs=1e-9)
        if record.reference_N is not None:
            assert predicted.reference_N[0] == pytest.approx(record.reference_N, abs=2e-8)
        assert predicted.current_A is None  # none was measured


@lru_cache(maxsize=1)
def noisy():
    """Records of a bare reel with a noisy gauge, and their predictor."""
    records = [measure(REEL, LINES, noise_N=0.2, seed=n, name=f"noisy {n}") for n in range(3)]
    noise_floor = floor(tension_N=0.2, angle_rad=1e-5)
    return records, Predictor(diagnosed(REEL, records), [], records, floor=noise_floor)


def test_residual_of_noise_is_white_with_unit_variance():
    _, predictor = noisy()
    index, residuals = predictor.index, predictor.residuals(truth(predictor)[None])[0]
    gauge = index.channel == 0
    allowed = (0.2 / index.sigma[gauge]) ** 2
    assert np.mean(residuals[gauge] ** 2) == pytest.approx(np.mean(allowed), rel=0.05)
    samples = gauge.sum()
    for lag in (1, 2, 5):
        together = np.mean(residuals[gauge][lag:] * residuals[gauge][:-lag])
        assert abs(together) < 4.0 / np.sqrt(samples)
    # Without quantisation, only the error of the initial states remains.
    assert np.mean(residuals[~gauge] ** 2) < 0.01


def test_residual_is_independent_of_initial_states():
    _, predictor = noisy()
    row = truth(predictor)[None]
    before = predictor.residuals(row)
    place = predictor._data.window_place
    moved = copy(predictor)
    moved._runner = copy(predictor._runner)
    shift = np.random.default_rng(1).normal(size=place.shape) * (1e-3, 0.1)
    moved._runner._data = replace(predictor._data, window_place=place + shift)
    change = predictor.predict(row)[0].angle_rad - moved.predict(row)[0].angle_rad
    change = np.abs(change).max() / predictor.index.sigma[predictor.index.channel == 1][0]
    assert change > 10.0
    # The tolerance covers gauge ringing from one window to the next.
    assert np.abs(moved.residuals(row) - before).max() < 1e-3 * change


def test_derivative_equals_the_central_difference():
    records = sweep(REEL + CoulombFriction(0.03))
    predictor = Predictor(diagnosed(REEL, records), [CoulombFriction], records, floor=SMALL)
    values = predictor.row({"coulomb_friction.torque_Nm": 0.03, "torque_gain": 1.02})
    residuals, jacobian = predictor.linearise(values)
    assert residuals == pytest.approx(predictor.residuals(values[None])[0])
    for n, free in enumerate(predictor.free):
        step = 1e-5 * (abs(values[n]) or 1.0)
        rows = np.repeat(values[None], 2, axis=0)
        rows[:, n] += (-step, step)
        behind, ahead = predictor.residuals(rows)
        slope = (ahead - behind) / (2.0 * step)
        off = np.linalg.norm(jacobian[:, n] - slope) / np.linalg.norm(slope)
        assert off < 0.02, free.name
        if free.owner.startswith("record"):
            elsewhere = predictor.index.measurement != int(free.owner.split()[1])
            assert not jacobian[elsewhere, n].any()
    some = np.array([2, 0])
    assert predictor.linearise(values, some)[1] == pytest.approx(jacobian[:, some])


def test_selected_entries_equal_those_of_all():
    records = [*sweep(REEL), *sweep(REEL)]
    predictor = Predictor(diagnosed(REEL, records), [CoulombFriction], records, floor=SMALL)
    values = predictor.row({"coulomb_friction.torque_Nm": 0.03, "torque_gain": 1.02})
    residuals, jacobian = predictor.linearise(values)
    last = np.flatnonzero(predictor.index.measurement == len(records) - 1)
    for some in (last, last[::3]):  # a strided view does not own its data
        assert np.array_equal(predictor.residuals(values[None], some)[0], residuals[some])
        assert predictor.linearise(values, entries=some)[1] == pytest.approx(jacobian[some])


@pytest.mark.parametrize("missing", ["angle_rad", "tension_N"])
def test_prediction_without_a_channel(missing):
    F = CoulombFriction(0.03)
    records = [replace(m, **{missing: None}) for m in sweep(REEL + F)]
    model = diagnosed(REEL, records)
    predictor = Predictor(model, [CoulombFriction], records, floor=SMALL)
    assert set(predictor.index.channel) == ({0} if missing == "angle_rad" else {1})
    assert "structure_stiffness_N_m" not in {free.name for free in predictor.free}
    with_it = predictor.residuals(truth(predictor, F)[None])
    without = predictor.residuals(truth(predictor, CoulombFriction(0.0))[None])
    assert np.mean(with_it**2) < 0.02 * np.mean(without**2)


def test_record_may_begin_in_motion():
    whole = measure(REEL, replace(LINES, start_s=0.0))
    cut = 300
    columns = ("setpoint_N", "tension_N", "current_A", "angle_rad", "flags")
    part = replace(
        whole,
        time_s=whole.time_s[:-cut],
        **{name: getattr(whole, name)[cut:] for name in columns},
    )
    predictor = Predictor(diagnosed(REEL, [part]), [], [part], None, SMALL)
    (predicted,) = predictor.predict(truth(predictor)[None])
    off = predicted.tension_N[0] - part.tension_N
    assert np.sqrt(np.mean(off**2)) < 0.02 * part.tension_N.std()


def test_prediction_is_continuous_in_the_dead_time():
    records = [measure(REEL, LINES)]
    predictor = Predictor(diagnosed(REEL, records), [EFFECTS["dead_time"]], records, None, SMALL)
    late = np.linspace(0.0, 3.0 / 632.0, 61)
    rows = np.array([predictor.row({"dead_time.delay_s": d}) for d in late])
    tension = predictor.predict(rows)[0].tension_N
    steps = np.abs(np.diff(tension, axis=0)).max(axis=1)
    assert steps.max() < 1.2 * np.median(steps)


def test_measured_current_identifies_the_drive():
    limited = EFFECTS["current_saturation"](0.85, bend=1e-3)
    record = measure(REEL + limited, LINES)
    commanded = record.setpoint_N / REEL.newtons_per_ampere
    lag = 3  # of the current's own filter
    flown = np.clip(commanded, -0.85, 0.85)
    record = replace(record, current_A=1.1 * np.append(np.full(lag, flown[0]), flown[:-lag]) + 0.2)
    predictor = Predictor(diagnosed(REEL, [record]), [type(limited)], [record], None, SMALL)
    values = {"current_gain": 1.1, "current_offset_A": 0.2, "encoder_zero_rad[0]": 0.0}
    own = {"current_saturation.limit_A": 0.85, "current_saturation.bend": 0.0}
    row = predictor.row(values | own)
    (predicted,) = predictor.predict(row[None])
    assert predicted.current_A[0] == pytest.approx(1.1 * flown + 0.2)
    residuals = predictor.residuals(row[None])[0]
    current = predictor.index.channel == 3
    assert current.sum() > 0.9 * record.samples
    assert np.abs(residuals[current]).max() < 1e-6


def test_late_or_nan_samples_are_ignored():
    record = measure(REEL, LINES)
    flags, tension = record.flags.copy(), record.tension_N.copy()
    flags[100:110], tension[200:205] = 4, np.nan
    predictor = Predictor(
        *(diagnosed(REEL, [record]), [], [replace(record, flags=flags, tension_N=tension)]),
        floor=SMALL,
    )
    gauge, encoder = (predictor.index.sample[predictor.index.channel == c] for c in (0, 1))
    assert not np.isin(np.r_[100:110, 200:205], gauge).any()
    assert np.isin(np.r_[200:205], encoder).all()
    assert np.isfinite(predictor.residuals(predictor.start[None])).all()


def test_diverging_prediction_has_a_large_finite_residual():
    record = measure(REEL, LINES)
    predictor = Predictor(diagnosed(REEL, [record]), [], [record], None, SMALL)
    bad = predictor.row({"viscous_friction_Nms": -50.0})
    assert np.isfinite(predictor.residuals(bad[None])).all()
    assert np.mean(predictor.residuals(bad[None]) ** 2) > 1e3


@pytest.mark.parametrize("horizon", [None, "model"])
def test_calibrated_reel_reproduces_its_prediction(horizon):
    records = sweep(REEL)
    model = diagnosed(REEL, records)
    values = {
        "drum_inertia_kg_m2": 2.2e-3,
        "torque_gain": 0.93,
        "gauge_offset_N": 0.4,
        "coulomb_friction.torque_Nm": 0.02,
    }
    fitted = model.calibrated(values, [CoulombFriction])
    assert fitted.effects == (CoulombFriction(0.02), Calibration(0.93, 0.0, 0.4))
    again = sweep(fitted)
    predictor = Predictor(diagnosed(REEL, again), [CoulombFriction], again, horizon, SMALL)
    zeros = {f.name: 0.0 for f in predictor.free if f.name.startswith("encoder_zero")}
    residuals = predictor.residuals(predictor.row(values | zeros)[None])
    gauge = predictor.index.channel == 0
    assert np.sqrt(np.mean(residuals[:, gauge] ** 2)) < (1e-3 if horizon is None else 1.0)


def test_fit_starts_from_effects_and_calibration_of_the_model():
    given_model = (
        REEL + CoulombFriction(0.03) + Calibration(1.1, 0.0, 0.5) + EyeletFriction(0.9, 0.1)
    )
    records = sweep(given_model)
    model = diagnosed(given_model, records)
    predictor = Predictor(model, [], records, None, SMALL)
    starts = {f.name: f.start for f in predictor.free}
    assert (starts["torque_gain"], starts["gauge_offset_N"]) == (1.1, 0.5)
    assert starts["coulomb_friction.torque_Nm"] == 0.03
    assert starts["eyelet_friction.attenuation"] == 0.9
    predicted = predictor.predict(truth(predictor, *given_model.effects[::2])[None])
    assert predicted[0].tension_N[0] == pytest.approx(records[0].tension_N, abs=2e-8)
    later = model.calibrated({"torque_gain": 1.2})
    assert later.effects[-1] == Calibration(1.2, 0.0, 0.5)


def test_batch_of_rows_equals_single_rows():
    plant, record = swinging(sampling_Hz=80.0, hardening=0.0, slope=1.0)
    predictor = Predictor(diagnosed(plant, [record]), [DeadTime], [record], floor=SMALL)
    ways = [(0.0, 0.04), (1.0, 0.0), (0.5, 0.3)]
    rows = np.array(
        [predictor.row({"input_slope": s, "dead_time.delay_s": late}) for s, late in ways]
    )
    alone = np.concatenate([predictor.residuals(row[None]) for row in rows])
    assert np.array_equal(predictor.residuals(rows), alone)
    assert np.abs(np.diff(alone, axis=0)).max(axis=1).min() > 1.0
    together = predictor.predict(rows)[0].tension_N
    assert np.array_equal(together[2], predictor.predict(rows[2:])[0].tension_N[0])


@pytest.mark.parametrize(("swing_N", "reported"), [(16.0, True), (4.0, False)])
def test_slack_cable_identifies_the_torque_offset(swing_N, reported):
    record = measure(REEL, TriangleProfile(10.0, swing_N, 0.5, 1.0, start_s=0.1, loop="open"))
    free = Predictor(diagnosed(REEL, [record]), (), [record]).free
    assert ("torque_offset_Nm" in {f.name for f in free}) == reported
    # The search starts at a just taut cable, although slack data do not determine this.
    (zero,) = (f.start for f in free if f.name.startswith("encoder_zero"))
    assert abs(zero) < 0.02 * np.ptp(record.angle_rad)


def test_unsuitable_models_and_records_are_reported():
    record = measure(REEL, LINES)
    with pytest.raises(PlantError, match="diagnosed_by"):
        diagnosed(object(), [record])
    with pytest.raises(InvalidInput, match="no records"):
        diagnosed(REEL, [])
    with pytest.raises(InvalidInput, match="angle_rad"):
        diagnosed(plants.unloaded_reel(), [replace(record, angle_rad=None)])
    drum = diagnosed(plants.unloaded_reel(), [record])
    with pytest.raises(PlantError, match="eyelet_friction is not available"):
        Predictor(drum, [EyeletFriction], [record])


def test_drum_without_encoder_follows_a_sticking_cable():
    friction = EyeletFriction(0.9, 0.3)
    record = replace(measure(REEL + friction, PROFILES[0]), angle_rad=None, reference_N=None)
    whitened = []
    for effects in ([], [friction]):
        model, added = diagnosed(REEL, [record]), [type(e) for e in effects]
        predictor = Predictor(model, added, [record], 0.1, SMALL)
        residuals = predictor.residuals(truth(predictor, *effects)[None])
        whitened.append(np.sqrt(np.mean(residuals**2)))
    # At the velocity of the linear law, two thirds would remain.
    assert whitened[1] < 0.1 * whitened[0]
