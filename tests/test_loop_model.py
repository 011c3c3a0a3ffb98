"""The loop identified from step records: margins, predictions, optimum and claims."""

import math
from dataclasses import replace

import control
import numpy as np
import pytest

import plants
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.margins import loop_margins, sample_plant
from estune.core.pidf import ControllerSettings
from estune.core.response import LoadStep
from estune.loop_model import closed_loops, friction_motion, least_squares
from estune.loop_model.claim import claim
from estune.loop_model.fit_signals import signals_of
from estune.loop_model.fitting import fit_loop, fit_with_excitations
from estune.loop_model.half_widths import HalfWidths
from estune.loop_model.identification import PoleFit, improve
from estune.loop_model.intervals import predict_with_intervals
from estune.loop_model.least_squares import Solution
from estune.loop_model.margins import robustness
from estune.loop_model.model import LoopModel, close_loop, exchanged
from estune.loop_model.noise_model import WHITE, NoiseModel
from estune.loop_model.optimum import DERIVATIVE, RegionSearch, RobustnessLimits
from estune.loop_model.poles import pair_coordinates, polynomial
from estune.loop_model.prediction import StepTrial, predict, predictions
from estune.loop_model.records import LoopRecord
from estune.trial.profiles import StepProfile
from estune.tuners.model_convergence import model_convergence
from estune.tuners.search_space import SearchSpace
from estune.tuners.searched_loop import SearchedLoop
from experiments.loop_claims import true_sensitivity
from experiments.sample_efficiency.problems import step_trial
from plants.effects import CoulombFriction, EyeletFriction
from plants.simulation.noise import NoiseSource
from tests.support_binomial import least_hits
from tests.support_loops import loop_of_taps

SAMPLING_HZ = 200.0
W = 2.0 * math.pi * 5.0
SYSTEM = control.tf([W * W], [1.0, 0.6 * W, W * W])
STEP = StepProfile(preload_N=0.0, step_N=1.0, step_at_s=0.1, duration_s=1.5)
COST = StepCost(0.2, time_unit="settling_time", move_weight=1.0)
GAINS = Gains(0.4, 6.0, 0.01, 0.02)
NOISE_N = 0.004


def linear(limit_N=1e6, system=SYSTEM):
    return plants.linear_plant(
        system,
        dead_time_s=2.0 / SAMPLING_HZ,
        sampling_Hz=SAMPLING_HZ,
        output_min_N=-limit_N,
        output_max_N=limit_N,
        derivative_filter_s=0.01,
        profile=STEP,
    )


def exact_model():
    """The plant under zero-order hold; y_k depends on u_{k-1} at the earliest."""
    sampled = control.c2d(SYSTEM, 1.0 / SAMPLING_HZ)
    numerator, denominator = sampled.num[0][0], sampled.den[0][0]
    return loop_of_taps(tuple(denominator[1:]), (*numerator[-2:], 0.0), 2)


@pytest.mark.parametrize("roots", [(0.9, 0.0), (0.9, 0.5), (0.8 + 0.3j, 0.8 - 0.3j)])
def test_fit_begins_at_any_earlier_poles_also_at_one_that_decays_within_a_sample(roots):
    denominator = np.real(np.poly(roots))
    found = polynomial(pair_coordinates(*denominator[1:]))
    assert found == pytest.approx(denominator, abs=1e-9)


def trial_of(plant, effort_N=0.0):
    c, step = plant.controller, plant.profile
    rate = c.sampling_Hz
    return StepTrial(c, COST, step.preload_N, step.shape(rate), step.samples(rate), effort_N)


def record_of(plant, gains, number=0, noise_N=NOISE_N):
    step, rate = plant.profile, plant.controller.sampling_Hz
    noise = NoiseSource(5).draw(number, step.samples(rate), noise_N)
    response = plants.simulate(plant, gains, noise_N=noise)
    index = step.step_index(rate)
    return LoopRecord.of_step(response.effort_N, response.tension_N, step.step_N, index, gains)


def cost_of(plant, gains, cost=COST):
    step, rate = plant.profile, plant.controller.sampling_Hz
    r = plants.simulate(plant, gains)
    columns = (r.setpoint_N, r.tension_N, r.effort_N)
    return cost.evaluate(rate, step.shape(rate), *columns)


def around(gains, count, spread=0.3, seed=1):
    rng = np.random.default_rng(seed)
    base = np.log(gains.as_tuple())
    return [Gains(*np.exp(base + spread * rng.standard_normal(4))) for _ in range(count)]


@pytest.mark.parametrize("factor", [0.3, 1.0, 2.0])
def test_margins_equal_those_of_the_sampled_plant(factor):
    gains = Gains(factor * 0.4, factor * 6.0, factor * 0.01, 0.02)
    settings, dead_time_s = linear().controller, 2.0 / SAMPLING_HZ
    ss = control.ss(SYSTEM)
    plant = sample_plant(
        ss.A, ss.B[:, 0], ss.C[0], 0.0, dead_time_s=dead_time_s, sample_s=1.0 / SAMPLING_HZ
    )
    reference = loop_margins(plant, gains, settings)
    result = robustness(exact_model(), gains, settings)
    assert result.phase_margin_deg == pytest.approx(reference.phase_margin_deg, abs=0.1)
    theta = np.linspace(1e-4, math.pi, 200_000)
    h, lag = 1.0 / SAMPLING_HZ, settings.derivative_filter_s
    z = np.exp(1j * theta)
    controller = gains.P + gains.I * h / (z - 1) + gains.D * (z - 1) / ((lag + h) * z - lag)
    peak = np.max(1.0 / np.abs(1.0 + controller * plant.response(theta)))
    assert result.sensitivity == pytest.approx(peak, rel=2e-3)


def test_stability_agrees_with_the_poles_of_the_closed_loop():
    settings, model = linear().controller, exact_model()
    for gains in around(Gains(2.0, 40.0, 0.05, 0.01), 60, spread=1.0):
        radius = np.abs(np.roots(close_loop(model, gains, settings).characteristic)).max()
        if abs(radius - 1.0) > 1e-6:
            assert math.isfinite(robustness(model, gains, settings).sensitivity) == (radius < 1.0)


@pytest.mark.parametrize("limit_N", [1e6, 1.05])
def test_prediction_of_the_exact_model_equals_the_simulated_trial(limit_N):
    plant = linear(limit_N)
    for gains in around(GAINS, 5):
        predicted = predict(exact_model(), trial_of(plant), gains)
        assert predicted.cost == pytest.approx(cost_of(plant, gains), rel=1e-9)


def test_identified_loop_predicts_cost_and_sensitivity_far_from_the_trials():
    plant = linear()
    start = Gains(0.1, 2.0, 0.002, 0.1)
    records = [record_of(plant, g, n) for n, g in enumerate(around(start, 10))]
    fit = fit_loop(records, SAMPLING_HZ, COST.settling_time_s)
    assert fit.misfit < 0.002
    far = predict_with_intervals(fit, trial_of(plant), GAINS)
    truth = robustness(exact_model(), GAINS, plant.controller)
    assert far.sensitivity.value == pytest.approx(truth.sensitivity, rel=0.02)
    assert far.sensitivity.low < truth.sensitivity < far.sensitivity.high
    assert far.cost.value == pytest.approx(cost_of(plant, GAINS), rel=0.03)


@pytest.mark.parametrize(
    "seeds",
    [3, pytest.param(8, marks=pytest.mark.slow), pytest.param(100, marks=pytest.mark.nightly)],
)
def test_intervals_of_sensitivity_hold_the_true_value(seeds):
    plant, covered = linear(), 0
    truth = robustness(exact_model(), GAINS, plant.controller).sensitivity
    for seed in range(seeds):
        gains = around(Gains(0.2, 4.0, 0.005, 0.05), 5, seed=seed)
        records = [record_of(plant, g, 100 * seed + n) for n, g in enumerate(gains)]
        fit = fit_loop(records, SAMPLING_HZ, COST.settling_time_s)
        interval = predict_with_intervals(fit, trial_of(plant), GAINS).sensitivity
        covered += interval.low < truth < interval.high
    assert covered >= least_hits(seeds, 0.95)


@pytest.mark.parametrize(
    "seeds",
    [3, pytest.param(8, marks=pytest.mark.slow), pytest.param(100, marks=pytest.mark.nightly)],
)
def test_interval_of_a_plant_of_one_pole_holds_its_sensitivity_and_is_narrow(seeds):
    covered = narrow = 0
    for seed in range(seeds):
        lag_s = float(np.exp(np.random.default_rng(seed).uniform(*np.log([0.02, 0.5]))))
        plant = linear(system=control.tf([1.0], [lag_s, 1.0]))
        gains = Gains(25.0 * lag_s, 25.0, 1e-4, 0.01)
        records = [record_of(plant, gains, 100 * seed + n) for n in range(3)]
        fit = fit_loop(records, SAMPLING_HZ, COST.settling_time_s)
        interval = predict_with_intervals(fit, trial_of(plant), gains).sensitivity
        covered += interval.low < true_sensitivity(plant, gains) < interval.high
        narrow += interval.high < 1.3 * interval.low
    assert covered >= least_hits(seeds, 0.95)
    assert narrow >= least_hits(seeds, 0.95)


def test_optimum_meets_its_limits_and_beats_all_sampled_gains():
    plant, limits = linear(), RobustnessLimits(max_sensitivity=1.6, max_overshoot=0.05)
    centre = np.log(GAINS.as_tuple())
    search = RegionSearch(
        model=exact_model(),
        trial=trial_of(plant),
        limits=limits,
        gains_of=lambda x: Gains(*np.exp(x).tolist()),
        low=centre - 1.5,
        high=centre + 1.5,
    )
    best = search.minimise([centre], scattered=32)
    assert best.feasible
    assert best.prediction.sensitivity <= 1.6 * 1.01
    assert best.prediction.overshoot <= 0.052
    rng = np.random.default_rng(3)
    for x in best.coordinates + rng.uniform(-0.3, 0.3, (200, 4)):
        other = search.predicted(np.clip(x, search.low, search.high))
        if max(limits.excess(other)) <= 0.0:
            assert other.cost > 0.998 * best.prediction.cost


def test_searches_from_all_starts_end_at_one_optimum_where_peaks_of_the_sensitivity_are_level():
    w, v = 2.0 * math.pi * 4.0, 2.0 * math.pi * 27.0
    mode = control.tf([0.1 * v * v], [1.0, 0.01 * v, v * v])
    system = control.tf([w * w], [1.0, 0.4 * w, w * w]) + mode
    poles = np.log([w / SAMPLING_HZ, 0.2, v / SAMPLING_HZ, 0.005])
    sampled = control.c2d(system, 1.0 / SAMPLING_HZ).num[0][0]
    zeros = exchanged(np.append(sampled[-4:], 0.0))
    centre = np.log((0.01, 3.0, 5e-4, 2e-3))
    search = RegionSearch(
        model=LoopModel(tuple(poles.tolist()), tuple(zeros.tolist()), 2),
        trial=trial_of(linear(system=system)),
        limits=RobustnessLimits(max_sensitivity=1.6),
        gains_of=lambda x: Gains(*np.exp(x).tolist()),
        low=centre - 2.0,
        high=centre + 2.0,
    )
    starts = centre + np.random.default_rng(0).uniform(-1.5, 1.5, (6, 4))
    found = [search.minimise([x]) for x in starts]
    assert all(one.feasible for one in found)
    costs = [one.prediction.cost for one in found]
    assert max(costs) < 1.01 * min(costs)


def test_search_finds_the_derivative_that_a_lag_of_many_orders_wants():
    rate, settling_s = 200.0 / 12.0, 12.0
    step = StepProfile(0.0, 1.0, 3.0, 33.0)
    lag = LoopModel((-3.724, -0.066), (0.0, 0.0, 0.0), 63)  # as eight lags of 1 s are fitted
    unit = math.prod(float(section.powers[0]) for section in lag.sections)
    controller = ControllerSettings(rate, 2.0 / rate, -math.inf, math.inf)
    cost = StepCost(settling_s, time_unit="settling_time", move_weight=0.2)
    search = RegionSearch(
        model=lag._replace(numerator=(unit, 0.0, 0.0)),
        trial=StepTrial(controller, cost, 0.0, step.shape(rate), step.samples(rate)),
        limits=RobustnessLimits(),
        gains_of=lambda x: Gains(*np.exp(x).tolist()),
        low=np.log([1e-2, 1e-3, 1e-5, 1e-3]),
        high=np.log([1e2, 1e1, 1e2, 1e1]),
    )

    def start(derivative):
        return np.log([0.3, 0.05, 0.3 * settling_s * derivative, 0.1])

    found = search.minimise([start(1e-5)], apart=[start(DERIVATIVE)])
    everywhere = [search.minimise([start(d)]) for d in np.geomspace(1e-4, 0.3, 8)]
    assert found.feasible
    least = min(one.prediction.cost for one in everywhere if one.feasible)
    assert found.prediction.cost < 1.01 * least
    assert search.minimise([start(1e-5)]).prediction.cost > 1.1 * least


def test_claim_needs_trials_near_the_gains():
    plant = linear()
    trials = around(GAINS, 6, spread=0.1)
    records = [record_of(plant, g, n) for n, g in enumerate(trials)]
    fit = fit_loop(records, SAMPLING_HZ, COST.settling_time_s)
    assert claim(fit, records, trial_of(plant), GAINS).margins is not None
    far = claim(fit, records, trial_of(plant), Gains(4.0, 60.0, 0.1, 0.002))
    assert far.margins is None
    assert "trials near these gains" in far.reason


def test_hum_that_stands_at_rest_is_no_mode_of_the_loop():
    plant, time_s = linear(), np.arange(STEP.samples(SAMPLING_HZ)) / SAMPLING_HZ
    fits = []
    for size_N in (0.0, 0.02):
        hum = size_N * np.sin(2.0 * math.pi * 50.3 * time_s + 1.0)
        noise = NoiseSource(5).draw(0, time_s.size, NOISE_N) + hum
        index = STEP.step_index(SAMPLING_HZ)
        r = plants.simulate(plant, GAINS, noise_N=noise)
        record = LoopRecord.of_step(r.effort_N, r.tension_N, STEP.step_N, index, GAINS)
        fits.append(fit_loop([record], SAMPLING_HZ, COST.settling_time_s))
    still, humming = (robustness(fit.model, GAINS, plant.controller).sensitivity for fit in fits)
    assert [fit.order for fit in fits] == [2, 2]
    assert humming == pytest.approx(still, rel=0.02)
    assert fits[1].noise_std == pytest.approx(NOISE_N, rel=0.1)


@pytest.mark.parametrize(("gain", "kept"), [(1.0, 1), (0.8, 0)])
def test_excitation_that_spoils_the_fit_of_the_steps_is_left_out(gain, kept):
    """A plant that follows an excitation less than a step, as one does beyond its rate limit."""
    steps = [record_of(linear(), g, n) for n, g in enumerate(around(GAINS, 2))]
    excitation = record_of(linear(system=gain * SYSTEM), GAINS, 9)
    fit, fitted = fit_with_excitations(steps, [excitation], SAMPLING_HZ, COST.settling_time_s)
    assert len(fitted) == kept
    assert len(fit.misfits) == 2 + kept
    assert fit.is_white


def test_friction_is_identified_from_one_record():
    reel = plants.reference_reel() + CoulombFriction(torque_Nm=0.02)
    record = record_of(reel, Gains(0.4, 4.0, 0.003, 0.03), noise_N=0.04)
    model = fit_loop([record], reel.controller.sampling_Hz, 0.13).model
    assert model.friction == pytest.approx(0.02 / reel.drum_radius_m, rel=0.05)
    gains = Gains(1.0, 30.0, 0.018, 0.0016)
    Ms = robustness(model, gains, reel.controller).sensitivity
    assert Ms == pytest.approx(true_sensitivity(reel, gains), rel=0.05)


def test_friction_without_a_compiler_is_the_same(monkeypatch):
    efforts = np.random.default_rng(1).standard_normal((2, 200)).cumsum(axis=1)
    masses = np.array([[1.0, -1.8, 0.85], [1.0, -1.2, 0.4]])
    asked = efforts, masses, np.array([0.5, 3.0]), np.ones((2, 2))
    found = friction_motion.friction_force(*asked)
    monkeypatch.setattr(friction_motion, "compiled", lambda _: None)
    np.testing.assert_allclose(found, friction_motion.friction_force(*asked), atol=1e-9)


def test_claim_is_refused_where_friction_in_the_eyelet_leaves_a_misfit():
    reel = plants.reference_reel() + EyeletFriction(0.93)
    gains = Gains(1.0, 30.0, 0.018, 0.0016)
    trials = around(gains, 6, spread=0.1)
    records = [record_of(reel, g, n, 0.04) for n, g in enumerate(trials)]
    fit = fit_loop(records, reel.controller.sampling_Hz, 0.13)
    refused = claim(fit, records, trial_of(reel), gains)
    assert refused.margins is None
    assert "estune explain" in refused.reason


def test_predictions_of_several_loops_are_those_of_each():
    trial = step_trial(linear(), COST)
    exact = exact_model()
    models = [exact, *(exact._replace(numerator=(b, 0.0, 0.0)) for b in (0.01, 5.0))]
    gains = [GAINS, replace(GAINS, P=1.2), replace(GAINS, I=0.0)]
    for several, of in ((models, [GAINS] * 3), ([exact] * 3, gains), (models, gains)):
        found = predictions(several, trial, of, NOISE_N)
        alone = [predict(m, trial, g, NOISE_N) for m, g in zip(several, of, strict=True)]
        for one, other in zip(found, alone, strict=True):
            np.testing.assert_allclose(np.hstack(one), np.hstack(other), rtol=1e-9)
    assert predictions([exact], trial, gains) == predictions([exact] * 3, trial, gains)
    assert predictions(models, trial, [GAINS]) == predictions(models, trial, [GAINS] * 3)


def test_predictions_without_a_compiler_are_the_same(monkeypatch):
    exact, trial = exact_model(), step_trial(linear(), COST)
    loaded = replace(trial, step=trial.step._replace(load=LoadStep(trial.samples // 2, 0.5)))
    models = [exact._replace(coordinates=(*exact.coordinates, x)) for x in (0.1, 0.4)]
    of = [exact_model()._replace(numerator=(b, 0.0, 0.0)) for b in (0.01, 5.0)]
    gains = [GAINS, replace(GAINS, I=0.0), replace(GAINS, D=0.0)]
    asked = [
        (several, one, some)
        for several, some in ((models, [GAINS]), ([exact], gains), (of, gains[:2]))
        for one in (trial, loaded)
    ]
    compiled = [predictions(*one, NOISE_N) for one in asked]
    monkeypatch.setattr(closed_loops, "compiled", lambda _: None)
    for found, one in zip(compiled, asked, strict=True):
        for prediction, same in zip(found, predictions(*one, NOISE_N), strict=True):
            np.testing.assert_allclose(np.hstack(prediction), np.hstack(same), rtol=1e-9)


def test_prediction_errors_without_a_compiler_are_the_same(monkeypatch):
    records = [record_of(linear(), g, n) for n, g in enumerate(around(GAINS, 3))]
    in_motion = [records[0]._replace(at_rest=False)]
    poles = [(-1.0,), (-2.0, -0.5), (-2.0, -0.5, 97.0), (97.0, 98.0, -2.0, -0.5), (97.0, 0.0)]
    noises = (WHITE, NoiseModel(10.0, 0.0), NoiseModel(0.0, 1e-3, (0.5, 0.2)))
    asked = [
        (signals_of(some, 80.0, 80)._replace(hum=hum), np.array(x), dead, noise)
        for some in (records, [*records[1:], *in_motion])
        for hum in (0.0, 0.3)
        for x in poles
        for dead in (0, 9)
        for noise in noises
    ]

    def found():
        for signals, x, dead, noise in asked:
            at = Solution.at(signals, x, dead, noise)
            least = Solution.least(signals, x, (2, 7), noise)
            yield at.residual, at.numerator, at.search_slopes(signals), np.array(least)
        for start in (-1.0,), (-2.0, -0.5), (-2.0, -0.5, -1.0, 0.0):
            yield (np.array(improve(asked[0][0], PoleFit(0.0, np.array(start), 5)).cost),)

    compiled = list(found())
    monkeypatch.setattr(least_squares, "compiled", lambda _: None)
    for one, other in zip(compiled, found(), strict=True):
        for value, same in zip(one, other, strict=True):
            np.testing.assert_allclose(value, same, atol=1e-5 * np.abs(same).max())


@pytest.mark.parametrize(("is_white", "said"), [(True, ""), (False, "leaves 0.1% of the step")])
def test_remaining_improvement_names_what_the_model_leaves_unexplained(is_white, said):
    plant = linear()
    records = [record_of(plant, g, n) for n, g in enumerate(around(GAINS, 2))]
    fit = fit_loop(records, SAMPLING_HZ, COST.settling_time_s)
    fit = fit._replace(is_white=is_white, misfits=(0.001, 0.001))
    space = SearchSpace.around(GAINS)
    base, known = space.coordinates(space.start), HalfWidths.none()
    loop = SearchedLoop(fit, space, trial_of(plant), RobustnessLimits(), None, base, 0.5)
    optimum = loop.search(fit.model, known).minimise([np.array(base)])
    loop = loop._replace(base=tuple(optimum.coordinates.tolist()))
    condition = model_convergence(loop, optimum, known, [], seed=1).condition
    assert said in condition
    assert bool(said) == ("unexplained" in condition)
