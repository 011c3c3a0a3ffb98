"""The cost (35): normalisation, closed forms, and refused input."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from estune.core.cost import StepCost
from estune.core.response import LoadStep, StepShape
from estune.errors import InvalidInput

SAMPLING_Hz, SAMPLES, STEP_INDEX = 632.0, 632, 100
SHAPE = StepShape(STEP_INDEX, 5.0)
AFTER_STEP_s = (SAMPLES - STEP_INDEX) / SAMPLING_Hz

costs = st.builds(
    StepCost,
    st.floats(0.01, AFTER_STEP_s),
    st.sampled_from(["printed", "rising"]),
    st.sampled_from(["second", "settling_time"]),
)


def columns(error_of_t, step_N=5.0, preload_N=10.0, sampling_Hz=SAMPLING_Hz, samples=SAMPLES):
    """Setpoint, measurement and effort of a step whose error is `step_N error_of_t(t)`."""
    t = (np.arange(samples) - STEP_INDEX) / sampling_Hz
    setpoint = np.where(t >= 0.0, preload_N + step_N, preload_N)
    measurement = setpoint - np.where(t >= 0.0, step_N * error_of_t(np.maximum(t, 0.0)), 0.0)
    return setpoint, measurement, 0.3 * measurement


def evaluate(cost, error_of_t, **shape):
    sampling_Hz, step_N = shape.get("sampling_Hz", SAMPLING_Hz), shape.get("step_N", 5.0)
    return cost.evaluate(sampling_Hz, StepShape(STEP_INDEX, step_N), *columns(error_of_t, **shape))


def ringing(t):
    return np.exp(-9.0 * t) * np.cos(55.0 * t)


@given(costs, st.sampled_from([5.0, -5.0, 1e-3]))
def test_cost_of_the_first_order_reference_is_one(cost, step_N):
    eta = evaluate(cost, lambda t: np.exp(-4.0 * t / cost.settling_time_s), step_N=step_N)
    assert eta == pytest.approx(1.0, rel=1e-9)


@given(costs, st.floats(1e-3, 1e3) | st.floats(-1e3, -1e-3), st.floats(0.0, 2.0))
def test_cost_is_independent_of_step_size_and_sign(cost, step_N, move_weight):
    cost = StepCost(cost.settling_time_s, cost.weight, cost.time_unit, move_weight)
    assert evaluate(cost, ringing, step_N=step_N, preload_N=0.0) == pytest.approx(
        evaluate(cost, ringing, step_N=1.0, preload_N=0.0), rel=1e-9
    )


@given(costs, st.floats(1e-2, 1e2))
def test_cost_in_settling_times_is_independent_of_loop_speed(cost, faster):
    t_s = cost.settling_time_s
    plain = StepCost(t_s, cost.weight, "settling_time")
    quick = StepCost(t_s / faster, cost.weight, "settling_time")
    assert evaluate(
        quick, lambda t: ringing(t * faster), sampling_Hz=SAMPLING_Hz * faster
    ) == pytest.approx(evaluate(plain, ringing), rel=1e-9)


def test_cost_in_seconds_depends_on_loop_speed():
    quick = evaluate(StepCost(0.4), lambda t: np.exp(-4.0 * t))
    slow = evaluate(StepCost(40.0), lambda t: np.exp(-0.04 * t), sampling_Hz=SAMPLING_Hz / 100.0)
    assert slow > 1.2 * quick  # the slower loop costs more for the same slow tail


@pytest.mark.equation(35)
@pytest.mark.parametrize("weight", ["printed", "rising"])
@pytest.mark.parametrize("time_unit", ["second", "settling_time"])
@pytest.mark.parametrize("t_s", [0.1, 0.25033])  # on a sample or between two
@pytest.mark.parametrize("decay", [6.0, 25.0])
def test_cost_of_an_exponential_error_is_the_closed_form(weight, time_unit, t_s, decay):
    sampling_Hz = 20_000.0
    samples = STEP_INDEX + 24_000
    end = (samples - 1 - STEP_INDEX) / sampling_Hz
    sign = 1.0 if weight == "printed" else -1.0
    unit = 1.0 if time_unit == "second" else t_s

    def N(rate):
        def squared(t):
            return math.exp(-2.0 * rate * t)

        def sigmoid(t):
            return 1.0 / (1.0 + math.exp(sign * math.pi * (t - t_s) / (2.0 * t_s)))

        itse, _ = quad(lambda t: t / unit**2 * squared(t), 0.0, end, epsabs=1e-13)
        early, _ = quad(lambda t: sigmoid(t) * squared(t), 0.0, t_s, epsabs=1e-13)
        return itse + early / t_s

    eta = evaluate(
        StepCost(t_s, weight, time_unit),
        lambda t: np.exp(-decay * t),
        sampling_Hz=sampling_Hz,
        samples=samples,
    )
    assert eta == pytest.approx(N(decay) / N(4.0 / t_s), rel=1e-5)


@pytest.mark.equation(35)
def test_settling_time_between_two_samples_ends_the_integral_on_the_line_between_them():
    """Weighted squared errors are straight lines between samples that are far apart."""
    h, t_s = 0.05, 0.13
    t = np.arange(21) * h
    error = np.random.default_rng(0).uniform(0.5, 2.0, t.size)
    sigmoid = 1.0 / (1.0 + np.exp(np.pi * (t - t_s) / (2.0 * t_s)))

    def N(squared):
        early, _ = quad(lambda s: np.interp(s, t, sigmoid * squared), 0.0, t_s, points=t[1:3])
        return np.trapezoid(t * squared, t) + early / t_s

    eta = StepCost(t_s).evaluate(1.0 / h, StepShape(0, 1.0), error, 0.0 * t, 0.0 * t)
    assert eta == pytest.approx(N(error**2) / N(np.exp(-8.0 * t / t_s)), rel=1e-9)


@given(costs, st.floats(1.01, 100.0))
def test_cost_is_quadratic_in_the_error(cost, scale):
    small, large = evaluate(cost, ringing), evaluate(cost, lambda t: scale * ringing(t))
    assert large == pytest.approx(scale**2 * small, rel=1e-9)


def test_printed_weight_exceeds_rising_weight_in_the_transient():
    def early(t):
        return np.where(t < 0.05, 1.0, 0.0)

    def late(t):
        return np.where((t >= 0.2) & (t < 0.25), 0.2, 0.0)

    ratios = [
        evaluate(StepCost(0.3, weight), early) / evaluate(StepCost(0.3, weight), late)
        for weight in ("printed", "rising")
    ]
    assert ratios[0] > ratios[1]


def cost_by_definition(cost, rate_Hz, shape, error, effort):
    """The cost as the text of its module words it, by the trapezoidal rule."""
    h, t_s = 1.0 / rate_Hz, cost.settling_time_s
    end = shape.load.sample if shape.load else error.size

    def N(eps):
        t = np.arange(eps.size) * h
        if cost.criterion != "paper":
            return np.trapezoid(t * np.abs(eps) if cost.criterion == "itae" else eps**2, t)
        unit, sign = (
            (1.0 if cost.time_unit == "second" else t_s),
            1.0 if cost.weight == "printed" else -1.0,
        )
        early = t <= t_s * (1.0 + 1e-9)
        sigmoid = 1.0 / (1.0 + np.exp(sign * np.pi * (t - t_s) / (2.0 * t_s)))
        return (
            np.trapezoid(t / unit**2 * eps**2, t)
            + np.trapezoid((sigmoid * eps**2)[early], t[early]) / t_s
        )

    def eta(eps, ramp):
        parts = [np.where(k < ramp, 1.0 / ramp, 0.0) for k in range(eps.size)]
        t = np.arange(eps.size) * h
        late = [
            part * np.where(t >= k * h, np.exp(-4.0 * (t - k * h) / t_s), 0.0)
            for k, part in enumerate(parts)
        ]
        return N(eps) / N(np.sum(late, axis=0))

    tracking, used = (
        error[shape.sample : end] / shape.size,
        effort[shape.sample : end] / shape.size,
    )
    value = eta(tracking, shape.ramp)
    if cost.rejection:
        rejected = eta(error[end:] / shape.load.size, 1)
        value = (1.0 - cost.rejection) * value + cost.rejection * rejected
    away = used - np.mean(used[-max(1, used.size // 10) :])
    moves = [(effort[k] - effort[k - 1]) / shape.size for k in range(shape.sample, effort.size)]
    price = cost.effort_weight / t_s * np.sum(away**2) * h
    return value + price + cost.move_weight * sum(move**2 for move in moves)


@pytest.mark.parametrize("seed", range(24))
def test_cost_with_any_settings_is_that_of_its_definition(seed):
    rng = np.random.default_rng(seed)
    rate_Hz, step = 20.0, int(rng.integers(1, 5))
    after = int(rng.choice([7, 40, 95]))
    load = LoadStep(step + after, float(rng.uniform(-3.0, 3.0))) if seed % 2 else None
    shape = StepShape(step, float(rng.uniform(-3.0, 3.0)), load, int(rng.choice([1, 1, 5])))
    cost = StepCost(
        settling_time_s=int(rng.integers(2, 6)) / rate_Hz,
        weight=str(rng.choice(["printed", "rising"])),
        time_unit=str(rng.choice(["second", "settling_time"])),
        criterion=("paper", "itae", "ise")[seed % 3],
        move_weight=float(rng.uniform(0.0, 2.0)),
        effort_weight=float(rng.choice([0.0, 0.7])),
        rejection=float(rng.choice([0.0, 0.3, 1.0])) if load else 0.0,
    )
    measurement, effort = rng.standard_normal((2, step + after + (60 if load else 0)))
    setpoint = shape.setpoint(effort.size)
    expected = cost_by_definition(cost, rate_Hz, shape, setpoint - measurement, effort)
    assert cost.evaluate(rate_Hz, shape, setpoint, measurement, effort) == pytest.approx(expected)


@pytest.mark.parametrize("criterion", ["paper", "itae", "ise"])
def test_weights_are_all_of_the_cost_where_it_is_quadratic(criterion):
    setpoint, measurement, effort = columns(ringing)
    error = (setpoint - measurement)[STEP_INDEX:] / 5.0
    for effort_weight in (0.0, 0.1):
        cost = StepCost(0.3, criterion=criterion, effort_weight=effort_weight)
        weighted = cost.weights(SAMPLING_Hz, SHAPE, SAMPLES) @ error**2
        eta = cost.evaluate(SAMPLING_Hz, SHAPE, setpoint, measurement, effort)
        assert cost.is_quadratic == (weighted == pytest.approx(eta))
    assert not replace(cost, effort_weight=0.0, function="math:fsum").is_quadratic


def test_cost_scaled_by_the_gain_takes_the_effort_in_units_of_the_measurement():
    setpoint, measurement, effort = columns(ringing)
    cost = StepCost(0.3, move_weight=0.4, effort_weight=0.3)
    unscaled = cost.scaled(None)
    assert (cost.unscaled, unscaled.unscaled, unscaled.scaled(7.0).unscaled) == (
        False,
        True,
        False,
    )
    assert unscaled.scaled(7.0).evaluate(
        SAMPLING_Hz, SHAPE, setpoint, measurement, effort
    ) == pytest.approx(cost.evaluate(SAMPLING_Hz, SHAPE, setpoint, measurement, 7.0 * effort))


def test_settling_time_far_below_the_record_has_a_cost():
    """A thousand settling times after the step the sigmoid of (35) is beyond the largest float."""
    assert np.isfinite(StepCost(0.0005).weights(SAMPLING_Hz, SHAPE, SAMPLES)).all()


@pytest.mark.parametrize("weight", [0.0, 0.4])
def test_cost_of_a_batch_is_that_of_its_members(weight):
    rng = np.random.default_rng(5)
    setpoint, measurement, _ = columns(ringing)
    measurements = measurement + rng.normal(size=(2, 7, SAMPLES))
    efforts = rng.normal(size=(2, 7, SAMPLES))
    cost = StepCost(0.3, move_weight=weight, effort_weight=weight)
    batch = cost.evaluate(SAMPLING_Hz, SHAPE, setpoint, measurements, efforts)
    one_by_one = [
        [cost.evaluate(SAMPLING_Hz, SHAPE, setpoint, y, u) for y, u in zip(ys, us, strict=True)]
        for ys, us in zip(measurements, efforts, strict=True)
    ]
    assert np.shape(batch) == (2, 7)
    assert isinstance(one_by_one[0][0], float)
    np.testing.assert_allclose(batch, one_by_one, rtol=1e-12)
    setpoints = np.broadcast_to(setpoint, measurements.shape)
    again = cost.evaluate(SAMPLING_Hz, SHAPE, setpoints, measurements, efforts)
    np.testing.assert_array_equal(again, batch)


@pytest.mark.parametrize("where", [STEP_INDEX, SAMPLES // 2, SAMPLES - 1])
def test_nan_in_the_response_gives_nan(where):
    setpoint, measurement, effort = columns(ringing)
    measurement[where] = math.nan
    cost = StepCost(0.3)
    assert math.isnan(cost.evaluate(SAMPLING_Hz, SHAPE, setpoint, measurement, effort))


def test_response_too_large_to_square_costs_infinity():
    setpoint, measurement, effort = columns(ringing)
    measurement[-1] = 1e200
    cost = StepCost(0.3)
    assert cost.evaluate(SAMPLING_Hz, SHAPE, setpoint, measurement, effort) == math.inf


def test_settling_time_longer_than_the_record_is_refused():
    with pytest.raises(
        InvalidInput, match=r"0\.9 s is longer than the 0\.841772 s .*make the trial longer"
    ):
        evaluate(StepCost(0.9), ringing)
    assert evaluate(StepCost(AFTER_STEP_s), ringing) > 0.0


@pytest.mark.parametrize("bad", [-0.1, 0.0, math.nan, math.inf])
def test_invalid_settling_time_is_refused(bad):
    with pytest.raises(InvalidInput, match=f"settling_time_s is {bad} s"):
        StepCost(bad)


@pytest.mark.parametrize("bad", [-0.1, math.nan, math.inf])
def test_invalid_move_weight_is_refused(bad):
    with pytest.raises(InvalidInput, match=f"move_weight is {bad}"):
        StepCost(0.3, move_weight=bad)


@pytest.mark.parametrize("option", [{"weight": "falling"}, {"time_unit": "ms"}])
def test_unknown_option_is_refused_with_the_choices(option):
    with pytest.raises(InvalidInput, match=r"it must be '\w+' or '\w+'"):
        StepCost(0.3, **option)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"step": StepShape(STEP_INDEX, 0.0)}, "step size is 0.0"),
        ({"step": StepShape(STEP_INDEX, math.nan)}, "step size is nan"),
        ({"sampling_Hz": 0.0}, "sampling rate is 0.0 Hz"),
        ({"step": StepShape(-1, 5.0)}, "outside the record of 632 samples"),
        ({"step": StepShape(SAMPLES, 5.0)}, "outside the record of 632 samples"),
        ({"step": StepShape(SAMPLES - 1, 5.0)}, "the step is at the last sample"),
        ({"step": StepShape(0, 5.0)}, "the step at the first sample has no effort before it"),
        ({"setpoint": np.zeros(5)}, "5, 632 and 632 samples"),
        ({"effort": np.zeros(7)}, "632, 632 and 7 samples"),
    ],
)
def test_response_that_cannot_be_scored_is_refused(changed, message):
    names = ("setpoint", "measurement", "effort")
    arguments = {
        "sampling_Hz": SAMPLING_Hz,
        "step": SHAPE,
        **dict(zip(names, columns(ringing), strict=True)),
        **changed,
    }
    with pytest.raises(InvalidInput, match=message):
        StepCost(0.3, move_weight=0.1).evaluate(**arguments)
