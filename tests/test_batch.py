"""The simulation and the rules of the batch, against independent references."""

import math

import control
import numpy as np
import pytest

import plants
from estune.core.cost import default_cost
from estune.core.gains import Gains
from estune.run.ending import RunEnding
from estune.trial import TrialRequest
from estune.trial.profiles import StepProfile
from estune.trial.scoring import cost_of
from experiments.batch.__main__ import is_beyond, start_of, tuned
from experiments.batch.loop import FILTER_SAMPLES, ProcessLoop
from experiments.batch.optimum import optimum
from experiments.batch.processes import PROCESSES, UNSTABLE
from experiments.batch.rig import BatchRig, Disturbance
from experiments.batch.rules import first_order, relay_experiment, simc
from experiments.loop_claims import true_sensitivity

BY_NAME = {process.name: process for process in PROCESSES}


def product_plant(process):
    """The process as a plant of estune at the same rate."""
    A, B, C = process.state_space
    loop = ProcessLoop(process)
    count = loop.before + loop.after
    return plants.linear_plant(
        control.ss(A, B[:, None], C[None], 0.0),
        dead_time_s=process.dead_time_s,
        sampling_Hz=1.0 / loop.h,
        derivative_filter_s=FILTER_SAMPLES * loop.h,
        profile=StepProfile(0.0, 1.0, loop.before * loop.h, count * loop.h),
    )


@pytest.mark.parametrize("name", ["e^-s/(2s+1)", "1/(s+1)^3", "1/(s^2-1)", "(1-0.5s)/(s+1)^3"])
def test_own_simulation_agrees_with_that_of_the_plants(name):
    process = BY_NAME[name]
    loop, gains = ProcessLoop(process), start_of(process)
    cost, plant = default_cost(process.settling_time_s), product_plant(process)
    at = loop.at(gains, cost)
    assert at.Ms == pytest.approx(true_sensitivity(plant, gains), rel=2e-4)
    response = plants.simulate(plant, gains)
    record = BatchRig(loop, gains, 0).run(TrialRequest("run", 0, gains, plant.profile))
    assert record.tension_N == pytest.approx(response.tension_N, abs=1e-6)
    assert record.current_A == pytest.approx(response.effort_N, abs=1e-6)
    peak = max(float(response.tension_N.max()) - 1.0, 0.0)
    assert at.overshoot == pytest.approx(peak, abs=1e-6)


@pytest.mark.parametrize("process", PROCESSES, ids=lambda process: process.name)
def test_every_process_begins_with_a_stable_loop(process):
    at = ProcessLoop(process).at(start_of(process), default_cost(process.settling_time_s))
    assert math.isfinite(at.Ms)


def test_integral_of_the_error_after_a_load_is_the_inverse_of_the_integral_gain():
    process = BY_NAME["e^-s/(2s+1)"]
    slow = Gains(0.3, 0.1, 0.0, 0.0)  # so slow that the error keeps its sign
    at = ProcessLoop(process).at(slow, default_cost(process.settling_time_s))
    assert at.load_IAE == pytest.approx(1.0 / slow.I, rel=1e-3)


def test_first_order_model_of_a_first_order_process_is_the_process():
    loop = ProcessLoop(BY_NAME["e^-s/(2s+1)"])
    gain, T, dead_s = first_order(loop)
    assert gain == pytest.approx(1.0, rel=1e-6)
    assert pytest.approx(2.0, rel=0.03) == T
    assert dead_s == pytest.approx(1.0 + 0.5 * loop.h, abs=loop.h)


def test_simc_of_equal_lags_is_that_of_the_half_rule():
    loop = ProcessLoop(BY_NAME["1/(s+1)^3"])
    dead_s = 0.5 + 0.5 * loop.h
    K, Ti, Td = 1.0 / (2.0 * dead_s), 1.0, 1.5  # of the series form
    assert simc(loop).to_standard() == pytest.approx((K * (1.0 + Td / Ti), Ti + Td, Td / 2.5))


def test_relay_finds_the_ultimate_point_of_a_dead_time_process():
    process = BY_NAME["e^-s/(10s+1)"]
    K, period_s = relay_experiment(ProcessLoop(process))
    assert period_s == pytest.approx(process.ultimate[1], rel=0.05)
    assert pytest.approx(process.ultimate[0], rel=0.25) == K  # a describing function


def test_only_a_plain_tuned_breaks_the_promise():
    above = {"Ms": 1.62, "overshoot_percent": 1.0}
    assert is_beyond(above | {"ending": "tuned"})
    assert not is_beyond(above | {"ending": "tuned, limits not shown"})
    assert not is_beyond({"ending": "tuned", "Ms": 1.61, "overshoot_percent": 5.04})


def test_noise_raises_the_cost_by_what_it_adds_to_error_and_moves():
    process = next(p for p in PROCESSES if p.family != UNSTABLE)
    cost, gains = default_cost(process.settling_time_s), start_of(process)
    quiet, noisy = (ProcessLoop(process, noise).at(gains, cost).cost for noise in (0.0, 0.01))
    loop = ProcessLoop(process, 0.01)
    rig = BatchRig(loop, gains, 3)
    profile = rig.describe().step
    shape = profile.shape(1.0 / loop.h)
    costs = []
    for number in range(40):
        record = rig.run(TrialRequest("run", number, gains, profile))
        columns = record.setpoint_N, record.tension_N, record.current_A
        costs.append(cost.evaluate(1.0 / loop.h, shape, *columns))
    error = np.std(costs) / math.sqrt(len(costs))
    assert noisy > quiet
    assert noisy == pytest.approx(np.mean(costs), abs=6.0 * error)


def tuned_under(name, level, seed):
    """A tuning of a process under loads of a level, and its cost above the optimum."""
    process = BY_NAME[name]
    loop, acting = ProcessLoop(process, 0.003), Disturbance(level, level, level)
    run, gains, cost = tuned(loop, seed, "paper", acting)
    best = optimum(loop, cost, [start_of(process), gains])
    return run, loop.at(gains, cost).cost / loop.at(best, cost).cost - 1.0


@pytest.mark.parametrize(
    ("name", "level", "seed"),
    [
        ("e^-s/(10s+1)", 0.01, 5000),
        pytest.param("e^-s/(0.5s+1)", 0.03, 5000, marks=pytest.mark.slow),
    ],
)
def test_loads_in_trials_are_told_from_the_plant_in_few_trials(name, level, seed):
    run, above = tuned_under(name, level, seed)
    assert run["trials"] <= 20
    assert above < 0.1
    assert run["ending"] in (RunEnding.TUNED, RunEnding.LIMITS_NOT_SHOWN)


def test_costs_of_many_trials_are_those_of_the_trials_one_by_one():
    process = BY_NAME["e^-s/(10s+1)"]
    loop, gains = ProcessLoop(process, 0.003), start_of(process)
    rig = BatchRig(loop, gains, 7, Disturbance(0.03, 0.03, 0.03))
    step, cost = rig.describe().step, default_cost(process.settling_time_s)
    records = [rig.run(TrialRequest("run", number, gains, step)) for number in range(3)]
    one_by_one = [cost_of(record, step, cost, 1.0) for record in records]
    assert rig.costs(gains, cost, 3) == pytest.approx(one_by_one, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "seed", "best"),
    [
        ("1/(s^2-1)", 1003, Gains(13.56, 15.20, 4.368, 0.7997)),
        ("1/s(s+1)^2", 1005, Gains(0.7068, 1.5e-6, 0.7246, 0.1255)),
    ],
)
def test_plant_whose_margin_to_the_limits_is_dear_is_tuned_to_its_optimum(name, seed, best):
    loop = ProcessLoop(BY_NAME[name], 0.003)
    run, gains, cost = tuned(loop, seed, "paper", Disturbance())
    assert run["ending"] == RunEnding.TUNED
    assert run["trials"] <= 12
    found, Ms, overshoot = loop.judged(gains, cost)
    assert found <= 1.01 * loop.judged(best, cost)[0]
    assert Ms <= 1.616
    assert overshoot <= 0.0505
