"""Properties of every tuner, and the update law of each."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from estune.conformance.tuner import TunerConformance
from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.tuners import TUNERS, Observation, SearchSpace, create_tuner
from estune.tuners.extremum_seeking import Otis, PhaseCompensated
from estune.tuners.killingsworth import Killingsworth
from estune.tuners.least_squares_gradient import LeastSquaresGradient, slope
from estune.tuners.observation import usable_margin
from estune.tuners.perturbation import dither as dither_of
from estune.tuners.perturbation import low_pass, washout, washout_at_rest, washout_response
from estune.tuners.step_control import (
    STEP_SCALE_MIN,
    clip_norm,
    kesten_step,
    recover_after_safe,
    shrink_after_unsafe,
)

START = Gains(0.5, 20.0, 0.01, 0.03)
WIDE = SearchSpace.around(START)
LINEAR = SearchSpace(WIDE.names, WIDE.start, WIDE.low, WIDE.high, scale="linear")
CENSORED = Observation(math.nan, censored=True)

ALL = {
    **{name: create_tuner(name, WIDE) for name in TUNERS},
    "killingsworth, linear": Killingsworth(LINEAR),
}
every_tuner = pytest.mark.parametrize("tuner", ALL.values(), ids=ALL.keys())
KEEPING_TRIALS = ("safe_bayesian", "model_based")
WITHOUT_RECORD = {name: tuner for name, tuner in ALL.items() if name not in KEEPING_TRIALS}
every_tuner_without_record = pytest.mark.parametrize(
    "tuner", WITHOUT_RECORD.values(), ids=WITHOUT_RECORD.keys()
)

margins = st.just(math.inf) | st.floats(-2.0, 2.0)
observations = st.lists(
    st.builds(
        Observation,
        st.floats(allow_nan=False, allow_infinity=False),
        margin=margins,
        record=st.none(),
    )
    | st.builds(Observation, st.floats(1e-6, 1e6), margin=margins, record=st.none())
    | st.just(CENSORED),
    max_size=60,
)


def bowl(point, best=(0.8, 35.0, 0.02, 0.015)):
    """Cost with minimum one, quadratic in the logarithms."""
    return 1.0 + sum((math.log(p) - math.log(b)) ** 2 for p, b in zip(point, best, strict=True))


def run(tuner, state, cost, trials):
    """State after the given number of trials of a cost."""
    for _ in range(trials):
        state = tuner.tell(state, Observation(cost(tuner.ask(state))))
    return state


def dither(tuner, state):
    """Distance of the proposal from the centre, in coordinates."""
    proposal, centre = map(tuner.space.coordinates, (tuner.ask(state), tuner.recommend(state)))
    return math.dist(proposal, centre)


# Every tuner.


class TestEveryTuner(TunerConformance):
    @pytest.fixture(params=ALL)
    def tuner(self, request):
        return ALL[request.param]


@every_tuner
@given(observed=observations)
def test_proposals_stay_within_the_bounds_for_any_observations(tuner, observed):
    state = tuner.start()
    for observation in (*observed, CENSORED):
        for point in (tuner.ask(state), tuner.recommend(state)):
            rows = zip(tuner.space.low, point, tuner.space.high, strict=True)
            assert all(low <= value <= high for low, value, high in rows)
        state = tuner.tell(state, observation)


@every_tuner
def test_search_descends_despite_unsafe_trials(tuner):
    start = bowl(tuner.space.start)
    state = tuner.start()
    # Those with a model of the cost compute for longer, and need few trials.
    for k in range(350 if tuner.name in {"model_based", "safe_bayesian"} else 1000):
        point = tuner.ask(state)
        observation = CENSORED if k in (5, 100, 101, 102, 300) else Observation(bowl(point))
        state = tuner.tell(state, observation)
    assert bowl(tuner.recommend(state)) - 1.0 < 0.1 * (start - 1.0)


@every_tuner_without_record
def test_unsafe_trial_returns_to_best_safe_point_with_less_dither(tuner):
    state = run(tuner, tuner.start(), bowl, 20)
    safe = tuner.tell(state, Observation(bowl(tuner.ask(state))))
    unsafe = tuner.tell(state, CENSORED)
    assert tuner.recommend(unsafe) == pytest.approx(state.best_point, rel=1e-12)
    assert 0.0 < dither(tuner, unsafe) < dither(tuner, safe)
    assert unsafe.best_cost == state.best_cost


@every_tuner
def test_step_scale_recovers_with_safe_trials(tuner):
    state = tuner.tell(tuner.start(), CENSORED)
    assert state.step_scale < 1.0
    assert run(tuner, state, bowl, 10).step_scale == 1.0


def test_step_scale_stays_measurable_after_any_number_of_unsafe_trials():
    scale = 1.0
    for _ in range(50):
        scale = shrink_after_unsafe(scale)
    assert scale == STEP_SCALE_MIN
    for _ in range(math.ceil(math.log(1.0 / STEP_SCALE_MIN, 1.05))):
        scale = recover_after_safe(scale)
    assert scale == 1.0


@pytest.mark.parametrize(
    ("margin", "safe", "unsafe"),
    [(math.inf, 1.0, 0.0), (0.3, 0.3, 0.0), (-0.2, -0.2, -0.2), (-1e6, -1.0, -1.0)],
)
def test_margin_lies_between_minus_one_and_one_and_is_used_up_by_an_unsafe_trial(
    margin, safe, unsafe
):
    assert usable_margin(Observation(1.0, margin=margin)) == safe
    assert usable_margin(Observation(math.nan, censored=True, margin=margin)) == unsafe


@every_tuner
@given(costs=st.lists(st.floats(0.1, 10.0) | st.none(), max_size=30))
def test_best_point_is_the_cheapest_safe_trial(tuner, costs):
    state, observed = tuner.start(), []
    assert (state.best_point, state.best_cost) == (tuner.space.start, None)
    for cost in costs:
        if cost is not None:
            observed.append((cost, tuner.ask(state)))
        state = tuner.tell(state, CENSORED if cost is None else Observation(cost))
    if observed:
        cheapest = min(observed, key=lambda row: row[0])
        assert (state.best_cost, state.best_point) == cheapest
    else:
        assert (state.best_cost, state.best_point) == (None, tuner.space.start)


@every_tuner
@pytest.mark.parametrize("cost", [math.nan, math.inf, -math.inf])
def test_cost_that_is_not_finite_is_refused_unless_censored(tuner, cost):
    with pytest.raises(InvalidInput, match="censored=True"):
        tuner.tell(tuner.start(), Observation(cost))
    tuner.tell(tuner.start(), Observation(cost, censored=True))


@pytest.mark.parametrize(
    ("kind", "setting", "value"),
    [
        (Killingsworth, "dither_amplitudes", (0.1, 0.1, math.nan, 0.1)),
        (Killingsworth, "adaptation_gains", (1.0, 1.0)),
        (Killingsworth, "frequency_base", 1.0),
        (Killingsworth, "washout_h", -0.5),
        (Otis, "low_pass_share", 0.0),
        (Otis, "space", LINEAR),
        (LeastSquaresGradient, "step_limit", math.inf),
        (LeastSquaresGradient, "dither_amplitude", 0.0),
        (LeastSquaresGradient, "space", LINEAR),
    ],
)
def test_setting_out_of_range_is_refused_by_name(kind, setting, value):
    with pytest.raises(InvalidInput, match=setting):
        kind(**{"space": WIDE, setting: value})


# Killingsworth & Krstic, 2006.


def test_killingsworth_follows_the_printed_equations():
    start, low, high = (4.06, 9.25, 2.31), (1e-6,) * 3, (1e6,) * 3
    tuner = Killingsworth(
        SearchSpace(("K", "Ti", "Td"), start, low, high, scale="linear", form="standard"),
        dither_amplitudes=(0.1, 1.0, 0.1),
        adaptation_gains=(200.0, 1200.0, 200.0),
    )

    def cost(K, Ti, Td):
        return 2e-4 + 2e-3 * (K - 3.6) ** 2 + 5e-5 * (Ti - 27.0) ** 2 + 1e-3 * (Td - 2.1) ** 2 * K

    # Independent implementation on arrays, in the printed order, indices from 1.
    alpha, gamma = np.array([0.1, 1.0, 0.1]), np.array([200.0, 1200.0, 200.0])
    omega, h = np.array([0.8, 0.8**2, 0.8**3]) * np.pi, 0.5
    th, theta, J_before = np.array(start), np.array(start), cost(*start)
    zeta = J_before / (1 + h)  # at rest: zeta = -h zeta + J
    state = tuner.start()
    for k in range(1, 101):
        assert tuner.ask(state) == pytest.approx(tuple(theta), rel=1e-9)
        assert tuner.recommend(state) == pytest.approx(tuple(th), rel=1e-9)
        zeta = -h * zeta + J_before
        J = cost(*theta)
        th = th - gamma * alpha * np.cos(omega * k) * (J - (1 + h) * zeta)
        theta = th + alpha * np.cos(omega * (k + 1))
        J_before = J
        state = tuner.tell(state, Observation(cost(*tuner.ask(state))))
    assert abs(th[1] - start[1]) > 1.0  # the tuner has moved


# Extremum seeking of the paper, without and with phase compensation.


def still(kind):
    """Tuner with a nearly fixed centre, which only measures the slope."""
    return kind(WIDE, adaptation_gain=1e-9, dither_amplitude=0.02, low_pass_share=0.5)


def mean_slope(tuner, cost):
    """Measured slope over one period of the dither after the filters have settled."""
    state = run(tuner, tuner.start(), cost, 200)
    slopes = []
    for _ in range(dither_of(len(tuner.space.names)).period):
        state = run(tuner, state, cost, 1)
        slopes.append(state.slope)
    return np.mean(slopes, axis=0)


TRUE_SLOPE = (1.0, -0.5, 0.25, 2.0)


def exponential(point):
    """Cost whose logarithm is linear in those of the parameters."""
    return math.prod(p**g for p, g in zip(point, TRUE_SLOPE, strict=True))


def test_compensated_demodulation_reads_every_slope_at_full_size():
    assert mean_slope(still(PhaseCompensated), exponential) == pytest.approx(TRUE_SLOPE, rel=1e-5)


def test_published_demodulation_reads_the_in_phase_part_of_the_washout():
    responses = [washout_response(0.5, w) for w in dither_of(4).frequencies]
    in_phase = [gain * math.cos(lead) for gain, lead in responses]
    expected = [g * share for g, share in zip(TRUE_SLOPE, in_phase, strict=True)]
    published = mean_slope(still(Otis), exponential)
    assert published == pytest.approx(expected, rel=1e-5)
    assert max(in_phase) > 4.0 * min(in_phase)


def test_demodulated_slope_is_free_of_curvature():
    centre = WIDE.coordinates(WIDE.start)

    def curved(point):
        x = np.array(WIDE.coordinates(point)) - centre
        return math.exp(x @ x + 5.0 * x[0] * x[1] - 3.0 * x[1] * x[3] + 2.0 * x[2] * x[3])

    assert np.abs(mean_slope(still(PhaseCompensated), curved)).max() < 1e-6


@pytest.mark.parametrize("parameters", [1, 2, 3, 4, 5, 6])
def test_dither_lines_of_first_and_second_order_are_distinct(parameters):
    # Checked in the spectra of all products of two dithers over a period.
    signals = dither_of(parameters)
    dithers = np.cos(np.outer(signals.frequencies, np.arange(signals.period)))
    answers = [*dithers, *[a * b for i, a in enumerate(dithers) for b in dithers[: i + 1]]]
    power = np.abs(np.fft.rfft(answers))[:, 1:]  # without the mean, which carries no gradient
    lines = [set(np.flatnonzero(row > 1e-6 * signals.period)) for row in power]
    assert all(lines)
    assert len(set.union(*lines)) == sum(map(len, lines))
    assert len(set.union(*lines)) == 2 * parameters + parameters * (parameters - 1)


@pytest.mark.parametrize("parameters", [1, 2, 3, 4, 5, 6])
def test_dithers_are_an_orthogonal_design_over_one_period(parameters):
    signals = dither_of(parameters)
    period = signals.period
    design = np.cos(np.outer(np.arange(period), signals.frequencies))
    assert design.sum(axis=0) == pytest.approx(np.zeros(parameters), abs=1e-9)
    assert design.T @ design == pytest.approx(np.eye(parameters) * period / 2, abs=1e-9)


# Least-squares gradient.


def test_regressed_slope_is_exact_on_a_linear_cost():
    tuner = LeastSquaresGradient(WIDE)
    state = run(tuner, tuner.start(), exponential, 4)
    for _ in range(30):
        before = tuner.space.coordinates(tuner.recommend(state))
        state = run(tuner, state, exponential, 1)
        assert slope(state.moments, 4) == pytest.approx(TRUE_SLOPE, rel=1e-7)
        step = np.subtract(tuner.space.coordinates(tuner.recommend(state)), before)
        expected = -tuner.step_limit * np.array(TRUE_SLOPE) / np.linalg.norm(TRUE_SLOPE)
        assert step == pytest.approx(expected, rel=1e-6)


def test_regression_is_weighted_least_squares():
    tuner = LeastSquaresGradient(WIDE)
    state, rows, costs = tuner.start(), [], []
    for _ in range(25):
        point = tuner.ask(state)
        rows.append([1.0, *tuner.space.coordinates(point)])
        costs.append(bowl(point))
        state = tuner.tell(state, Observation(costs[-1]))
    weight = np.sqrt(0.8 ** np.arange(24, -1, -1))
    expected = np.linalg.lstsq(weight[:, None] * rows, weight * np.log(costs))[0][1:]
    assert slope(state.moments, 4) == pytest.approx(expected, rel=1e-6)


def test_slope_along_an_unexplored_direction_is_zero():
    x, costs = np.array([[1.0, 0.3, 0.0], [1.0, -0.2, 0.0], [1.0, 0.5, 0.0]]), [0.3, -0.2, 0.5]
    table = np.column_stack([x, costs])
    moments = (table.T @ table)[np.triu_indices(4)]
    assert slope(tuple(moments.tolist()), 2) == pytest.approx((1.0, 0.0))


def test_clip_norm_shortens_and_never_lengthens():
    assert clip_norm((3.0, 4.0), 1.0) == pytest.approx((0.6, 0.8))
    assert clip_norm((0.3, 0.4), 1.0) == (0.3, 0.4)
    assert clip_norm((0.0, 0.0), 1.0) == (0.0, 0.0)


def test_kesten_step_keeps_the_length_of_aligned_steps():
    mean_step, mean_length = (0.0, 0.0), 0.0
    for _ in range(50):
        step, mean_step, mean_length = kesten_step((0.3, -0.4), mean_step, mean_length)
        assert step == pytest.approx((0.3, -0.4))


def test_kesten_step_shortens_circling_steps_to_the_minimum():
    mean_step, mean_length = (0.0, 0.0), 0.0
    for k in range(200):
        direction = (math.cos(2.0 * k), math.sin(2.0 * k))
        step, mean_step, mean_length = kesten_step(direction, mean_step, mean_length)
    assert math.hypot(*step) == pytest.approx(0.1)


@pytest.mark.parametrize("kind", [PhaseCompensated, LeastSquaresGradient])
def test_search_settles_on_a_cost_too_steep_for_its_gain(kind):
    best = np.log([0.8, 35.0, 0.02, 0.015])

    def steep(point):
        return math.exp(2.5 * np.sum((np.log(point) - best) ** 2))

    tuner = kind(WIDE)
    assert tuner.adaptation_gain * 5.0 > 2.0  # plain descent with this gain never settles here
    state, late = run(tuner, tuner.start(), steep, 250), []
    for _ in range(50):
        state = run(tuner, state, steep, 1)
        late.append(steep(tuner.recommend(state)))
    assert np.mean(late) < 1.05


# The filters.


def test_washout_is_its_transfer_function():
    levels = np.random.default_rng(3).normal(size=50)
    zeta, washed = washout_at_rest(0.4, levels[0]), []
    for level in levels:
        output, zeta = washout(0.4, zeta, level)
        washed.append(output)
    numerator, denominator = [1.0, -1.0], [1.0, 0.4]
    rest = signal.lfilter_zi(numerator, denominator) * levels[0]
    expected = signal.lfilter(numerator, denominator, levels, zi=rest)[0]
    assert washed == pytest.approx(expected)


@given(st.floats(0.01, 3.1), st.floats(0.05, 0.95))
def test_washout_response_is_that_of_its_transfer_function(frequency, h):
    gain, lead = washout_response(h, frequency)
    expected = signal.freqz([1.0, -1.0], [1.0, h], [frequency])[1][0]
    assert gain * np.exp(1j * lead) == pytest.approx(expected)


def test_low_pass_is_its_transfer_function():
    signals, level, levels = np.random.default_rng(4).normal(size=50), 0.0, []
    for value in signals:
        level = low_pass(0.1, level, value)
        levels.append(level)
    assert levels == pytest.approx(signal.lfilter([0.1], [1.0, -0.9], signals))
