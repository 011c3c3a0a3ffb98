"""Costs beside (35): presets, load rejection, functions of the response."""

from dataclasses import replace

import control
import numpy as np
import pytest

import estune
import plants
from estune.core.cost import PRESETS, StepCost, cost_from
from estune.core.gains import Gains
from estune.core.response import LoadStep, StepResponse, StepShape
from estune.errors import InvalidInput
from estune.loop_model.fitting import fit_loop
from estune.loop_model.prediction import predict
from estune.run.planning import make_plan, step_trial, suited_step, with_load
from estune.run.toml_tables import CostTable, StepTable
from estune.trial import TrialRequest
from estune.trial.loop_records import loop_signals
from estune.trial.profiles import LoadStepProfile
from estune.trial.scoring import cost_of
from experiments.loop_claims import true_sensitivity
from tests.support_lanes import first_by_day

GAINS = Gains(0.3, 4.0, 0.01, 0.02)
RATE = 500.0
STEP = StepShape(5, 1.0)


def plant(**how):
    s = control.tf("s")
    return plants.linear_plant(
        900.0 / (s**2 + 12.0 * s + 900.0), 0.004, RATE, settling_time_s=0.2, gains=GAINS, **how
    )


def mean_square(response: StepResponse) -> float:
    """A cost of the user's: mean square error, and moves of the effort."""
    error = (response.setpoint - response.measurement)[response.step_index :]
    moves = np.diff(response.effort)
    return float(error @ error / error.size + 0.01 * moves @ moves) / response.step_size**2


@pytest.mark.parametrize("criterion", ["itae", "ise"])
@pytest.mark.parametrize("step_N", [2.0, -0.5])
def test_criterion_is_one_for_the_first_order_reference(criterion, step_N):
    t = np.arange(1000) / 1000.0
    y = step_N * (1.0 - np.exp(-4.0 * t / 0.3))
    cost = StepCost(0.3, criterion=criterion)
    eta = cost.evaluate(1000.0, StepShape(0, step_N), np.full(1000, step_N), y, y)
    assert eta == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize(
    ("preset", "parts"),
    [
        ("itae", {"criterion": "itae"}),
        ("ise", {"criterion": "ise", "effort_weight": 0.1}),
        ("rejection", {"criterion": "itae", "rejection": 1.0}),
        ("tracking_and_rejection", {"criterion": "itae", "rejection": 0.5}),  # both alike
    ],
)
def test_preset_is_its_criterion_with_the_usual_move_penalty(preset, parts):
    assert cost_from(preset, 0.2) == StepCost(0.2, move_weight=0.2, **parts)


def told(response: StepResponse) -> float:
    """A cost that keeps what it was given."""
    told.response = response
    return 1.0


def test_function_cost_is_given_deviations_from_the_rest_before_the_step():
    rng, load = np.random.default_rng(4), LoadStep(12, -0.4)
    setpoint = np.array([2.0] * 3 + [5.0] * 17)
    y, u = rng.standard_normal((2, 20))
    cost = cost_from(told, 0.2)
    assert cost.evaluate(10.0, StepShape(3, 3.0, load), setpoint, y, u) == 1.0
    got = told.response
    assert got.time_s == pytest.approx((np.arange(20) - 3) / 10.0)
    assert got.setpoint == pytest.approx(setpoint - 2.0)
    assert got.measurement == pytest.approx(y - 2.0)  # the error stays as it is
    assert got.effort == pytest.approx(u - u[:3].mean())
    assert got[4:] == (3.0, 3, 0.2, load)
    cost.evaluate(10.0, StepShape(0, 5.0), setpoint, y, u)  # of one sample, the first
    assert told.response.effort == pytest.approx(u - u[0])


@pytest.mark.parametrize(
    ("choice", "why"), [("best", "there is no cost 'best'"), ("os:none", "os")]
)
def test_cost_that_does_not_exist_is_refused(choice, why):
    with pytest.raises(InvalidInput, match=why):
        cost_from(choice, 0.2)
    assert cost_from("math:fsum", 0.2) == StepCost(0.2, function="math:fsum")


def test_load_moves_the_plant_but_not_the_recorded_effort_of_an_open_loop():
    reel = plants.reference_reel()
    step = with_load(reel.profile, reel.rig().describe())
    load = step.shape(reel.controller.sampling_Hz).load
    columns = [reel.rig(seed=1).run(TrialRequest("load", 0, reel.rig().describe().gains, profile))
               for profile in (step, replace(step, load_N=2.0 * step.load_N))]  # fmt: skip
    tension = [record.tension_N for record in columns]
    assert np.array_equal(tension[0][: load.sample], tension[1][: load.sample])
    peak = np.abs(tension[1] - tension[0])[load.sample :].max()
    assert 0.1 * abs(step.load_N) < peak < 2.0 * abs(step.load_N)
    after = columns[0].current_A[-5:].mean() * reel.newtons_per_ampere
    assert after == pytest.approx(step.preload_N + step.step_N - step.load_N, rel=0.02)


def test_load_response_of_a_simulated_plant_is_that_of_its_identified_loop():
    model = plant()
    rig = model.rig()
    about = rig.describe()
    for preset in ("rejection", "tracking_and_rejection", "itae"):
        cost = cost_from(preset, about.settling_time_s)
        step = suited_step(about.step, cost, about)
        record = rig.run(TrialRequest(preset.replace("_", ""), 0, GAINS, step))
        signals = loop_signals(record, step, about)
        assert not signals.reason
        fit = fit_loop([signals.record], RATE, about.settling_time_s)
        assert fit.misfit < 1e-6
        other = Gains(0.4, 6.0, 0.012, 0.01)
        measured = rig.run(TrialRequest(preset.replace("_", ""), 1, other, step))
        expected = predict(fit.model, step_trial(about, step, cost), other).cost
        assert cost_of(measured, step, cost, 1.0) == pytest.approx(expected, rel=1e-6)


def test_python_plant_and_compiled_plant_take_the_same_load():
    def first_order(x, effort, dt_s):
        x = 2.0 * effort + (x - 2.0 * effort) * np.exp(-dt_s / 0.1)
        return x, x

    step = LoadStepProfile(0.0, 1.0, 0.05, 0.6, load_N=-0.3, load_at_s=0.3)
    linear = plants.linear_plant(2.0 / (0.1 * control.tf("s") + 1.0), 0.0, RATE)
    written = plants.python_plant(first_order, 0.0, sampling_Hz=RATE, settling_time_s=0.2)
    responses = [plants.simulate(p, GAINS, step).tension_N for p in (linear, written)]
    assert responses[0] == pytest.approx(responses[1], abs=1e-9)


@pytest.mark.parametrize("cost", first_by_day(*list(PRESETS)[1:], mean_square))
def test_search_with_each_cost_stops_by_itself_within_the_limits(cost):
    reel = plants.reference_reel()
    result = estune.tune(reel, cost=cost, journal=False, watch=None)
    assert result.success
    assert result.unsafe == 0
    assert result.session.search_end.startswith("the search ended: ")  # not after all its trials
    assert result.nit <= 10
    assert true_sensitivity(reel, result.gains) < 1.65
    assert result.tuned.metrics.overshoot < 0.07


def test_function_cost_is_stored_by_name_and_a_lambda_is_refused(tmp_path):
    how = {"watch": None, "trials": 2, "repeats": 1, "tuner": "safe_bayesian"}
    result = estune.tune(plant(), cost=mean_square, folder=tmp_path, run="mine", **how)
    assert estune.load(tmp_path / "mine").fun == result.fun
    with pytest.raises(InvalidInput, match="define it at the top of a module"):
        estune.tune(plant(), cost=lambda _: 1.0, journal=False, **how)


def broken(_: StepResponse) -> float:
    raise ZeroDivisionError("no step")


def test_function_cost_that_fails_names_itself_and_its_error():
    cost = cost_from(broken, 0.2)
    with pytest.raises(InvalidInput, match=r"broken failed: ZeroDivisionError: no step"):
        cost.evaluate(RATE, STEP, np.ones(200), np.zeros(200), np.zeros(200))


def test_batch_of_function_costs_is_that_of_single_trials():
    cost = cost_from(mean_square, 0.2)
    rng = np.random.default_rng(2)
    y, u = rng.standard_normal((2, 3, 200))
    batch = cost.evaluate(RATE, STEP, np.ones(200), y, u)
    single = [cost.evaluate(RATE, STEP, np.ones(200), *row) for row in zip(y, u, strict=True)]
    assert batch == pytest.approx(single)


def test_rejection_is_refused_where_the_rig_or_the_trial_has_no_load():
    about = plant().describe("rig", None)  # of no simulated rig: it can make no load
    with pytest.raises(InvalidInput, match="rig makes no load steps") as _:
        suited_step(about.step, cost_from("rejection", 0.2), replace(about, name="rig"))
    loaded = LoadStepProfile(0.0, 1.0, 0.1, 1.0, load_N=0.5, load_at_s=0.5)
    with pytest.raises(InvalidInput, match="the rig can make none at all"):
        about.limits.check(loaded)
    with pytest.raises(InvalidInput, match="the trial has no load step"):
        cost_from("rejection", 0.2).evaluate(RATE, STEP, *np.zeros((3, 200)))
    about = plant().rig().describe()
    about.limits.check(loaded)
    with pytest.raises(InvalidInput, match="at most"):
        about.limits.check(replace(loaded, load_N=3e9))


def test_tables_of_files_give_cost_and_load():
    about = plant().rig().describe()
    cost = CostTable(preset="ise", effort_weight=0.2, move_weight=0.0).of(about)
    assert cost == StepCost(0.2, criterion="ise", effort_weight=0.2)
    step = StepTable(load_N=0.4).of(about)
    before = about.step
    assert step.shape(RATE).load == LoadStep(before.samples(RATE), 0.4)
    assert step.duration_s == pytest.approx(2.0 * before.duration_s - before.step_at_s)
    early = StepTable(load_N=0.4, load_at_s=0.5).of(about)
    assert (early.load_at_s, early.duration_s) == (0.5, before.duration_s)


def test_default_cost_means_the_same_whatever_the_units_of_the_effort():
    for gain in (1.0, 250.0):
        system = control.tf([gain * 2500.0], [1.0, 40.0, 2500.0])
        plant = plants.linear_plant(system, sampling_Hz=500.0)
        about = plant.describe("plant", Gains(1.0, 1.0, 0.0, 0.0))
        choices = {"tuner": "safe_bayesian", "start": Gains(0.1, 1.0, 0.001, 0.01)}
        plan = make_plan(about, "run", bounds=None, step=None, cost=None, **choices)
        assert plan.cost.move_weight == pytest.approx(0.2 * gain**2)
