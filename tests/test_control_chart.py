"""Control chart: false alarms against tables, a Markov chain and simulation; its signals."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from estune.core.control_chart import (
    ChartSignal,
    ChartState,
    ControlChart,
    average_run_length,
    limit_for,
)
from estune.errors import InvalidInput
from tests.support_lanes import first_by_day

CHART = ControlChart(smoothing=0.2, false_alarm_checks=200.0)


@pytest.mark.parametrize(
    ("smoothing", "width"),
    [(1.0, 3.090), (0.75, 3.087), (0.5, 3.071), (0.25, 2.998), (0.1, 2.814), (0.05, 2.615)],
)
def test_limits_match_the_published_table_for_run_length_500(smoothing, width):
    # Lucas & Saccucci, Technometrics 32 (1990), in standard deviations of z, to three decimals.
    sigma = math.sqrt(smoothing / (2.0 - smoothing))
    assert limit_for(smoothing, 500.0) == pytest.approx(width * sigma, abs=1.5e-3 * sigma)


@pytest.mark.parametrize("shift", [0.0, 0.5, 1.0, 3.0])
@pytest.mark.parametrize("smoothing", first_by_day(0.2, 0.1, 0.5))
def test_average_run_length_matches_a_markov_chain(smoothing, shift):
    # Brook & Evans, Biometrika 59 (1972): z in cells, an absorbing chain; a second-order rule.
    limit = limit_for(smoothing, 300.0)

    def chain(cells: int) -> float:
        edges = np.linspace(-limit, limit, cells + 1)
        centres = 0.5 * (edges[1:] + edges[:-1])
        below = norm.cdf((edges - (1.0 - smoothing) * centres[:, None]) / smoothing - shift)
        return np.linalg.solve(np.eye(cells) - np.diff(below), np.ones(cells))[cells // 2]

    fine, coarse = chain(603), chain(201)
    expected = fine + (fine - coarse) / 8.0
    assert average_run_length(smoothing, limit, shift) == pytest.approx(expected, rel=1e-4)


def run_lengths(chart: ControlChart, runs: int, baseline: int, drift: float = 0.0) -> np.ndarray:
    """Trials until the alarm, for charts with the given number of baseline repeats."""
    rng, lengths = np.random.default_rng(7), []
    for _ in range(runs):
        state = chart.begin(
            np.exp(rng.normal(0.0, 0.03, baseline)), np.exp(rng.normal(0.5, 0.03, 3))
        )
        sign, length = ChartSignal.STEADY, 0
        while sign not in (ChartSignal.WORSE, ChartSignal.BETTER):
            state, sign = chart.update(state, math.exp(rng.normal(drift, 0.03)))
            length += 1
        lengths.append(length)
    return np.array(lengths)


@pytest.mark.parametrize("baseline", [3, 15])
def test_false_alarm_rate_is_independent_of_the_baseline_length(baseline):
    chart = ControlChart(smoothing=0.2, false_alarm_checks=60.0, scatter_min=1e-6)
    lengths = run_lengths(chart, 400, baseline)
    error = lengths.std() / math.sqrt(lengths.size)
    # Repeated trials and those excluded from the baseline make alarms slightly rarer.
    assert 60.0 - 3.0 * error < lengths.mean() < 1.25 * 60.0 + 3.0 * error


def test_drift_of_three_deviations_is_detected_within_a_few_trials():
    chart = ControlChart(smoothing=0.2, false_alarm_checks=1000.0, scatter_min=1e-6)
    lengths = run_lengths(chart, 200, baseline=15, drift=0.09)
    assert np.median(lengths) <= 6
    assert lengths.max() < 60


def begin_chart() -> ChartState:
    return CHART.begin([1.0, 1.02, 0.98], [2.0, 2.05, 1.96])


def test_single_outlier_is_repeated_and_ignored():
    state, sign = CHART.update(begin_chart(), 3.0)
    assert sign is ChartSignal.SUSPECT
    after, sign = CHART.update(state, 1.01)
    assert sign is ChartSignal.OUTLIER
    assert after == CHART.update(begin_chart(), 1.01)[0]


@pytest.mark.parametrize(
    ("cost", "sign"),
    [(3.0, ChartSignal.WORSE), (math.inf, ChartSignal.WORSE), (0.3, ChartSignal.BETTER)],
)
def test_chart_signals_a_change_after_two_consecutive_outliers(cost, sign):
    state, _ = CHART.update(begin_chart(), cost)
    assert CHART.update(state, cost)[1] is sign


def test_outlier_of_opposite_sign_is_suspect_again():
    state, _ = CHART.update(begin_chart(), 3.0)
    assert CHART.update(state, 0.3)[1] is ChartSignal.SUSPECT


def test_drift_below_the_minimum_deviation_is_ignored():
    quiet = ControlChart(scatter_min=0.05)
    state = quiet.begin([1.0, 1.0, 1.0])
    for _ in range(200):
        state, sign = quiet.update(state, 1.01)
        assert sign is ChartSignal.STEADY


def test_state_survives_storage_as_a_list():
    state, _ = CHART.update(begin_chart(), 1.03)
    assert ChartState(*list(state)) == state


@pytest.mark.parametrize(
    "bad",
    [
        lambda: ControlChart(smoothing=0.0),
        lambda: ControlChart(false_alarm_checks=math.nan),
        lambda: ControlChart(scatter_min=-1.0),
        lambda: CHART.begin([1.0]),
        lambda: CHART.begin([], [1.0, 2.0]),
        lambda: CHART.begin([1.0, math.nan]),
        lambda: CHART.update(begin_chart(), 0.0),
        lambda: CHART.update(begin_chart(), math.nan),
    ],
)
def test_invalid_chart_inputs_are_refused(bad):
    with pytest.raises(InvalidInput):
        bad()
