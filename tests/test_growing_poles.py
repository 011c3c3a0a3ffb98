"""Plants with poles outside the unit circle, identified and tuned like any other."""

import math
from dataclasses import replace

import control
import numpy as np
import pytest

import estune
import plants
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.loop_model import growing_poles
from estune.loop_model.fit_signals import signals_of
from estune.loop_model.fitting import fit_loop
from estune.loop_model.growing_poles import growing_fit
from estune.loop_model.intervals import predict_with_intervals
from estune.loop_model.least_squares import Solution
from estune.loop_model.margins import robustness
from estune.loop_model.optimum import RobustnessLimits
from estune.loop_model.poles import (
    OUTSIDE,
    coordinates_of,
    difference_polynomial,
    mirrored,
    polynomial,
    sections_of,
)
from estune.loop_model.prediction import StepTrial
from estune.loop_model.records import LoopRecord
from estune.run.ending import RunEnding
from estune.trial import RigLimits
from estune.trial.profiles import StepProfile
from estune.tuners import identified_loop
from estune.tuners.identified_loop import IdentifiedLoopTuner
from estune.tuners.observation import Observation
from estune.tuners.search_space import SearchSpace
from experiments.loop_claims import true_sensitivity
from plants.simulation.noise import NoiseSource

NOISE = 0.003
SYSTEMS = {
    "lag": (control.tf([1.0], [1.0, -1.0]), 0.05, 1.0, Gains(2.7, 4.7, 0.026, 0.38)),
    "levitation": (control.tf([1.0], [1.0, 0.0, -1.0]), 0.0, 2.0, Gains(4.8, 8e-4, 4.7, 2.9)),
    "pendulum": (
        control.tf([10.0], np.convolve([1.0, 2.0, -10.0], [0.02, 1.0])),
        *(0.0, 1.0, Gains(5.2, 1.4, 1.6, 0.7)),
    ),
    "swinging": (control.tf([4.0], [1.0, -0.8, 4.0]), 0.02, 1.5, Gains(2.0, 1.0, 1.2, 0.3)),
}


def plant_of(name):
    system, dead_time_s, settling_s, gains = SYSTEMS[name]
    rate = 200.0 / settling_s
    return plants.linear_plant(
        system,
        dead_time_s=dead_time_s,
        sampling_Hz=rate,
        derivative_filter_s=2.0 / rate,
        noise_rms_N=NOISE,
        settling_time_s=settling_s,
        profile=StepProfile(0.0, 1.0, 0.25 * settling_s, 2.75 * settling_s),
        limits=RigLimits(-10.0, 10.0, 100.0),
        gains=gains,
    )


def record_of(plant, gains):
    step, rate = plant.profile, plant.controller.sampling_Hz
    noise = NoiseSource(5).draw(0, step.samples(rate), NOISE)
    response = plants.simulate(plant, gains, noise_N=noise)
    index = step.step_index(rate)
    return LoopRecord.of_step(response.effort_N, response.tension_N, step.step_N, index, gains)


@pytest.mark.parametrize("name", SYSTEMS)
def test_one_record_of_an_unstable_plant_tells_the_sensitivity_at_other_gains(name):
    plant, (*_, settling_s, gains) = plant_of(name), SYSTEMS[name]
    rate, step = plant.controller.sampling_Hz, plant.profile
    fit = fit_loop([record_of(plant, gains)], rate, settling_s)
    assert fit.model.grows
    assert fit.noise_std == pytest.approx(NOISE, rel=0.1)
    trial = StepTrial(
        plant.controller, StepCost(settling_s), 0.0, step.shape(rate), step.samples(rate)
    )
    other = replace(gains, P=1.2 * gains.P, D=0.8 * gains.D)
    Ms = predict_with_intervals(fit, trial, other).sensitivity
    assert Ms.low <= true_sensitivity(plant, other) <= Ms.high < 1.5 * Ms.value


def test_growing_poles_without_a_compiler_are_the_same(monkeypatch):
    plant, (*_, settling_s, gains) = plant_of("lag"), SYSTEMS["lag"]
    settling = settling_s * plant.controller.sampling_Hz
    signals = signals_of([record_of(plant, gains)], settling)
    found = growing_fit(signals)
    monkeypatch.setattr(growing_poles, "compiled", lambda _: None)
    same = growing_fit(signals)
    assert found.dead == same.dead
    np.testing.assert_allclose(found.coordinates, same.coordinates, rtol=1e-6)


@pytest.mark.parametrize(
    "coordinates",
    [
        (OUTSIDE - 3.0,),
        (OUTSIDE - 3.0, -2.0),
        (OUTSIDE - 3.0, OUTSIDE - 0.5),
        (OUTSIDE - 3.0, OUTSIDE + 0.5),
        (-2.0, -0.3, OUTSIDE - 3.0),
    ],
)
def test_coordinates_of_growing_poles_are_those_the_polynomial_was_made_from(coordinates):
    (found,) = coordinates_of(difference_polynomial(coordinates)[np.newaxis], growing=True)
    assert found == pytest.approx(coordinates, abs=1e-9)
    assert max(np.abs(np.roots(polynomial(coordinates)))) > 1.0
    assert coordinates_of(difference_polynomial(coordinates)[np.newaxis]) == [None]


def test_prediction_error_of_the_true_unstable_plant_is_its_noise_through_an_all_pass():
    plant = plant_of("levitation")
    record, rate = record_of(plant, SYSTEMS["levitation"][-1]), plant.controller.sampling_Hz
    pole = 1.0 / rate
    at = Solution.at(
        signals_of([record], 200.0, 0), np.array([OUTSIDE + math.log(pole), math.log(pole)]), 0
    )
    assert np.std(at.residual) == pytest.approx(math.exp(pole) * NOISE, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_unstable_plant_is_tuned_in_few_trials_and_its_claim_is_true(name):
    plant = plant_of(name)
    cost = StepCost(SYSTEMS[name][2], time_unit="settling_time", move_weight=0.2)
    result = estune.tune(plant, start=SYSTEMS[name][-1], cost=cost, journal=False, watch=None)
    assert result.ending in {RunEnding.TUNED, RunEnding.LIMITS_NOT_SHOWN}
    assert result.nfev <= 10
    true = true_sensitivity(plant, result.gains)
    assert true <= 1.6 * 1.01
    Ms = result.claim.margins.sensitivity
    assert Ms.low <= true <= Ms.high
    assert robustness(result.identified.fit.model, result.gains, plant.controller)[
        0
    ] == pytest.approx(true, rel=0.02)


@pytest.mark.parametrize("coordinates", [(1e9,), (1e9, 0.0), (-2.0, 1e9), (1e9, 1e9)])
def test_a_step_far_beyond_any_coordinate_makes_no_pole_grow(coordinates):
    # Along a pole that records do not know covariances allow such steps.
    assert not any(section.grows for section in sections_of(coordinates))


def test_start_that_is_only_just_stable_is_not_pushed_towards_instability(monkeypatch):
    monkeypatch.setattr(identified_loop, "MISFIT_MAX", -1.0)  # so that the fallback proposes
    plant, gains = plant_of("levitation"), Gains(1.4, 8e-4, 0.5, 0.5)
    step, rate, cost = plant.profile, plant.controller.sampling_Hz, StepCost(2.0)
    trial = StepTrial(plant.controller, cost, 0.0, step.shape(rate), step.samples(rate))
    tuner = IdentifiedLoopTuner(SearchSpace.around(gains)).for_trial(trial, RobustnessLimits())
    here = true_sensitivity(plant, gains)
    assert 2.5 < here < 10.0
    state = tuner.tell_start(tuner.start(), Observation(1.0, record=record_of(plant, gains)))
    for _ in range(4):
        proposed = tuner.space.gains(tuner.ask(state))
        assert true_sensitivity(plant, proposed) <= 1.02 * here
        record = record_of(plant, proposed)
        state = tuner.tell(state, Observation(1.1, record=record))


def test_growing_pole_beside_one_that_decays_at_once_has_an_inverse():
    pair = np.array([OUTSIDE - 2.0, 2000.0])
    kept = mirrored(pair)
    assert np.isfinite(kept).all()
    slower = sections_of(kept)[0].poles[0].real
    assert 0.0 < slower < 1.0
