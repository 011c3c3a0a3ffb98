"""Residual localisation: block, variable and frequency band, before any fit."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from estune.trial import LinearModel, TrialRequest
from experiments.paper.identify.excitation import Band, chirp, multisine
from experiments.paper.identify.open_loop import open_loop_record
from plants import reference_reel
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import noise_floor
from plants.diagnosis.data.smoothing import Smoother
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.residual.localisation import localise
from plants.effects import (
    CableStiffening,
    CoulombFriction,
    DeadTime,
    EyeletFriction,
    GaugeDrift,
    MainsInterference,
    TorqueRipple,
)

BASE = reference_reel()
SINES = multisine(BASE.sampling_Hz, Band(1.0, 60.0, periods=3), 4.0)
SWEEP = chirp(BASE.sampling_Hz, Band(1.0, 30.0, period_s=4.0), 4.0)


@cache
def localise_effects(*effects):
    """Localisation of the residual of a reel with these effects against the plain reel."""
    reel = BASE
    for effect in effects:
        reel = reel + effect
    rig = reel.rig()
    about = rig.describe()
    records = [
        open_loop_record(reel, SINES, seed=1),
        open_loop_record(reel, SWEEP, seed=2),
        rig.run(TrialRequest("r", 0, about.gains, about.step)),
    ]
    measurements = [MeasuredRecord.of(record) for record in records]
    return localise(
        measurements, [BaseNumbers.of(BASE, m) for m in measurements], noise_floor(measurements)
    )


def test_complete_model_has_no_residual():
    result = localise_effects()
    assert {block.name for block in result.blocks} == {"force", "gauge"}
    assert all(0.5 < block.ratio < 1.2 for block in result.blocks)
    assert "leaves nothing unexplained above the noise" in result.sentence


FORCES = "balance of forces"
TRACED = {
    "coulomb": (CoulombFriction(0.03), "force", {"velocity sign", "velocity"}, FORCES),
    "eyelet": (EyeletFriction(), "eyelet", {"velocity sign and tension"}, "eyelet"),
    "ripple": (TorqueRipple(), "force", {"position period", "angle", "tension"}, FORCES),
    "late": (DeadTime(), "force", {"command rate", "frequency"}, FORCES),
    "stiffening": (CableStiffening(), "gauge", {"tension"}, "cable"),
    "drift": (GaugeDrift(), "gauge", {"time"}, "gauge's reading"),
}


@pytest.mark.parametrize("case", TRACED)
def test_effect_is_localised_to_block_and_variable(case):
    effect, name, regimes, title = TRACED[case]
    result = localise_effects(effect)
    first = result.blocks[0]
    assert (first.name, first.title) == (name, title)
    assert first.regime is not None
    assert first.regime.name in regimes
    assert f"in the {title}" in result.sentence
    assert "% of it depends only on" in result.sentence


def test_mains_interference_is_localised_by_its_band():
    first = localise_effects(MainsInterference()).blocks[0]
    assert (first.name, first.regime) == ("gauge", None)
    assert 45.0 < first.low_Hz <= first.high_Hz < 65.0


@pytest.mark.parametrize("missing", ["angle_rad", "tension_N"])
def test_friction_is_localised_with_one_sensor(missing):
    reel = BASE + CoulombFriction(0.03)
    records = [MeasuredRecord.of(open_loop_record(reel, e, seed=1)) for e in (SINES, SWEEP)]
    records = [replace(m, **{missing: None}) for m in records]
    result = localise(records, [BaseNumbers.of(BASE, m) for m in records], noise_floor(records))
    (block,) = result.blocks
    assert block.name == "force"
    assert block.ratio > 2.0
    assert block.regime.name in ("velocity", "velocity sign", "velocity sign and tension")


@pytest.mark.parametrize("rate", [120.0, pytest.param(5000.0, marks=pytest.mark.slow)])
def test_hardening_spring_is_localised_at_any_scale(rate):
    """Solution of m y'' + c y' + k y + k3 y^3 = u at two scales of time and size."""
    size, w = 1e-3, 2.0 * np.pi * rate / 40.0
    n = 4000
    rng = np.random.default_rng(3)
    u = np.repeat(rng.normal(0.0, 1.0, n // 4), 4)

    def slope(t, x):
        force = u[min(int(t * rate), n - 1)]
        return [x[1], w**2 * (force - x[0] - 0.05 * x[0] ** 3) - 0.2 * w * x[1]]

    t = np.arange(n) / rate
    y = solve_ivp(slope, (0.0, t[-1]), [0.0, 0.0], t_eval=t, max_step=1.0 / rate, rtol=1e-8).y[0]
    m = MeasuredRecord(
        name="spring",
        rig="",
        sampling_Hz=rate,
        loop="open",
        time_s=t,
        setpoint_N=u,
        tension_N=size * (y + rng.normal(0.0, 1e-3, n)),
    )
    model = LinearModel(((0.0, 1.0), (-(w**2), -0.2 * w)), (0.0, size * w**2), (1.0, 0.0))
    result = localise([m], [BaseNumbers(1.0, rate, linear=model)], noise_floor([m]))
    (block,) = result.blocks
    assert (block.name, block.regime.name) == ("plant", "tension")
    assert block.regime.share > 0.5


def test_smoothed_derivatives_equal_those_of_the_smoothed_signal():
    t = np.arange(4000) / 1000.0
    w, width = 2.0 * np.pi * 12.0, 0.004
    smoother = Smoother(width, 1000.0)
    damped = np.exp(-0.5 * (w * width) ** 2)
    inside = slice(100, -100)
    expected = damped * (
        2.0 * np.sin(w * t) + 3.0 * w * np.cos(w * t) - 0.1 * w**2 * np.sin(w * t)
    )
    sampled = smoother.sampled(np.sin(w * t), 2.0, 3.0, 0.1)
    assert np.allclose(sampled[inside], expected[inside], rtol=0.0, atol=1e-4 * w**2)
    # A straight line that is held lags half a sample, and by the delay.
    held_signal = smoother.held(t, 0.0123, 1.0)
    assert np.allclose(held_signal[inside], t[inside] - 0.0005 - 0.0123, atol=1e-9)


def test_localisation_as_json():
    data = json.loads(
        json.dumps(localise_effects(CoulombFriction(0.03)).to_json(), allow_nan=False)
    )
    assert (data["block"], data["regime"]) == ("force", data["blocks"][0]["regime"])
    assert data["sentence"].startswith("What the refitted model leaves")
