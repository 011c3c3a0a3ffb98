"""Intervals of predictions of an identified loop: ends of drawn models, and what remains."""

import math

import control
import numpy as np
import pytest

import estune.loop_model.intervals as module
from estune.core.gains import Gains
from estune.loop_model.drawn_models import INFLATION
from estune.loop_model.fitting import fit_loop
from estune.loop_model.intervals import (
    margins_by_records,
    peak_sensitivity,
    predict_with_intervals,
    relative_cost,
    remaining_error,
    setpoint_deviation,
)
from estune.loop_model.margins import robustness
from estune.loop_model.prediction import predict
from tests.test_loop_model import (
    COST,
    GAINS,
    SAMPLING_HZ,
    SYSTEM,
    exact_model,
    linear,
    record_of,
    trial_of,
)

UNSTABLE = Gains(3.0, 60.0, 0.0, 0.02)


def fitted(*numbers, noise_N=0.004):
    """The records of some trials of the plant, and their fit."""
    plant = linear()
    records = [record_of(plant, GAINS, number, noise_N) for number in numbers]
    return records, fit_loop(records, SAMPLING_HZ, COST.settling_time_s)


@pytest.fixture(scope="module")
def two():
    return fitted(4, 5)


def changed(share):
    """The true plant with other coefficients."""
    model = exact_model()
    return model._replace(numerator=tuple((1.0 + share) * np.array(model.numerator)))


def quantities(model, fit):
    """ln cost, overshoot, ln Ms and phase margin."""
    at = predict(model, trial_of(linear()), GAINS, fit.noise_std)
    return [math.log(at.cost), at.overshoot, math.log(at.sensitivity), at.phase_margin_deg]


@pytest.mark.parametrize("count", [12, 120])
def test_interval_leaves_out_a_fortieth_of_the_draws_at_either_end(two, count):
    """By the wider of two sets of draws, and Ms by what no record takes off besides."""
    _, fit = two
    rng, tail = np.random.default_rng(count), max(round(count / 40), 1)
    draws = [tuple(changed(s) for s in rng.normal(0.05, w, count)) for w in (0.05, 0.15)]
    told = predict_with_intervals(fit, trial_of(linear()), GAINS, draws, model_error=0.07)
    sets = [np.sort([quantities(model, fit) for model in models], axis=0) for models in draws]
    centre = np.array(quantities(fit.model, fit))
    low = np.minimum(np.min([one[tail - 1] for one in sets], axis=0), centre)
    high = np.maximum(np.max([one[-tail] for one in sets], axis=0), centre)
    assert told.cost == pytest.approx(np.exp([centre[0], low[0], high[0]]))
    assert told.overshoot == pytest.approx([centre[1], max(low[1], 0.0), high[1]])
    assert told.phase_margin_deg == pytest.approx([centre[3], low[3], high[3]])
    ends = [centre[2] + s * math.hypot(x[2] - centre[2], 0.07) for s, x in ((-1, low), (1, high))]
    assert told.sensitivity == pytest.approx(np.exp([centre[2], *ends]))


def test_interval_of_a_relative_cost_holds_its_value_whichever_way_all_draws_lie(two):
    _, fit = two
    more, trial = Gains(1.2 * GAINS.P, *GAINS.as_tuple()[1:]), trial_of(linear())

    def ratio(model):
        return predict(model, trial, GAINS).cost / predict(model, trial, more).cost

    centre = ratio(fit.model)
    sides = [(m := changed(share), ratio(m)) for share in (-0.5, 0.2)]
    assert min(r for _, r in sides) < centre < max(r for _, r in sides)
    for model, other in sides:
        told = relative_cost(fit, trial, GAINS, more, [(model,) * 9])
        ends = min(centre, other), max(centre, other)
        assert told == pytest.approx((centre, *ends), rel=1e-3)


def test_unstable_draws_leave_no_upper_end(two):
    _, fit = two
    draws = [(fit.model,) * 50 + (changed(40.0),) * 2]
    told = predict_with_intervals(fit, trial_of(linear()), GAINS, draws)
    assert told.sensitivity.high == told.cost.high == math.inf
    assert told.phase_margin_deg[1:] == (-math.inf, math.inf)
    of_unstable = predict_with_intervals(fit, trial_of(linear()), UNSTABLE).sensitivity
    assert (of_unstable.value, of_unstable.high) == (math.inf, math.inf)
    assert not math.isnan(of_unstable.low)


def test_error_that_remains_is_that_of_the_law_or_of_trials_near_some_gains(two):
    _, fit = two
    fit = fit._replace(near_error=0.0)
    rubbing = fit._replace(model=fit.model._replace(friction=0.2))
    for one, of_law in ((fit, 0.0), (rubbing, 0.015), (rubbing._replace(near_error=0.03), 0.03)):
        assert remaining_error(one, 0.01) == pytest.approx(math.hypot(0.01, of_law))
        assert remaining_error(one) == pytest.approx(math.hypot(0.005, of_law))


def test_records_are_asked_where_draws_are_unstable_and_there_is_no_friction(two, monkeypatch):
    records, fit = two
    asked = []
    monkeypatch.setattr(module, "allowed_draws", lambda *of: asked.append(of) or of[2])
    trial = trial_of(linear())
    assert margins_by_records(fit, records, trial, GAINS) == predict_with_intervals(
        fit, trial, GAINS
    )
    assert not asked
    monkeypatch.setattr(module, "plain_draws", lambda _: ((changed(40.0),) * 9,))
    margins_by_records(fit, records, trial, GAINS)
    assert len(asked) == 1
    rubbing = fit._replace(model=fit.model._replace(friction=0.1))
    margins_by_records(rubbing, records, trial, GAINS)
    assert len(asked) == 1


def test_deviation_by_the_setpoint_falls_with_records_and_grows_with_the_noise(two):
    records, fit = two
    c = linear().controller
    one = setpoint_deviation(fit, records[:1], GAINS, c)
    assert 0.0 < one < math.inf
    assert setpoint_deviation(fit, records[:1] * 4, GAINS, c) == pytest.approx(one / 2.0, rel=1e-3)
    louder = fit._replace(residual_std=3.0 * fit.residual_std)
    assert setpoint_deviation(louder, records[:1], GAINS, c) == pytest.approx(3.0 * one, rel=1e-3)
    still = records[0]._replace(setpoint=np.zeros(records[0].samples))
    assert setpoint_deviation(fit, [records[0], still], GAINS, c) == pytest.approx(one, rel=1e-6)
    unknown = records[0]._replace(gains=None)
    assert setpoint_deviation(fit, [records[0], unknown], GAINS, c) == pytest.approx(one, rel=1e-6)
    for nothing in ([], [still], [unknown], [records[0]._replace(gains=UNSTABLE)]):
        assert setpoint_deviation(fit, nothing, GAINS, c) == math.inf
    held = records[0]._replace(gains=UNSTABLE, limits=(-20.0, 20.0))  # by the limits alone
    assert setpoint_deviation(fit, [held], GAINS, c) < math.inf
    moved = records[0]._replace(setpoint=records[0].setpoint + 7.0)
    assert setpoint_deviation(fit, [moved], GAINS, c) == pytest.approx(one, rel=1e-6)


def test_deviation_by_the_setpoint_is_that_of_fits_of_many_records():
    """Of steps far above the noise, which excites the loop, too."""
    fits = [fitted(number, noise_N=0.002) for number in range(16)]
    c = linear().controller
    logs = [math.log(robustness(fit.model, GAINS, c)[0]) for _, fit in fits]
    told = [setpoint_deviation(fit, records, GAINS, c) / INFLATION for records, fit in fits]
    assert np.median(told) == pytest.approx(np.std(logs), rel=0.4)


def test_deviations_of_what_records_do_not_know_are_large_numbers_and_of_what_they_do_exact():
    """One of the directions is known by a share of the other, in deviations."""
    turn = np.array([[1.0, 1.0], [-1.0, 1.0]]) / math.sqrt(2.0)
    for share in (1.0, 1e-3, 4e-7, 0.0):  # below 3e-7 it is rounding
        slopes = np.diag([1.0, share]) @ turn
        steps = module._deviations(slopes, 0.1)
        assert np.isfinite(steps).all()
        lengths = np.sort(np.linalg.norm(slopes @ steps, axis=0))
        assert lengths[-1] == pytest.approx(0.1, rel=1e-2)
        if share:
            assert lengths[0] == pytest.approx(0.1, rel=1e-2)
        else:
            assert np.linalg.norm(steps, axis=0).max() > 1e5
    assert module._deviations(np.zeros((2, 2)), 0.1) is None


def test_peak_of_an_unstable_loop_is_the_largest_of_its_sensitivity():
    c = linear().controller
    assert peak_sensitivity(exact_model(), GAINS, c) == robustness(exact_model(), GAINS, c)[0]
    z = control.tf([1.0, 0.0], [1.0], 1.0 / SAMPLING_HZ)
    h, lag = 1.0 / SAMPLING_HZ, c.derivative_filter_s
    integral = UNSTABLE.I * h / (z - 1.0)
    law = UNSTABLE.P + integral + UNSTABLE.D * (z - 1.0) / ((lag + h) * z - lag)
    loop = law * control.c2d(SYSTEM, h) / z**2
    theta = np.geomspace(1e-3, math.pi, 4000)
    S = 1.0 / np.abs(1.0 + loop(np.exp(1j * theta)))
    found = peak_sensitivity(exact_model(), UNSTABLE, c)
    assert math.isfinite(found)
    assert found == pytest.approx(S.max(), rel=0.02)
