"""Safe Bayesian optimisation: convergence, safety, and its convergence estimate."""

import math
from dataclasses import replace

import numpy as np
import pytest

from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.tuners.acquisition import TrustRegion, minimise_confidence_bound
from estune.tuners.low_discrepancy import unit_ball_points
from estune.tuners.observation import Observation
from estune.tuners.safe_bayesian import SafeBayesianTuner
from estune.tuners.search_space import SearchSpace
from tests.support_lanes import first_by_day

SPACE = SearchSpace.around(Gains(0.5, 10.0, 0.005, 0.02))
TUNER = SafeBayesianTuner(SPACE)
START = np.array(SPACE.coordinates(SPACE.start))
BEST = START + np.array([1.1, 1.6, 1.2, -0.9])
AXES = np.linalg.qr(np.random.default_rng(5).normal(size=(4, 4)))[0]
CURVATURE = AXES @ np.diag([0.1, 0.3, 0.8, 1.5]) @ AXES.T
NOISE = 0.03


def excess(point, best=BEST):
    """Relative rise of a quadratic in the logarithms over its minimum."""
    z = np.array(SPACE.coordinates(point)) - best
    return math.expm1(0.5 * z @ CURVATURE @ z)


def run(tuner, trials, seed, *, cost=None, corrupt=None, noise=NOISE):
    """States of a search on a noisy cost; `corrupt` may change the observation of trial k."""
    draws = np.random.default_rng(seed)
    cost = cost or (lambda point, _: 1.0 + excess(point))
    states = [tuner.start()]
    for k in range(trials):
        measured = cost(tuner.ask(states[-1]), k) * (1.0 + noise * draws.normal())
        observation = Observation(measured)
        states.append(tuner.tell(states[-1], corrupt(observation, k) if corrupt else observation))
    return states


def remaining(tuner, state):
    """Excess of the recommended point."""
    return excess(tuner.recommend(state))


def converged_states(tuner, states):
    """States that report a remaining improvement under 2 %."""
    estimates = [(tuner.convergence(state), state) for state in states]
    return [state for e, state in estimates if e is not None and e.remaining_improvement < 0.02]


# Search.


@pytest.mark.parametrize("seed", first_by_day(*range(4)))
def test_search_stays_within_five_percent_after_sixty_trials(seed):
    states = run(TUNER, 100, seed)
    assert excess(SPACE.start) > 1.0
    assert max(remaining(TUNER, state) for state in states[60:]) < 0.05
    assert remaining(TUNER, states[-1]) < 0.02


def test_trials_approach_the_optimum_as_uncertainty_falls():
    states = run(TUNER, 200, 0)
    excesses = [excess(TUNER.ask(state)) for state in states]
    assert np.mean(excesses[150:]) < 0.5 * np.mean(excesses[30:60])


def test_proposals_are_rounded_to_six_digits():
    for state in run(TUNER, 40, 1):
        for value in (*TUNER.ask(state), *TUNER.recommend(state)):
            assert value == float(f"{value:.6g}")


# Disturbances.


def test_one_outlier_of_high_cost_moves_the_centre_little():
    def outlier(observation, k):
        return observation._replace(cost=20.0 * observation.cost) if k == 80 else observation

    states = run(TUNER, 100, 3, corrupt=outlier)
    assert max(remaining(TUNER, state) for state in states[81:]) < 0.05


def test_one_outlier_of_low_cost_moves_the_centre_little():
    def outlier(observation, k):
        return observation._replace(cost=0.2 * observation.cost) if k == 80 else observation

    states = run(TUNER, 120, 3, corrupt=outlier)
    assert remaining(TUNER, states[-1]) < 0.05


def test_search_converges_on_a_drifting_rig():
    states = run(TUNER, 150, 4, cost=lambda p, k: (1.0 + excess(p)) * math.exp(0.003 * k))
    assert max(remaining(TUNER, state) for state in states[100:]) < 0.05


def test_search_follows_a_moving_optimum():
    tuner = SafeBayesianTuner(SPACE, memory=60)

    def moved(k):
        return BEST + 0.004 * k * AXES[:, 2]

    states = run(tuner, 200, 4, cost=lambda p, k: 1.0 + excess(p, moved(k)))
    late = [excess(tuner.recommend(states[k]), moved(k)) for k in range(150, 201)]
    assert np.mean(late) < 0.05


def test_search_crosses_a_dead_zone_of_the_cost():
    states = run(TUNER, 120, 5, cost=lambda p, _: 1.0 + max(excess(p), 0.03))
    assert remaining(TUNER, states[-1]) < 0.06


@pytest.mark.parametrize("seed", first_by_day(0, 3))
def test_convergence_is_not_reported_on_a_plateau(seed):
    def shelf(point, _):
        rise = excess(point)
        slight = 0.8 + 0.05 * math.log1p(max(rise - 0.8, 0.0))  # nearly flat up to the start
        return 1.0 + min(rise, slight) + 0.3 * max(rise - 6.0, 0.0)

    states = run(TUNER, 180, seed, cost=shelf)
    settled = converged_states(TUNER, states)
    assert settled
    assert max(remaining(TUNER, state) for state in settled) < 0.03


@pytest.mark.parametrize("seed", first_by_day(0, 1, 3))
def test_scan_finds_the_effect_of_a_far_too_small_gain(seed):
    best = math.exp(BEST[0])
    space = SearchSpace.around(Gains(best / 300.0, 10.0, 0.005, 0.02), bounds={"P": (1e-4, 50.0)})

    def shelf(point, _):  # flat in P far below the optimum, at a 60 % higher cost
        share = point[0] / best
        return (1.0 + excess((best, *point[1:]))) * (
            1.0 + 0.6 * (share - 1.0) ** 2 / (1.0 + share**2)
        )

    tuner = SafeBayesianTuner(space)
    states = run(tuner, 150, seed, cost=shelf)
    settled = converged_states(tuner, states)
    assert settled
    assert max(shelf(tuner.recommend(state), 0) for state in settled) < 1.03


def test_censored_trials_shrink_the_steps_and_search_converges():
    states, draws, unsafe = [TUNER.start()], np.random.default_rng(6), 0
    for _ in range(100):
        point = TUNER.ask(states[-1])
        censored = math.log(point[0]) > BEST[0] + 0.15  # a cliff beside the optimum
        cost = (1.0 + excess(point)) * (1.0 + NOISE * draws.normal())
        states.append(
            TUNER.tell(states[-1], Observation(math.nan if censored else cost, censored))
        )
        if censored:
            unsafe += 1
            assert states[-1].step_scale < states[-2].step_scale
    assert 1 <= unsafe <= 15
    assert remaining(TUNER, states[-1]) < 0.05


def test_search_keeps_the_constraint_margin():
    # The margin falls towards the optimum: it is 0.1 half way there.
    way = (BEST - START) / np.linalg.norm(BEST - START) ** 2

    def margin(point):
        return 1.0 - 1.8 * float(way @ (np.array(SPACE.coordinates(point)) - START))

    tuner, draws = TUNER, np.random.default_rng(7)
    state, margins = tuner.start(), []
    for _ in range(100):
        point = tuner.ask(state)
        margins.append(margin(point))
        cost = (1.0 + excess(point)) * (1.0 + NOISE * draws.normal())
        state = tuner.tell(state, Observation(cost, margin=margin(point)))
    assert min(margins) > 0.0
    assert margin(tuner.recommend(state)) > 0.05
    free = run(tuner, 100, 7)[-1]
    assert margin(tuner.recommend(free)) < -0.5  # without a limit
    assert excess(tuner.recommend(state)) < 0.5 * excess(SPACE.start)


# Convergence estimate and prediction.


def test_estimated_noise_is_the_true_noise():
    for noise in (0.01, 0.03, 0.1):
        estimated = TUNER.convergence(run(TUNER, 150, 8, noise=noise)[-1]).noise
        assert estimated == pytest.approx(noise, rel=0.25)


def test_search_that_may_not_end_has_much_improvement_left():
    states = run(TUNER, 60, 3)
    waiting = [state for state in states if not TUNER.may_end(state, 0.02)]
    left = [e.remaining_improvement for s in waiting if (e := TUNER.convergence(s)) is not None]
    assert left
    assert min(left) >= 0.25
    assert any(TUNER.may_end(state, 0.02) for state in states)


def test_convergence_estimate_follows_the_axis_probe():
    states = run(TUNER, 150, 9)
    first = next(k for k, state in enumerate(states) if TUNER.convergence(state) is not None)
    proposals = np.array([SPACE.coordinates(TUNER.ask(state)) for state in states])
    centres = np.array([SPACE.coordinates(TUNER.recommend(state)) for state in states])
    away = np.linalg.norm(proposals - centres, axis=1)
    assert np.max(away[first - 9 : first]) > 0.4
    assert np.max(away[first + 20 :]) < np.max(away[first - 9 : first])
    assert all(TUNER.convergence(state) is not None for state in states[first:])


def test_remaining_improvement_bound_covers_the_true_value():
    covered = []
    for seed in range(6):
        for state in run(TUNER, 120, 10 + seed)[60::10]:
            estimate = TUNER.convergence(state)
            if estimate is not None:
                true = remaining(TUNER, state) / (1.0 + remaining(TUNER, state))
                covered.append(true <= estimate.remaining_improvement)
                assert 0.0 <= estimate.expected_improvement <= estimate.remaining_improvement < 1.0
    assert len(covered) >= 30
    assert np.mean(covered) >= 0.9


def test_interval_of_a_parameter_without_effect_reaches_its_bounds():
    def flat(point, _):
        return 1.0 + excess((*point[:3], math.exp(BEST[3])))

    state = run(TUNER, 150, 11, cost=flat)[-1]
    low, high = TUNER.convergence(state).intervals[3]
    assert high / low > 100.0


@pytest.mark.parametrize("cost", [2.0, -1.0, 0.0, 1e300])
def test_uninformative_cost_keeps_proposals_finite(cost):
    state = run(TUNER, 60, 12, cost=lambda _p, _k: cost, noise=0.0)[-1]
    assert all(map(math.isfinite, (*TUNER.ask(state), *TUNER.recommend(state))))
    estimate = TUNER.convergence(state)
    if estimate is not None:
        assert all(math.isfinite(end) for pair in estimate.intervals for end in pair)


def test_tuner_converges_with_two_equivalent_parameters():
    def as_one(point, _):
        middle = math.sqrt(point[2] * point[3])
        return 1.0 + excess((point[0], point[1], middle, math.exp(BEST[3])))

    state = run(TUNER, 120, 13, cost=as_one)[-1]
    assert as_one(TUNER.recommend(state), 0) < 1.06 * min(
        as_one((*np.exp(BEST[:2]), d, d), 0) for d in np.geomspace(1e-4, 1.0, 200)
    )


def test_search_stays_at_the_start_if_every_trial_is_censored():
    state = TUNER.start()
    for _ in range(40):
        state = TUNER.tell(state, Observation(math.nan, censored=True))
    assert TUNER.recommend(state) == pytest.approx(SPACE.start, rel=1e-5)
    assert math.dist(SPACE.coordinates(TUNER.ask(state)), START) < 0.05
    assert TUNER.convergence(state) is None
    assert not TUNER.predict(state, tuple(np.exp(BEST))).explored


def test_prediction_interval_covers_the_cost_near_the_centre():
    state = run(TUNER, 120, 14)[-1]
    inside = 0
    for z in unit_ball_points(4, 200):
        point = tuple(np.exp(BEST + 0.2 * z).tolist())
        prediction = TUNER.predict(state, point)
        assert prediction.explored
        inside += prediction.low <= 1.0 + excess(point) <= prediction.high
    assert inside >= 160


def test_nan_margin_is_refused():
    with pytest.raises(InvalidInput, match="margin"):
        TUNER.tell(TUNER.start(), Observation(1.0, margin=math.nan))


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("safe_ratio", 0.0),
        ("constraint_margin_min", 1.0),
        ("memory", 3),
        ("local_radius", math.nan),
        ("space", replace(SPACE, scale="linear")),
    ],
)
def test_setting_out_of_range_is_refused_by_name(setting, value):
    with pytest.raises(InvalidInput, match=setting):
        SafeBayesianTuner(**{"space": SPACE, setting: value})


# Models and parts.


def test_search_leaves_points_that_all_break_a_limit():
    class Rising:
        """A margin that rises with the first coordinate, known best at the origin."""

        def predict(self, points):
            mean = np.stack((np.zeros(len(points)), points[:, 0] - 5.0), axis=1)
            return mean, 0.5 * np.linalg.norm(points, axis=1)

    far = np.full(2, 9.0)
    region = TrustRegion(np.zeros(2), np.eye(2), 1.0, -far, far, 10.0, 0.1)
    chosen = minimise_confidence_bound(Rising(), region, np.zeros((1, 2)), 2.0, 0)
    assert chosen[0] > 0.5
