"""Results that are not robust, ill-posed trials, and rigs whose records cannot be trusted."""

import math
from dataclasses import replace
from types import SimpleNamespace

import control
import numpy as np
import pytest

import estune
import plants
from estune.core.cost import default_cost
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.response import StepShape
from estune.errors import InvalidInput
from estune.loop_model.claim import claim
from estune.loop_model.fitting import fit_loop
from estune.loop_model.half_widths import HalfWidths
from estune.loop_model.limit_price import price_of
from estune.loop_model.optimum import RobustnessLimits
from estune.loop_model.plant_error import plant_error
from estune.loop_model.prediction import StepTrial
from estune.loop_model.records import LoopRecord
from estune.run.ending import RunEnding
from estune.run.planning import step_trial
from estune.run.robustness import not_robust
from estune.run.trial_quality import check_noise
from estune.trial import TrialRequest
from estune.trial.profiles import StepProfile
from estune.trial.scoring import cost_of
from experiments.batch.__main__ import start_of
from experiments.batch.loop import ProcessLoop
from experiments.batch.processes import PROCESSES
from experiments.batch.rig import BatchRig
from experiments.loop_claims import true_sensitivity
from experiments.sample_efficiency.problems import PROBLEMS
from tests.support_loops import loop_of_taps


def tune(target, **settings):
    return estune.tune(target, **{"journal": False, "watch": None, **settings})


class Behind:
    """A rig whose records a test changes."""

    def __init__(self, rig):
        self._rig = rig

    def __getattr__(self, name):
        return getattr(self._rig, name)


@pytest.fixture(scope="module")
def fast():
    """Tuned without limits by the cost alone, on a plant with a long dead time."""
    problem = PROBLEMS["dead time"]
    limits = RobustnessLimits(max_sensitivity=None, max_overshoot=None)
    settings = {"cost": problem.cost, "start": problem.start, "limits": limits}
    return problem, tune(problem.build(), **settings)


def test_tuned_gains_of_high_sensitivity_end_as_not_robust_and_keep_the_start(fast):
    problem, free = fast
    assert free.ending is RunEnding.TUNED
    assert free.claim.margins.sensitivity.value > 2.5
    # The same search judged by the usual limits.
    result = tune(problem.build(), cost=problem.cost, start=problem.start, tuner="safe_bayesian")
    assert result.ending is RunEnding.NOT_ROBUST
    assert result.ending.exit_code == 8
    assert not result.success
    assert result.gains == problem.start
    assert "not robust: the sensitivity Ms is" in result.message
    assert result.heading().startswith("NOT ROBUST")


@pytest.mark.parametrize("with_any_gains", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_response_that_ends_farther_from_its_setpoint_than_before_is_not_robust(with_any_gains):
    class Drooping(Behind):
        def run(self, request):
            record = self._rig.run(request)
            droops = with_any_gains or request.gains != self._rig.describe().gains
            late = record.time_s > 0.6 * record.time_s[-1]
            return replace(record, tension_N=record.tension_N - 0.4 * (late & droops))

    result = tune(Drooping(plants.reference_reel().rig()), trials=2, tuner="otis")
    assert ("off its setpoint" in result.message) == (not with_any_gains)
    assert with_any_gains or result.ending is RunEnding.NOT_ROBUST


@pytest.fixture(scope="module")
def reel():
    """The reference reel, tuned."""
    return tune(plants.reference_reel())


def test_plant_is_known_as_well_at_half_the_sampling_rate_as_just_below_it(reel):
    error = plant_error(reel.identified.fit, reel.identified.signals)
    assert error.theta[-1] < np.pi
    assert error.bound[-1] < 1.3 * error.bound[-2]


@pytest.mark.parametrize(("swing_N", "says"), [(0.0, ""), (0.25, "not settled")])
def test_response_settles_about_the_value_it_ends_at(reel, swing_N, says):
    """2 % off, as with the initial gains, in noise of 1 %: no sample of it decides."""
    noise = np.random.default_rng(1)

    def ending_off(record):
        time_s, step = record.time_s, reel.plan.step
        swing = swing_N * np.sin(2.0 * np.pi * 25.0 * time_s) * (record.gains == reel.gains)
        ends = step.preload_N + step.step_N + 0.02 * step.step_N + swing
        before = np.arange(time_s.size) < step.step_index(record.sampling_Hz)
        exact = np.where(before, step.preload_N, ends)
        noisy = exact + 0.01 * step.step_N * noise.standard_normal(time_s.size)
        return replace(record, tension_N=noisy)

    records = [ending_off(record) for record in reel.recent_records]
    why = not_robust(records, reel.plan, reel.claim, reel.gains, reel.rig)
    assert says in why
    assert bool(why) == bool(says)


def test_price_of_limits_is_small_on_a_reel_and_names_softer_limits_where_dear(fast, reel):
    said = "Without the limits on Ms and overshoot the model predicts a cost lower by 3."
    assert any(remark.startswith(said) for remark in reel.remarks())
    _, free = fast
    space, plan = free.plan.tuner.space, free.plan
    low, high = np.array(space.coordinate_bounds)
    price = price_of(
        free.identified.fit,
        step_trial(free.rig, plan.step, plan.cost),
        RobustnessLimits(max_sensitivity=1.3),
        lambda x: space.gains(space.point(tuple(x.tolist()))),
        at=np.array(space.coordinates(space.point_of(free.gains))),
        bounds=(low, high),
        beside=HalfWidths(0.0, 0.0, 0.0),
    )
    assert price.price > 0.05
    assert [limit for limit, _ in price.softer] == [1.8, 2.0]
    assert price.price > price.softer[0][1] >= price.softer[1][1]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"step": StepProfile(15.0, 0.1, 0.2, 1.0)}, "noise makes up .* of the cost of trial"),
        ({"cost": default_cost(0.01)}, "is 6.3 samples, and 10 are needed"),
    ],
)
def test_ill_posed_trial_is_refused_unless_forced(changes, message):
    ran = []
    with pytest.raises(InvalidInput, match=message):
        tune(plants.reference_reel(), watch=ran.append, **changes)
    assert len(ran) <= 3  # the baseline
    assert tune(plants.reference_reel(), trials=1, force=True, **changes).nit == 1


def test_chance_refuses_no_step_of_a_hundred_times_the_noise_and_passes_none_of_twenty():
    process = next(one for one in PROCESSES if one.name == "1/(s^2-1)")
    cost = default_cost(process.settling_time_s)
    for share, refused in ((0.01, 0), (0.05, 20)):
        rig = BatchRig(ProcessLoop(process, share), start_of(process), 3)
        about, caught = rig.describe(), 0
        posed = SimpleNamespace(step=about.step, cost=cost)
        for number in range(20):
            record = rig.run(TrialRequest("run", number, start_of(process), about.step))
            eta = cost_of(record, about.step, cost, about.newtons_per_ampere)
            try:
                check_noise(record, posed, about, eta)
            except InvalidInput:
                caught += 1
        assert caught == refused


def test_step_before_a_warm_up_is_over_is_refused_as_that_and_not_as_noise():
    def chamber(degC, percent, dt_s):
        degC += dt_s * (8.0 * min(max(percent, 0.0), 100.0) - 5.0 * (degC - 20.0)) / 900.0
        return degC, degC

    plant = plants.python_plant(
        *(chamber, 20.0),
        initial_measurement_N=20.0,
        sampling_Hz=1.0,
        settling_time_s=120.0,
        output_min_N=0.0,
        output_max_N=100.0,
        dead_time_s=4.0,
        profile=StepProfile(60.0, 10.0, 60.0, 600.0),
    )
    with pytest.raises(InvalidInput, match="the loop is not at rest where trial"):
        tune(plant)


def test_short_settling_time_and_few_samples_are_told():
    reel = plants.reference_reel()
    remarks = tune(reel, cost=default_cost(0.03), trials=2).remarks()
    assert any("is short for a plant" in remark for remark in remarks)
    assert any("fewer than 25" in remark for remark in remarks)


@pytest.mark.slow
def test_plant_that_changes_between_trials_is_not_claimed():
    class Changing(Behind):
        def __init__(self):
            inertias = (1.5e-3, 2.5e-3)
            self._rigs = [plants.reference_reel(drum_inertia_kg_m2=j).rig() for j in inertias]
            super().__init__(self._rigs[0])

        def run(self, request):
            return self._rigs[request.number % 2].run(request)

    result = tune(Changing(), trials=4, tuner="otis")
    assert result.claim.margins is None
    assert result.heading().startswith("TUNED, LIMITS NOT SHOWN")


def test_unstable_plant_is_tuned_without_a_wrong_claim():
    unstable = plants.linear_plant(
        control.tf([30.0], [1.0, 2.0, -15.0]),
        sampling_Hz=200.0,
        gains=Gains(1.5, 2.0, 0.1, 0.05),
        noise_rms_N=0.004,
        profile=StepProfile(0.0, 1.0, 0.2, 3.0),
        settling_time_s=1.0,
    )
    result = tune(unstable, trials=4, tuner="otis")
    assert not result.heading().startswith("TUNED:")
    if (claimed := result.claim.margins) is None:
        assert result.claim.reason
    else:
        Ms = claimed.sensitivity
        assert Ms.low <= true_sensitivity(unstable, result.gains) <= Ms.high


def records_without_response(samples=150):
    rng = np.random.default_rng(3)
    effort = np.linspace(0.0, 5.0, samples)
    return [
        LoopRecord.of_step(effort, 0.01 * rng.standard_normal(samples), 1.0, 20) for _ in range(4)
    ]


def test_dead_time_longer_than_a_trial_is_told():
    gains, controller = Gains(1.0, 1.0, 0.0, 0.0), ControllerSettings(100.0, 0.0, -1e9, 1e9)
    trial = StepTrial(controller, default_cost(0.5), 0.0, StepShape(20, 1.0), 150)
    records = [r._replace(gains=gains) for r in records_without_response()]
    fit = fit_loop(records, 100.0, 0.5)
    assert not fit.responds
    made = claim(fit, records, trial, gains)
    assert "does not follow the effort within a trial" in made.reason


@pytest.mark.slow
def test_plant_without_steady_state_is_not_claimed():
    class Drifting(Behind):
        def run(self, request):
            record = self._rig.run(request)
            drift = 3.0 * np.maximum(record.time_s - 0.5, 0.0) ** 2
            return replace(record, tension_N=record.tension_N + drift)

    result = tune(Drifting(plants.reference_reel().rig()), trials=6, tuner="otis")
    assert result.claim.margins is None


def test_natural_period_of_a_model_is_that_of_its_poles():
    w, z = 0.1, 0.3
    radius, angle = math.exp(-z * w), w * math.sqrt(1.0 - z * z)
    model = loop_of_taps((-2.0 * radius * math.cos(angle), radius**2), (0.0, 0.0, 0.0), 0)
    assert model.natural_period == pytest.approx(2.0 * math.pi / w)


@pytest.mark.slow
def test_advice_of_a_low_margin_raises_the_margin_when_followed(fast):
    problem, free = fast
    assert [finding.kind for finding in free.findings if finding.kind == "margin"]
    limited = tune(problem.build(), cost=problem.cost, start=problem.start)
    assert not [finding.kind for finding in limited.findings if finding.kind == "margin"]
