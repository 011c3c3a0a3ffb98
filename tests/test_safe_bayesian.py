"""What `newton` promises beyond every tuner: few trials, safe ones, and honesty about the rest."""

import math
from dataclasses import replace

import numpy as np
import pytest

from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.studies.joint.schedule_space import ScheduleSpace
from estune.tuners.acquisition import TrustRegion, newton_step
from estune.tuners.gaussian_process import covariance, fit_gaussian_process
from estune.tuners.local_cubic import fit_local_cubic
from estune.tuners.loop_prior import cost_prior
from estune.tuners.low_discrepancy import normal_points, simplex, unit_ball_points
from estune.tuners.observation import Observation
from estune.tuners.remaining_improvement import sample_quadratics
from estune.tuners.safe_bayesian import SafeBayesianTuner
from estune.tuners.search_space import SearchSpace

SPACE = SearchSpace.around(Gains(0.5, 10.0, 0.005, 0.02))
TUNER = SafeBayesianTuner(SPACE)
START = np.array(SPACE.coordinates(SPACE.start))
BEST = START + np.array([1.1, 1.6, 1.2, -0.9])
AXES = np.linalg.qr(np.random.default_rng(5).normal(size=(4, 4)))[0]
CURVATURE = AXES @ np.diag([0.1, 0.3, 0.8, 1.5]) @ AXES.T
NOISE = 0.03


def excess(point, best=BEST):
    """By how much a bowl in the logarithms lies above its least."""
    z = np.array(SPACE.coordinates(point)) - best
    return math.expm1(0.5 * z @ CURVATURE @ z)


def run(tuner, trials, seed, *, cost=None, told=None, noise=NOISE):
    """The states of a search on a noisy cost; `told` may change what is told of trial k."""
    draws = np.random.default_rng(seed)
    cost = cost or (lambda point, _: 1.0 + excess(point))
    states = [tuner.start()]
    for k in range(trials):
        measured = cost(tuner.ask(states[-1]), k) * (1.0 + noise * draws.normal())
        observation = Observation(measured)
        states.append(tuner.tell(states[-1], told(observation, k) if told else observation))
    return states


def left(tuner, state):
    """Excess of what is recommended."""
    return excess(tuner.recommend(state))


# How it searches.


@pytest.mark.parametrize("seed", range(4))
def test_it_comes_within_five_percent_in_few_trials_and_stays(seed):
    states = run(TUNER, 100, seed)
    assert excess(SPACE.start) > 1.0
    assert max(left(TUNER, state) for state in states[60:]) < 0.05
    assert left(TUNER, states[-1]) < 0.02


def test_trials_come_nearer_as_less_is_left_to_know():
    states = run(TUNER, 200, 0)
    asked = [excess(TUNER.ask(state)) for state in states]
    assert np.mean(asked[150:]) < 0.5 * np.mean(asked[30:60])


def test_proposals_are_rounded_so_that_machines_agree():
    for state in run(TUNER, 40, 1):
        for value in (*TUNER.ask(state), *TUNER.recommend(state)):
            assert value == float(f"{value:.6g}")


# What rigs do.


def test_one_bad_trial_moves_it_little():
    def bad(observation, k):
        return observation._replace(cost=20.0 * observation.cost) if k == 80 else observation

    states = run(TUNER, 100, 3, told=bad)
    assert max(left(TUNER, state) for state in states[81:]) < 0.05


def test_a_trial_too_good_to_be_true_moves_it_little():
    def bad(observation, k):
        return observation._replace(cost=0.2 * observation.cost) if k == 80 else observation

    states = run(TUNER, 120, 3, told=bad)
    assert left(TUNER, states[-1]) < 0.05


def test_a_rig_that_drifts_is_still_tuned():
    states = run(TUNER, 150, 4, cost=lambda p, k: (1.0 + excess(p)) * math.exp(0.003 * k))
    assert max(left(TUNER, state) for state in states[100:]) < 0.05


def test_an_optimum_that_moves_is_followed():
    tuner = SafeBayesianTuner(SPACE, memory=60)

    def moved(k):
        return BEST + 0.004 * k * AXES[:, 2]

    states = run(tuner, 200, 4, cost=lambda p, k: 1.0 + excess(p, moved(k)))
    late = [excess(tuner.recommend(states[k]), moved(k)) for k in range(150, 201)]
    assert np.mean(late) < 0.05


def test_a_dead_zone_does_not_hold_it():
    states = run(TUNER, 120, 5, cost=lambda p, _: 1.0 + max(excess(p), 0.03))
    assert left(TUNER, states[-1]) < 0.06


@pytest.mark.parametrize("seed", [0, 3])
def test_a_plateau_is_not_taken_for_the_optimum(seed):
    def shelf(point, _):
        rise = excess(point)
        slight = 0.8 + 0.05 * math.log1p(max(rise - 0.8, 0.0))  # almost level, as far as the start
        return 1.0 + min(rise, slight) + 0.3 * max(rise - 6.0, 0.0)

    states = run(TUNER, 180, seed, cost=shelf)
    said = [
        s
        for s in states
        if (o := TUNER.convergence(s)) is not None and o.remaining_improvement < 0.02
    ]
    assert said
    assert max(left(TUNER, state) for state in said) < 0.03


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_a_gain_too_small_to_do_anything_is_found_out(seed):
    best = math.exp(BEST[0])
    space = SearchSpace.around(Gains(best / 300.0, 10.0, 0.005, 0.02), bounds={"P": (1e-4, 50.0)})

    def shelf(point, _):  # level in P far below its best, where it costs 60 % more
        share = point[0] / best
        return (1.0 + excess((best, *point[1:]))) * (
            1.0 + 0.6 * (share - 1.0) ** 2 / (1.0 + share**2)
        )

    tuner = SafeBayesianTuner(space)
    states = run(tuner, 150, seed, cost=shelf)
    said = [
        s
        for s in states
        if (o := tuner.convergence(s)) is not None and o.remaining_improvement < 0.02
    ]
    assert said
    assert max(shelf(tuner.recommend(state), 0) for state in said) < 1.03


def test_censored_trials_do_not_hold_it_and_make_it_cautious():
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
    assert left(TUNER, states[-1]) < 0.05


def test_it_keeps_its_distance_from_a_limit():
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
    assert margin(tuner.recommend(free)) < -0.5  # where it goes when it is told of no limit
    assert excess(tuner.recommend(state)) < 0.5 * excess(SPACE.start)


# What it says of itself.


def test_the_noise_it_tells_is_the_noise_there_is():
    for noise in (0.01, 0.03, 0.1):
        told = TUNER.convergence(run(TUNER, 150, 8, noise=noise)[-1]).noise
        assert told == pytest.approx(noise, rel=0.25)


def test_there_is_no_outlook_before_it_has_looked_further_away():
    states = run(TUNER, 150, 9)
    first = next(k for k, state in enumerate(states) if TUNER.convergence(state) is not None)
    asked = np.array([SPACE.coordinates(TUNER.ask(state)) for state in states])
    centres = np.array([SPACE.coordinates(TUNER.recommend(state)) for state in states])
    away = np.linalg.norm(asked - centres, axis=1)
    assert np.max(away[first - 9 : first]) > 0.4
    assert np.max(away[first + 20 :]) < np.max(away[first - 9 : first])
    assert all(TUNER.convergence(state) is not None for state in states[first:])


def test_what_is_left_is_within_what_it_says_may_be_left():
    told = []
    for seed in range(6):
        for state in run(TUNER, 120, 10 + seed)[60::10]:
            outlook = TUNER.convergence(state)
            if outlook is not None:
                told.append(
                    left(TUNER, state) / (1.0 + left(TUNER, state))
                    <= outlook.remaining_improvement
                )
                assert 0.0 <= outlook.expected_improvement <= outlook.remaining_improvement < 1.0
    assert len(told) >= 30
    assert np.mean(told) >= 0.9


def test_a_parameter_without_effect_has_an_interval_to_its_bounds():
    def flat(point, _):
        return 1.0 + excess((*point[:3], math.exp(BEST[3])))

    state = run(TUNER, 150, 11, cost=flat)[-1]
    low, high = TUNER.convergence(state).intervals[3]
    assert high / low > 100.0


@pytest.mark.parametrize("cost", [2.0, -1.0, 0.0, 1e300])
def test_a_cost_that_tells_nothing_leaves_it_finite(cost):
    state = run(TUNER, 60, 12, cost=lambda _p, _k: cost, noise=0.0)[-1]
    assert all(map(math.isfinite, (*TUNER.ask(state), *TUNER.recommend(state))))
    outlook = TUNER.convergence(state)
    if outlook is not None:
        assert all(math.isfinite(end) for pair in outlook.intervals for end in pair)


def test_two_parameters_that_act_as_one_leave_it_finite_and_tuned():
    def as_one(point, _):
        middle = math.sqrt(point[2] * point[3])
        return 1.0 + excess((point[0], point[1], middle, math.exp(BEST[3])))

    state = run(TUNER, 120, 13, cost=as_one)[-1]
    assert as_one(TUNER.recommend(state), 0) < 1.06 * min(
        as_one((*np.exp(BEST[:2]), d, d), 0) for d in np.geomspace(1e-4, 1.0, 200)
    )


def test_with_every_trial_censored_it_stays_by_the_start():
    state = TUNER.start()
    for _ in range(40):
        state = TUNER.tell(state, Observation(math.nan, censored=True))
    assert TUNER.recommend(state) == pytest.approx(SPACE.start, rel=1e-5)
    assert math.dist(SPACE.coordinates(TUNER.ask(state)), START) < 0.05
    assert TUNER.convergence(state) is None
    assert not TUNER.predict(state, tuple(np.exp(BEST))).explored


def test_a_forecast_covers_what_is_measured_near_where_it_has_been():
    state = run(TUNER, 120, 14)[-1]
    inside = 0
    for z in unit_ball_points(4, 200):
        point = tuple(np.exp(BEST + 0.2 * z).tolist())
        forecast = TUNER.predict(state, point)
        assert forecast.explored
        inside += forecast.low <= 1.0 + excess(point) <= forecast.high
    assert inside >= 160


def test_a_margin_that_is_no_number_is_refused():
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
def test_a_setting_out_of_its_range_is_refused_by_name(setting, value):
    with pytest.raises(InvalidInput, match=setting):
        SafeBayesianTuner(**{"space": SPACE, setting: value})


# Its parts.


def test_the_surface_is_the_posterior_of_its_prior():
    draws = np.random.default_rng(15)
    points, asked, values = (
        draws.normal(size=(8, 3)),
        draws.normal(size=(5, 3)),
        draws.normal(size=8),
    )

    known = cost_prior((((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)),))

    def k(a, b):  # the covariance written once more, point by point
        slopes = (a @ known.slope) @ (b @ known.slope)
        bowl = ((a @ known.bowl) @ (b @ known.bowl)) ** 2
        apart = np.sum(((a - b) @ known.rest) ** 2)
        return 4.0 + slopes + bowl + known.rest_size**2 * math.exp(-0.5 * apart)

    def K(left, right):
        return np.array([[k(a, b) for b in right] for a in left])

    def m(x):
        return np.array([0.5 * row @ known.bend @ row for row in x])

    gain = np.linalg.solve(K(points, points) + 0.01 * np.eye(8), K(points, asked)).T
    mean, spread = fit_gaussian_process(points, values[:, None], 0.1, known).expected(asked)
    assert mean[:, 0] == pytest.approx(m(asked) + gain @ (values - m(points)))
    assert spread**2 == pytest.approx(np.diag(K(asked, asked) - gain @ K(points, asked)))


def test_what_is_known_of_loops_is_the_same_in_either_form_and_of_fewer_parameters():
    gains = Gains(0.5, 10.0, 0.005, 0.02)
    parallel = cost_prior(SearchSpace.around(gains).directions)
    standard = cost_prior(SearchSpace.around(gains, form="standard").directions)
    draws = np.random.default_rng(18)
    a, b = draws.normal(size=(2, 6, 4))  # logarithms of K, Ti, Td and the time constant

    def in_parallel(x):
        return np.stack((x[:, 0], x[:, 0] - x[:, 1], x[:, 0] + x[:, 2], x[:, 3]), axis=1)

    same = covariance(parallel, in_parallel(a), in_parallel(b))
    assert covariance(standard, a, b) == pytest.approx(same)
    few = np.array([[0.3, 0.0, -0.2, 0.0], [0.1, 0.0, 0.4, 0.0]])
    names, start = ("P", "D"), (0.5, 0.005)
    space = SearchSpace(names, start, (0.1, 0.001), (5.0, 0.05), fixed=(("I", 10.0),))
    fewer = covariance(cost_prior(space.directions), few[:, ::2], few[:, ::2])
    assert fewer == pytest.approx(covariance(parallel, few, few))


def test_what_is_known_of_a_schedule_is_what_is_known_at_its_ends():
    gains = Gains(0.5, 10.0, 0.005, 0.02)
    one = cost_prior(SearchSpace.around(gains).directions)
    both = cost_prior(ScheduleSpace.over(gains, (0.5, 1.4)).directions)
    draws = np.random.default_rng(19)
    x, y = draws.normal(size=(2, 5, 4))

    def on_both(x):  # I the same at the short end and the long one
        return x[:, [0, 1, 1, 2, 3]]

    same = covariance(one, x, y)
    assert covariance(both, on_both(x), on_both(y)) == pytest.approx(same)
    ends = np.array([[0.0, 0.4, -0.4, 0.0, 0.0]])
    assert 0.5 * ends @ both.curvature @ ends.T == pytest.approx(0.08 * one.curvature[1, 1])


def test_the_polynomial_finds_a_cubic_and_its_drift():
    draws = np.random.default_rng(16)
    points = 0.5 * draws.normal(size=(300, 2))
    x, y = points.T
    age = np.arange(299.0, -1.0, -1.0) / 100.0
    values = 0.2 + 0.1 * x - 0.3 * y + 0.5 * x * x + 0.2 * x * y + 0.1 * y**3 - 0.03 * age
    fit = fit_local_cubic(
        np.zeros(2), np.eye(2), points, values[:, None], noise=1e-3, known=np.eye(2)
    )
    assert fit.level == pytest.approx(0.2, abs=1e-3)
    assert fit.slope == pytest.approx([0.1, -0.3], abs=2e-3)
    assert fit.curvature == pytest.approx(np.array([[1.0, 0.2], [0.2, 0.0]]), abs=1e-2)


def test_draws_of_bowls_have_their_least_where_the_slope_vanishes():
    draws = np.random.default_rng(17)
    points = 0.4 * draws.normal(size=(200, 2))
    values = 0.5 * np.sum((points - (0.1, -0.2)) ** 2 * (1.0, 2.0), axis=1)
    fit = fit_local_cubic(
        np.zeros(2), np.eye(2), points, values[:, None], noise=1e-4, known=np.eye(2)
    )
    far = np.full(2, 5.0)
    found = sample_quadratics(fit, TrustRegion(np.zeros(2), np.eye(2), 1.0, -far, far, 1.0, 0.0))
    assert np.mean(found.least, axis=0) == pytest.approx([0.1, -0.2], abs=0.02)
    assert np.mean(found.gain) == pytest.approx(0.5 * (0.01 + 2 * 0.04), rel=0.1)


def test_a_step_is_newtons_where_it_is_short_and_of_the_radius_where_not():
    values, axes = np.linalg.eigh(CURVATURE)
    slope = np.array([0.1, -0.2, 0.05, 0.3])
    whole = -np.linalg.solve(CURVATURE, slope)
    assert newton_step(slope, values, axes, 100.0) == pytest.approx(whole)
    short = newton_step(slope, values, axes, 0.1)
    assert np.linalg.norm(short) == pytest.approx(0.1, rel=1e-6)
    # On the sphere the slope of the bowl points outward along the step, or a turn would gain.
    downhill = -(slope + CURVATURE @ short)
    assert downhill / np.linalg.norm(downhill) == pytest.approx(short / 0.1, abs=1e-6)


def test_spread_points_are_even():
    for n in (1, 2, 4, 6):
        corners = simplex(n)
        assert np.linalg.norm(corners, axis=1) == pytest.approx(np.ones(n + 1))
        assert corners.sum(axis=0) == pytest.approx(np.zeros(n), abs=1e-12)
        filled = np.linalg.norm(unit_ball_points(n, 1024), axis=1)
        assert np.mean(filled**n < 0.5) == pytest.approx(0.5, abs=0.02)
        assert unit_ball_points(n, 1024).mean(axis=0) == pytest.approx(np.zeros(n), abs=0.03)
        drawn = normal_points(n, 1024)
        assert drawn.T @ drawn / 1024 == pytest.approx(np.eye(n))
        assert np.mean(np.abs(drawn) < 0.6745) == pytest.approx(0.5, abs=0.02)
