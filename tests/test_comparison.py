"""Comparison of gains by their costs: against scipy, in coverage, and under drift."""

import math
from itertools import pairwise

import numpy as np
import pytest
from scipy import stats
from scipy.stats import ttest_ind

from estune.core.comparison import (
    Change,
    InterleavedRepeats,
    compare_costs,
    interval_factor,
    repeatability,
)
from estune.core.gains import Gains
from estune.errors import InvalidInput

A, B = Gains(1.0, 10.0, 0.01, 0.01), Gains(2.0, 20.0, 0.02, 0.02)


def test_interval_of_a_change_is_that_of_welchs_test():
    before, after = [1.0, 1.1, 0.95, 1.02], [0.8, 0.7, 0.9]
    expected = ttest_ind(np.log(after), np.log(before), equal_var=False).confidence_interval(0.9)
    change = compare_costs(before, after, 0.9)
    assert (change.low, change.high) == pytest.approx(np.expm1(expected))
    assert change.estimate == pytest.approx(
        np.exp(np.mean(np.log(after)) - np.mean(np.log(before))) - 1
    )


def test_intervals_have_their_nominal_coverage():
    rng = np.random.default_rng(3)
    trials = 1000
    covered = 0
    for _ in range(trials):
        before, after = np.exp(rng.normal(0.0, 0.05, 4)), np.exp(rng.normal(-0.1, 0.02, 4))
        change = compare_costs(before, after, 0.9)
        covered += change.low < math.expm1(-0.1) < change.high
    # Welch's approximation errs by about 1 %; four standard errors of the count are added.
    assert covered / trials == pytest.approx(0.9, abs=0.015 + 4 * math.sqrt(0.09 / trials))


OTHERS = [
    pytest.param(improvement, noise, marks=pytest.mark.nightly)
    for improvement in (0.05, 0.1, 0.2, 0.3, 0.5, 0.7)
    for noise in (0.01, 0.02, 0.03)
    if (improvement, noise) != (0.2, 0.02)
]
"""Improvements, and noise of the log costs, beside the worst pair."""


@pytest.mark.parametrize(
    "known", [pytest.param(False, marks=pytest.mark.slow), True], ids=["none", "one"]
)
@pytest.mark.parametrize(("improvement", "noise"), [(0.2, 0.02), *OTHERS])
def test_intervals_of_repeats_that_end_once_narrow_hold_the_true_change(improvement, noise, known):
    rng, covered, runs = np.random.default_rng(7), 0, 500
    for _ in range(runs):
        repeats = InterleavedRepeats.new((A, B), 2, np.exp(rng.normal(0.0, noise, int(known))))
        while (turn := repeats.next_index) is not None:
            repeats = repeats.with_cost(
                math.exp(rng.normal(turn * math.log1p(-improvement), noise))
            )
            repeats = repeats.until(_is_narrow, 2, 10)
        change = repeats.change()
        covered += change.low < -improvement < change.high
    # Three standard errors of the count are allowed below the coverage that is stated.
    assert covered / runs >= 0.945 - 3 * math.sqrt(0.05 / runs)


def _is_narrow(change):
    return change.high - change.low <= 0.2 * abs(change.estimate)


def test_repeats_are_over_once_narrow_with_one_more_of_the_first_gains():
    repeats, order = InterleavedRepeats.new((A, B), 2, [1.0]), []
    for cost in (0.5, 0.6, 1.01):
        order.append(repeats.next_index)
        repeats = repeats.with_cost(cost).until(lambda _: False, 2, 10)
    assert order == [1, 1, 0]
    assert (repeats.next_index, repeats.missing) == (0, 2)
    over = repeats.with_cost(0.99).until(lambda _: True, 2, 10)
    assert (over.next_index, over.missing) == (None, 0)
    assert tuple(map(len, over.costs)) == (3, 2)


@pytest.mark.parametrize(
    "bad",
    [
        ([1.0], [1.0, 2.0]),
        ([1.0, 2.0], [1.0]),
        ([1.0, 0.0], [1.0, 2.0]),
        ([1.0, 1.0], [1.0, math.inf]),
    ],
)
def test_too_few_or_invalid_costs_are_refused(bad):
    with pytest.raises(InvalidInput):
        compare_costs(*bad)


@pytest.mark.parametrize("confidence", [0.0, 1.0, 1.5, -0.5, math.nan])
def test_confidence_that_is_no_probability_is_refused(confidence):
    with pytest.raises(InvalidInput, match="between 0 and 1"):
        compare_costs([1.0, 1.0], [1.1, 1.1], confidence)
    with pytest.raises(InvalidInput, match="between 0 and 1"):
        interval_factor(3.0, confidence)


def test_interval_of_repeats_has_a_share_of_six_tenths_of_the_error_that_its_confidence_allows():
    repeats = InterleavedRepeats((A, B), 3, ((1.0, 1.1, 0.95), (0.8, 0.7, 0.9)))
    for confidence in (0.95, 0.8):
        expected = compare_costs(*repeats.costs, 1.0 - 0.6 * (1.0 - confidence))
        found = repeats.change(confidence)
        assert (found.low, found.high, found.confidence) == (
            expected.low,
            expected.high,
            confidence,
        )
    assert repeats.change() == repeats.change(0.95)
    assert interval_factor(4.0) == pytest.approx(stats.t.ppf(0.975, 4.0))


def test_change_of_costs_without_any_scatter_is_known_exactly():
    assert compare_costs([2.0, 2.0], [1.0, 1.0]) == Change(-0.5, -0.5, -0.5, 0.95)


@pytest.mark.parametrize(("high", "is_decrease"), [(-0.01, True), (0.0, False), (0.01, False)])
def test_change_is_a_decrease_where_all_of_its_interval_is_one(high, is_decrease):
    assert Change(-0.1, -0.2, high, 0.95).is_decrease is is_decrease


def test_repeatability_is_pooled_within_gains():
    groups = [np.exp([1.0, 3.0]), np.exp([11.0, 13.0]), (5.0,), (7.0, math.inf)]
    assert repeatability(groups) == pytest.approx(math.sqrt(2.0))
    assert repeatability([(math.inf,), *groups]) == repeatability(groups)
    assert math.isnan(repeatability([(1.0,)]))


def test_interleaved_repeats_cancel_an_even_drift():
    repeats, cost, order = InterleavedRepeats.new((A, B), 6), 1.0, []
    while (turn := repeats.next_index) is not None:
        order.append(turn)
        repeats, cost = repeats.with_cost(cost), cost * 1.05
    assert order == [0, 1, 1, 0] * 3
    assert repeats.missing == 0
    assert compare_costs(*repeats.costs).estimate == pytest.approx(0.0, abs=1e-12)


def test_unsafe_gains_are_not_repeated():
    repeats = InterleavedRepeats.new((A, B), 3).with_cost(1.0).with_cost(math.inf)
    assert repeats.next_index is None
    assert repeats.best == 0
    assert repeats.safe == (0,)
    assert repeats.until(lambda _: True, 1, 9) == repeats  # there is no change of the cost
    assert repeats.missing == 0
    assert InterleavedRepeats.new((A, B), 3).with_cost(math.inf).best == 1
    both = InterleavedRepeats.new((A, B), 3)._replace(costs=((math.inf,), (math.inf,)))
    assert both.best is None


def test_best_gains_have_the_least_mean_and_those_out_of_turn_come_next():
    repeats = InterleavedRepeats((A, B), 2, ((1.0, 1.0), (0.5, 1.2)))
    assert repeats.best == 1
    assert repeats._replace(costs=((1.0,), (1.1,))).best == 0
    assert repeats.next_index is None
    ahead = repeats._replace(ahead=1)
    assert ahead.next_index == 1
    assert ahead.with_cost(0.7) == repeats._replace(costs=((1.0, 1.0), (0.5, 1.2, 0.7)))


def test_repeats_are_over_at_their_greatest_number_however_wide_the_interval():
    repeats = InterleavedRepeats((A, B), 2, ((1.0, 1.1), (0.5, 1.2)))
    assert repeats.until(lambda _: False, 2, 2).next_index is None
    assert repeats.until(lambda _: False, 2, 3).next_index is not None


@pytest.mark.parametrize(("known", "most"), [(0, 4), (1, 3), (5, 2)])
def test_missing_repeats_count_down_to_zero_whatever_is_known_of_the_first_gains(known, most):
    repeats, missing = InterleavedRepeats.new((A, B), 2, [1.0] * known), []
    while repeats.next_index is not None:
        missing.append(repeats.missing)
        repeats = repeats.with_cost(1.0)
    assert all(after == before - 1 for before, after in pairwise([*missing, repeats.missing]))
    assert missing[0] == most
