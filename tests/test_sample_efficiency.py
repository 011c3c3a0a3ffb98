"""Problems, trials and figures of the comparison of tuners."""

import math

import numpy as np
import pytest

from experiments.sample_efficiency.__main__ import SearchRow, median
from experiments.sample_efficiency.optimum import search
from experiments.sample_efficiency.problems import PROBLEMS
from experiments.sample_efficiency.trials import ETA_MAX_RATIO, Job, Spent, Trials

PROBLEM = PROBLEMS["20 Hz"]


def row(*excess):
    return SearchRow(Job("20 Hz", "safe_bayesian", 1, len(excess)), excess, 0, 0.0)


def test_optimum_is_below_all_other_points():
    best = search(PROBLEM)
    random = np.random.default_rng(2)
    there, space = np.array(best.coordinates), PROBLEM.space
    near = there + random.normal(0.0, 0.1, (2000, 4))
    far = random.uniform(*space.coordinate_bounds, (2000, 4))
    assert PROBLEM.costs(near).min() > best.cost * (1.0 - 1e-9)
    assert PROBLEM.costs(far).min() > best.cost


def test_noise_of_a_trial_depends_on_its_number_only():
    job = Job("20 Hz", "any", 5, 3)
    factors = []
    for away in (0.0, 0.2):
        trials = Trials(job)
        noisy = [trials(np.array(trials.start) + away * k) for k in range(3)]
        assert max(noisy) < trials.limit
        factors.append(np.divide(noisy, trials.costs))
        with pytest.raises(Spent):
            trials(trials.start)
    assert factors[0] == pytest.approx(factors[1], rel=1e-12)
    assert np.ptp(factors[0]) > 0.01


def test_cost_of_an_aborted_trial_is_the_limit():
    trials = Trials(Job("20 Hz", "any", 5, 2))
    wild = np.array(trials.start) + 3.5
    start_cost = PROBLEM.costs(np.array([trials.start]))[0]
    assert trials(wild) == trials.limit == pytest.approx(ETA_MAX_RATIO * start_cost)
    assert trials.unsafe == 1


def test_first_near_and_stays_near_count_trials():
    assert row(0.5, 0.04, 0.06, 0.03, 0.02).first_near == 2
    assert row(0.5, 0.04, 0.06, 0.03, 0.02).stays_near == 4
    assert row(0.5, 0.04, 0.06).stays_near == math.inf
    assert row(0.5, math.inf).first_near == math.inf


def test_median_is_infinite_if_half_never_arrive():
    assert median([3, 7, math.inf, math.inf]) == math.inf
    assert median([3, 4, 7, math.inf]) == 5.5
