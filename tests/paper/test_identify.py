import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.stats import binom

from estune.core.margins import sample_plant
from estune.errors import InvalidInput
from experiments.paper.identify import (
    Band,
    chirp,
    fit_second_order,
    frequency_response,
    multisine,
    open_loop_record,
    response_of_record,
    stepped_sine,
)
from experiments.paper.initial_gains import propose
from experiments.paper.second_order import GaugeMode, SecondOrder, hooke_constant
from plants.models.reel import reference_reel
from tests.paper.support_identify import SAMPLING_HZ, Truth, simulated

TEN_SECONDS = Band(0.5, 310.0, period_s=2.0, periods=4, settling_periods=1)
TRUTH = Truth()


@cache
def signal():
    return multisine(SAMPLING_HZ, TEN_SECONDS, 4.0, slope=1.5, corner_Hz=20.0)


@cache
def clean():
    return simulated(TRUTH, signal().waveform_N)


def noisy(seed, rms=0.04):
    return clean() + rms * np.random.default_rng(seed).standard_normal(clean().size)


def errors_over_half_width(fit, truth):
    pairs = (
        (fit.natural_frequency_Hz, truth.natural_Hz),
        (fit.damping, truth.damping),
        (fit.gain, truth.gain),
        (fit.dead_time_s, truth.dead_time_s),
        (fit.gauge_Hz, truth.gauge_Hz),
        (fit.gauge_damping, truth.gauge_damping),
    )
    return np.array([(e.value - true) / ((e.high - e.low) / 2.0) for e, true in pairs])


@pytest.mark.parametrize("dead_time_quarters", [0, 3, 4, 9])
def test_sampled_model_matches_the_simulation(dead_time_quarters):
    truth = TRUTH._replace(dead_time_quarters=dead_time_quarters, damping=0.3, gauge_damping=0.1)
    long = multisine(SAMPLING_HZ, replace(TEN_SECONDS, settling_periods=2), 4.0)
    response = frequency_response(long, long.waveform_N, simulated(truth, long.waveform_N))
    model = SecondOrder(
        truth.gain,
        2 * np.pi * truth.natural_Hz,
        truth.damping,
        truth.dead_time_s,
        GaugeMode(2 * np.pi * truth.gauge_Hz, truth.gauge_damping),
    )
    exact = model.sampled_response(response.frequency_Hz, SAMPLING_HZ)
    assert np.abs(response.response - exact).max() < 1e-8 * truth.gain


@settings(max_examples=50, deadline=None)
@given(
    natural=st.floats(5.0, 1500.0),
    damping=st.floats(0.01, 0.95),
    dead_time=st.floats(0.0, 0.01),
    gauge=st.none() | st.tuples(st.floats(1600.0, 1900.0), st.floats(0.01, 0.5)),
)
def test_sampled_model_agrees_with_the_matrix_exponential(natural, damping, dead_time, gauge):
    model = SecondOrder(1.3, natural, damping, dead_time, gauge and GaugeMode(*gauge))
    f = np.linspace(0.1, 315.0, 60)
    A, B, C, E = model.state_space()
    plant = sample_plant(A, B, C, E, dead_time_s=dead_time, sample_s=1.0 / SAMPLING_HZ)
    exact = plant.response(2 * np.pi * f / SAMPLING_HZ)
    # The matrix is poorly scaled for fast modes; 1e-6 still distinguishes the two.
    assert (
        np.abs(model.sampled_response(f, SAMPLING_HZ) - exact).max() < 1e-6 * np.abs(exact).max()
    )


@pytest.mark.equation(30)
@settings(max_examples=40, deadline=None)
@given(
    inertia=st.floats(1e-4, 1e-2),
    stiffness=st.floats(0.5, 50.0),
    damping=st.floats(0.001, 0.6),
)
def test_hooke_constant_is_that_of_the_resonating_spring(inertia, stiffness, damping):
    friction = 2.0 * damping * math.sqrt(stiffness * inertia)
    natural = math.sqrt(stiffness / inertia)
    # Where the mass-spring-damper's response is largest, by search.
    peak = minimize_scalar(
        lambda w: abs(stiffness - inertia * w**2 + 1j * friction * w) ** 2 / stiffness**2,
        bounds=(0.1 * natural, 1.1 * natural),
        options={"xatol": 1e-9 * natural},
        method="bounded",
    ).x
    # The peak is flat, so that a search finds it to half the digits.
    assert hooke_constant(peak, inertia, friction) == pytest.approx(stiffness, rel=1e-5)


def test_hooke_constant_takes_arrays_and_rejects_overdamped_values():
    k = hooke_constant(np.array([40.0, 50.0]), 2e-3, 0.02)
    assert k.shape == (2,)
    assert isinstance(hooke_constant(40.0, 2e-3, 0.02), float)
    for bad in ((math.nan, 2e-3, 0.02), (40.0, 0.0, 0.02), (40.0, 2e-3, -0.1)):
        with pytest.raises(InvalidInput, match="it must be finite and"):
            hooke_constant(*bad)


@pytest.mark.parametrize("slope", [0.0, 1.5])
def test_multisine_has_a_low_crest_factor_and_silent_detection_lines(slope):
    excitation = multisine(SAMPLING_HZ, TEN_SECONDS, 3.0, slope=slope, corner_Hz=20.0)
    (segment,) = excitation.segments
    spectrum = np.abs(np.fft.rfft(segment.period_N)) / segment.period_N.size
    silent = np.ones(spectrum.size, bool)
    silent[segment.excited] = False
    assert np.abs(excitation.waveform_N).max() == pytest.approx(3.0)
    assert spectrum[silent].max() < 1e-12
    f = segment.excited / TEN_SECONDS.period_s
    expected = np.maximum(f / 20.0, 1.0) ** slope
    assert spectrum[segment.excited] / spectrum[segment.excited][0] == pytest.approx(expected)
    # A sum of sines with random phases has 3 or more; one sine has 1.41.
    assert excitation.crest_factor < 1.6
    assert (segment.even % 2 == 0).all()
    assert (segment.odd % 2 == 1).all()
    assert segment.odd.size > segment.excited.size / 5


def test_chirp_has_no_even_lines_and_no_jump():
    excitation = chirp(SAMPLING_HZ, Band(1.0, 100.0), 2.0)
    period = excitation.segments[0].period_N
    assert np.abs(np.fft.rfft(period)[::2]).max() < 1e-10 * period.size
    # No step exceeds that of the fastest sine.
    assert (
        np.abs(np.diff(excitation.waveform_N)).max() < 2.0 * 2 * np.pi * 100.0 / SAMPLING_HZ * 1.01
    )


@pytest.mark.parametrize(
    "excitation",
    [
        multisine(SAMPLING_HZ, TEN_SECONDS, 4.0, slope=1.5, corner_Hz=20.0),
        chirp(SAMPLING_HZ, TEN_SECONDS, 1.5),
        stepped_sine(SAMPLING_HZ, Band(1.0, 310.0, 1.0, 2, 2), 1.0, points=30),
    ],
    ids=["multisine", "chirp", "stepped sine"],
)
def test_plant_is_identified_by_every_excitation(excitation):
    y = simulated(TRUTH, excitation.waveform_N)
    y += 0.04 * np.random.default_rng(3).standard_normal(y.size)
    fit = fit_second_order(frequency_response(excitation, 15.0 + excitation.waveform_N, 15.0 + y))
    assert fit.natural_frequency_Hz.value == pytest.approx(TRUTH.natural_Hz, rel=0.005)
    assert fit.damping.value == pytest.approx(TRUTH.damping, rel=0.05)
    assert fit.dead_time_s.value == pytest.approx(TRUTH.dead_time_s, abs=0.1 / SAMPLING_HZ)
    assert fit.gain.value == pytest.approx(TRUTH.gain, rel=0.01)
    assert fit.gauge_Hz.value == pytest.approx(TRUTH.gauge_Hz, rel=0.02)
    peak = TRUTH.natural_Hz * math.sqrt(1 - 2 * TRUTH.damping**2)
    assert fit.resonance_Hz.value == pytest.approx(peak, rel=0.005)
    k = 2e-3 * (2 * np.pi * TRUTH.natural_Hz) ** 2
    assert fit.hooke_constant_Nm_rad(2e-3).value == pytest.approx(k, rel=0.01)


@pytest.mark.slow
def test_confidence_intervals_have_nominal_coverage():
    seeds = 60
    ratios = []
    for seed in range(seeds):
        response = frequency_response(signal(), signal().waveform_N, noisy(seed))
        ratios.append(errors_over_half_width(fit_second_order(response, probability=0.8), TRUTH))
    covered = (np.abs(ratios) <= 1.0).sum(axis=0)
    # At 80 %, intervals too wide show as well; a failure by chance has probability 1e-4 per side.
    low, high = binom.ppf([1e-4, 1 - 1e-4], seeds, 0.8)
    assert (covered >= low).all(), covered
    assert (covered <= high).all(), covered


def test_confidence_band_covers_the_true_response():
    truth = frequency_response(signal(), signal().waveform_N, clean())
    response = frequency_response(signal(), signal().waveform_N, noisy(11))
    inside = np.abs(response.response - truth.response) <= response.radius(0.95)
    low, high = binom.ppf([1e-4, 1 - 1e-4], inside.size, 0.95)
    assert low <= inside.sum() <= high
    least, greatest = response.magnitude_band()
    assert ((least <= np.abs(truth.response)) & (np.abs(truth.response) <= greatest)).mean() > 0.95
    assert (response.coherence >= 0.0).all()
    assert (response.coherence <= 1.0).all()


def test_distortion_is_measured_as_even_or_odd_with_its_size():
    sine = stepped_sine(SAMPLING_HZ, Band(2.0, 40.0, 1.0, 4, 0), 2.0, points=8)
    x = sine.waveform_N
    noise = 1e-3 * np.random.default_rng(0).standard_normal(x.size)
    square = frequency_response(sine, x, x + 0.05 * x**2 + noise)
    cube = frequency_response(sine, x, x + 0.05 * x**3 + noise)
    neither = frequency_response(sine, x, x + noise)
    # sin^2 = (1 - cos 2)/2, sin^3 = (3 sin - sin 3)/4
    lowest = square.frequency_Hz[0]
    second = square.even.output_N[square.even.frequency_Hz == 2 * lowest]
    third = cube.odd.output_N[cube.odd.frequency_Hz == 3 * lowest]
    assert second[0] == pytest.approx(0.05 * 2.0**2 / 2, rel=0.01)
    assert third[0] == pytest.approx(0.05 * 2.0**3 / 4, rel=0.01)
    assert (square.even.detected, square.odd.detected) == (True, False)
    assert (cube.even.detected, cube.odd.detected) == (False, True)
    assert (neither.even.detected, neither.odd.detected) == (False, False)


def test_odd_distortion_widens_the_confidence_band():
    x = signal().waveform_N
    noise = 1e-3 * np.random.default_rng(0).standard_normal(x.size)
    response = frequency_response(signal(), x, x + 0.004 * x**3 + noise)
    quiet = frequency_response(signal(), x, x + noise)
    # The cube's part in proportion to the signal belongs to the response; the rest is distortion.
    deviation = np.abs(
        response.response - np.average(response.response, weights=1 / response.variance)
    )
    inside = deviation <= response.radius(0.95)
    assert response.odd.detected
    assert inside.mean() > 0.85
    assert (deviation <= quiet.radius(0.95)).mean() < 0.5


def _refused(case):  # noqa: C901  one branch for each way a record can be bad
    x, y = signal().waveform_N, noisy(0)
    cut = signal()
    match case:
        case "short":
            return frequency_response(cut, x[:-1], y[:-1])
        case "nan":
            y[100] = math.nan
        case "limited":
            x = np.clip(x, -1.5, 1.5)
        case "shifted":
            x = np.roll(x, 3)
        case "clipped":
            y = np.clip(y, -1.2, 1.2)
        case "dead":
            y = np.zeros_like(y)
        case "not settled":
            y = y + 40.0 * np.exp(-np.arange(y.size) / SAMPLING_HZ) * np.cos(np.arange(y.size) / 9)
        case "noise":
            y = noisy(0, rms=400.0)
        case "band above" | "band below" | "no gauge" | "few lines":
            band = {
                "band above": Band(12.0, 310.0),
                "band below": Band(0.5, 6.0, period_s=8.0),
                "no gauge": Band(0.5, 60.0),
                "few lines": Band(4.0, 20.0, 1.0, 2, 4),
            }[case]
            if case == "few lines":
                cut = stepped_sine(SAMPLING_HZ, band, 2.0, points=5)
            else:
                cut = multisine(SAMPLING_HZ, band, 2.0)
            x = cut.waveform_N
            y = simulated(TRUTH, x) + 0.01 * np.random.default_rng(0).standard_normal(x.size)
    return fit_second_order(frequency_response(cut, x, y))


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("short", "asks for 6320 samples: record all of it"),
        ("nan", "output sample 100 is nan; repeat the record"),
        ("limited", "% of the recorded input is not the excitation .* lower the peak"),
        ("shifted", "% of the recorded input is not the excitation .* from its first sample"),
        ("clipped", "output stays at its greatest value of 1.2 N .* lower the peak"),
        ("dead", "nothing moves"),
        ("not settled", "not settled after 1 periods; give more settling periods"),
        ("noise", "coherence is 0.* below 0.8; raise the excitation's peak"),
        ("band above", "response is largest at its lower end; widen the band there"),
        ("band below", "response is largest at its upper end; widen the band there"),
        ("no gauge", "no gauge mode is visible .* give the known mode, or none"),
        ("few lines", "lines are too few for 6 unknowns; excite 9 or more"),
    ],
)
def test_unidentifiable_plant_is_rejected_with_a_remedy(case, message):
    with pytest.raises(InvalidInput, match=message):
        _refused(case)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Band(5.0, 1.0), "the lower one first"),
        (lambda: Band(0.1, 10.0, period_s=1.0), "use 10 s or longer"),
        (lambda: Band(1.0, 10.0, periods=1), "2 or more are needed"),
        (lambda: multisine(632.0, Band(1.0, 400.0), 1.0), "below half the sampling rate"),
        (lambda: multisine(632.0, Band(1.0, 10.0, period_s=1.001), 1.0), "whole number"),
        (lambda: multisine(632.0, Band(1.0, 3.0), 1.0), "longer period or a wider band"),
        (lambda: chirp(632.0, Band(1.0, 100.0), math.nan), "finite and above zero"),
        (lambda: chirp(632.0, Band(2.0, 90.0, period_s=631 / 632), 1.0), "even number"),
    ],
)
def test_impossible_excitation_is_rejected(make, message):
    with pytest.raises(InvalidInput, match=message):
        make()


def test_fit_below_the_gauge_mode_uses_a_known_gauge():
    excitation = multisine(SAMPLING_HZ, Band(0.5, 60.0), 2.0)
    y = simulated(TRUTH, excitation.waveform_N) + 0.01 * np.random.default_rng(0).standard_normal(
        excitation.waveform_N.size
    )
    response = frequency_response(excitation, excitation.waveform_N, y)
    gauge = GaugeMode(2 * np.pi * TRUTH.gauge_Hz, TRUTH.gauge_damping)
    fit = fit_second_order(response, gauge)
    assert fit.dead_time_s.low <= TRUTH.dead_time_s <= fit.dead_time_s.high
    assert fit.model.gauge == gauge
    assert fit.gauge_Hz is None


def test_open_loop_reel_matches_its_linear_model():
    reel = reference_reel(1.1, 20.0, dead_time_s=1.25 / SAMPLING_HZ)
    excitation = multisine(SAMPLING_HZ, TEN_SECONDS, 20.0)
    record = open_loop_record(reel, excitation, seed=None)
    w = reel.natural_frequency_rad_s
    zeta = (0.010 + 0.015 * 1.1) / (2.0 * 2.0e-3 * w)
    truth = Truth(1.0, w / (2 * np.pi), zeta, 5, reel.gauge_Hz, reel.gauge_damping)
    assert record.loop == "open"
    assert record.current_A == pytest.approx(record.setpoint_N / reel.newtons_per_ampere)
    expected = 20.0 + simulated(truth, excitation.waveform_N)
    assert np.abs(record.tension_N - expected).max() < 1e-9


def test_identified_reel_gives_safe_initial_gains():
    reel = reference_reel(0.8, 15.0)
    excitation = multisine(SAMPLING_HZ, TEN_SECONDS, 40.0, slope=1.5, corner_Hz=20.0)
    fit = fit_second_order(response_of_record(open_loop_record(reel, excitation), excitation))
    model = fit.model.per_effort(reel.newtons_per_ampere)
    assert model.gain == pytest.approx(1.0, rel=0.01)
    assert propose(model, reel.controller, "sensitivity_limited").safe


def test_unsuitable_record_is_rejected():
    reel = reference_reel(0.8, 20.0)
    record = open_loop_record(reel, signal(), seed=0)
    with pytest.raises(InvalidInput, match="run the excitation in open loop"):
        response_of_record(replace(record, loop="closed"), signal())
    with pytest.raises(InvalidInput, match="make the excitation at the rig's rate"):
        response_of_record(replace(record, sampling_Hz=500.0), signal())
    loud = multisine(SAMPLING_HZ, TEN_SECONDS, 150.0)
    with pytest.raises(InvalidInput, match=r"the current was limited in \d+ of 6320"):
        response_of_record(open_loop_record(reel, loud, seed=0), loud)
