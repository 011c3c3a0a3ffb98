"""An oscillation that grows, however slowly, makes a trial unsafe."""

import numpy as np
import pytest

import estune
import plants
from estune.core.cost import default_cost
from estune.core.gains import Gains
from estune.core.oscillation import growing_oscillation
from estune.errors import UnsafeStart
from estune.interop import margins
from estune.trial import TrialRequest
from estune.trial.profiles import StepProfile
from estune.trial.scoring import cost_of, growing_oscillation_Hz
from experiments.growing_oscillations import trials
from plants.effects import CoulombFriction, TorqueRipple
from tests.support_binomial import least_hits
from tests.support_targets import slowly_unstable


def decaying(growth, noise, *, frequency=8.0, drift=0.0):
    """A response with an oscillation whose amplitude changes by exp(growth)."""
    t = np.linspace(0.0, 1.0, 500)
    swing = 0.1 * np.exp(growth * t) * np.sin(2.0 * np.pi * frequency * t)
    error = np.random.default_rng(1).normal(0.0, noise, t.size)
    return 1.0 - np.exp(-10.0 * t) + swing + drift * t + error


@pytest.mark.parametrize("drift", [0.0, 0.5])
@pytest.mark.parametrize("frequency", [3.0, 8.0, 40.0])
def test_amplitude_that_grows_is_told_from_one_that_does_not(frequency, drift):
    swing = {"frequency": frequency, "drift": drift}
    found = growing_oscillation(decaying(0.3, 0.003, **swing))
    assert found == pytest.approx(frequency / 499.0, rel=0.02)
    for growth in (-0.1, -0.3):
        assert growing_oscillation(decaying(growth, 0.003, **swing)) is None


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.03])
def test_response_without_an_oscillation_has_none_that_grows(noise):
    rng = np.random.default_rng(2)
    settled = 1.0 - np.exp(-np.linspace(0.0, 30.0, 300))
    found = [growing_oscillation(settled + rng.normal(0.0, noise, 300)) for _ in range(100)]
    assert not any(found)
    assert growing_oscillation(np.ones(300)) is None
    assert growing_oscillation(np.array([1.0, np.nan])) is None


@pytest.mark.parametrize(
    "loops",
    [12, pytest.param(30, marks=pytest.mark.slow), pytest.param(300, marks=pytest.mark.nightly)],
)
def test_unstable_random_loops_are_named_and_no_stable_ones(loops):
    found = list(trials(loops, seed=1))
    unstable = [named for stable, named in found if not stable]
    assert not any(named for stable, named in found if stable)
    assert sum(unstable) >= least_hits(len(unstable), 0.8)


@pytest.mark.parametrize("effect", [CoulombFriction(0.05), TorqueRipple()])
def test_reel_with_effects_has_no_oscillation_that_grows(effect):
    rig = (plants.reference_reel(0.8) + effect).rig(seed=5)
    step = rig.describe().step
    for trial, P in enumerate((0.3, 0.6, 1.0)):
        record = rig.run(TrialRequest("reel", trial, Gains(P, 30.0 * P, 0.017 * P, 0.002), step))
        assert growing_oscillation_Hz(record, step) is None


@pytest.mark.parametrize(
    ("friction_Nm", "P", "I", "step_N", "duration_s"),
    [
        (0.189, 0.092, 2.52, 5.0, 1.0),
        (0.106, 0.494, 41.6, 10.0, 2.0),
        (0.104, 0.154, 0.503, 5.0, 2.0),
    ],
)
def test_loop_that_hunts_by_dry_friction_is_stable_and_has_a_cost(
    friction_Nm, P, I, step_N, duration_s
):
    rig = (plants.reference_reel(0.8) + CoulombFriction(friction_Nm)).rig(seed=0)
    step = StepProfile(15.0, step_N, 0.2, duration_s)
    for trial in range(20):
        record = rig.run(TrialRequest("hunts", trial, Gains(P, I, 0.02 * P, 0.03), step))
        assert np.isfinite(cost_of(record, step, default_cost(0.2), 20.0))


def test_start_whose_oscillation_grows_is_unsafe_and_says_so():
    start = Gains(0.2, 3.4, 0.0015, 0.02)
    with pytest.raises(UnsafeStart, match=r"oscillates at 1\d\.?\d* Hz with a growing amplitude"):
        estune.tune(slowly_unstable(), start=start, journal=False, watch=None)


@pytest.mark.slow
def test_trials_that_are_truly_unstable_are_counted_as_unsafe():
    start = Gains(0.15, 3.4, 0.001, 0.02)
    options = {"tuner": "phase_compensated", "trials": 25, "journal": False, "watch": None}
    result = estune.tune(slowly_unstable().rig(seed=1), start=start, **options)
    flags = result.to_frame()["unsafe"]
    unsafe = [entry for entry, flag in zip(result.entries, flags, strict=True) if flag]
    model, settings = result.rig.linear_model, result.rig.controller
    unstable = [e for e in result.entries if not margins(model, e.gains, settings).stable]
    assert len(unstable) > 5
    assert set(unsafe) <= set(unstable)
    assert len(unsafe) >= 0.8 * len(unstable)
    assert all("growing amplitude" in e.reason for e in unsafe)
