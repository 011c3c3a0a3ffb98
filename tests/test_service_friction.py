"""Dry friction and dead time in records of service, where a load explains either."""

import pytest

import estune
import plants
from estune.core.gains import Gains
from estune.service_records.sources import Logs
from experiments.loop_claims.truth import true_sensitivity
from experiments.sample_efficiency.problems import PROBLEMS, step_trial
from experiments.service_records.service import Service, serve
from plants.effects import CoulombFriction, EyeletFriction


def suggested(plant, cost, gains, kind, length=80.0, *, seed=1):
    rate, trial = plant.controller.sampling_Hz, step_trial(plant, cost)
    r = serve(plant, trial, gains, Service(kind, length), seed)
    logs = Logs((r.log(rate, gains),), (), plant.controller)
    return estune.suggest(logs, settling_time_s=cost.settling_time_s, step=trial.step.size)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["busy", "small steps"])
def test_friction_in_service_is_in_the_margins_or_refuses_them(kind):
    plant = plants.reference_reel() + CoulombFriction(0.005)
    gains = Gains(0.685, 11.2, 0.00815, 0.00825)
    margins = suggested(plant, PROBLEMS["friction"].cost, gains, kind).margins
    if kind == "small steps":  # they move the effort by 4 times the friction
        assert margins is None
    else:
        true = true_sensitivity(plant, gains)
        assert margins.sensitivity.value == pytest.approx(true, rel=0.06)


@pytest.mark.parametrize(
    ("effect", "kind"), [(EyeletFriction(0.93), "busy"), (CoulombFriction(0.05), "dither 1 %")]
)
def test_an_eyelet_in_motion_and_a_drum_that_sticks_refuse_the_margins(effect, kind):
    # Linear fits state Ms as 1.96 (1.84 to 2.12) for 2.81, and 5.5 (1.02 to infinity) for 1.79.
    plant = plants.reference_reel() + effect
    gains = Gains(0.685, 11.2, 0.00815, 0.00825)
    assert suggested(plant, PROBLEMS["friction"].cost, gains, kind).margins is None


@pytest.mark.parametrize(
    "seed", [8, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (12, 14))]
)
def test_an_eyelet_shows_by_another_plant_in_fast_motion(seed):
    # The power of the errors alone is no reason: they state Ms as 1.50 to 1.60 for 1.87.
    plant = plants.reference_reel() + EyeletFriction(0.93)
    gains = Gains(0.2469, 8.397, 0.003641, 0.003946)
    found = suggested(plant, PROBLEMS["friction"].cost, gains, "busy", seed=seed)
    assert "changes with its motion" in found.judgement.reason


@pytest.mark.slow
def test_a_load_does_not_stand_in_for_a_dead_time():
    problem = PROBLEMS["K-K G1"]  # 100 samples of dead time
    gains = Gains(1.64, 0.0584, 0.474, 0.596)
    plant = problem.build()
    margins = suggested(plant, problem.cost, gains, "busy", 40.0).margins
    true = true_sensitivity(plant, gains)
    assert margins.sensitivity.low <= true <= margins.sensitivity.high
    assert margins.sensitivity.value == pytest.approx(true, rel=0.05)
