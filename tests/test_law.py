"""The law of tuned gains over length and tension, on tunings of a known law."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from estune.core.comparison import interval_factor
from estune.core.gains import GAIN_NAMES, Gains
from estune.errors import InvalidInput
from estune.studies.law.law import fit_law
from estune.studies.law.robust_regression import fit_weighted
from estune.studies.law.tuned import TunedGains

LENGTHS = (0.5, 0.65, 0.8, 0.95, 1.1, 1.25, 1.4)


def falling(L, _T):
    return 52.0 - 18.5 * L


def inverse(L, _T):
    return 10.0 + 20.0 / L


def with_tension(L, T):
    return 50.0 - 18.5 * L + 0.4 * T


def tunings(
    law=falling, seed=0, *, seeds=1, lengths=LENGTHS, tensions=(15.0,), message=True, spread=0.02
) -> list[TunedGains]:
    """Tunings of a reel whose I follows a law; P, D and filter are constant.

    Each has an individual error of 1 to 5 %, reported to the law, and an unreported spread.
    """
    rng, results = np.random.default_rng(seed), []
    for s in range(seeds):
        for L in lengths:
            for T in tensions:
                own = rng.uniform(0.01, 0.05, 4)
                wrong = own * rng.normal(size=4) + spread * rng.normal(size=4)
                gains = Gains(*(np.array([1.2, law(L, T), 0.02, 0.004]) * np.exp(wrong)))
                results.append(
                    TunedGains(
                        *(f"{L:g} m, {T:g} N, seed {s}", L, T, gains),
                        log_errors=tuple(own) if message else None,
                        cost=1.5,
                        cost_error=0.01,
                        safe=True,
                        converged=True,
                    )
                )
    return results


# --- the slope and its interval --------------------------------------------------------------


@pytest.mark.parametrize("told", [True, False], ids=["errors told", "errors unknown"])
@pytest.mark.parametrize("repeats", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_slope_interval_has_its_nominal_coverage(told, repeats):
    rng, n, hits = np.random.default_rng(repeats), 300, 0
    length = np.repeat(LENGTHS, repeats)
    design = np.column_stack([np.ones_like(length), length])
    for _ in range(n):
        own = rng.uniform(0.3, 1.5, length.size)
        gain = 52.0 - 18.5 * length + np.hypot(own, 0.7) * rng.normal(size=length.size)
        fit = fit_weighted(design, gain, own if told else np.zeros_like(own))
        width = interval_factor(fit.degrees) * math.sqrt(fit.covariance[1, 1])
        hits += abs(fit.coefficients[1] + 18.5) <= width
    # Fewer hits of 95 % intervals have a probability below 0.001.
    assert hits >= stats.binom.ppf(0.001, n, 0.95)


def test_law_without_outliers_is_close_to_weighted_least_squares():
    law = fit_law(tunings(seeds=3, spread=0.0), forms={"I": "linear"})
    points, fit = law.fits["I"].points, law.fits["I"].fit
    by_numpy = np.polyfit(points.length_m, points.gain, 1, w=1.0 / fit.deviations)
    error = math.sqrt(fit.covariance[1, 1])
    assert fit.coefficients[1] == pytest.approx(by_numpy[0], abs=0.5 * error)


def test_slope_interval_for_equal_errors_is_the_textbook_one():
    x = np.repeat(LENGTHS, 3)
    y = falling(x, 0.0) + np.random.default_rng(2).normal(0.0, 1.0, x.size)
    fit = fit_weighted(np.column_stack([np.ones_like(x), x]), y, np.zeros_like(x))
    reference = stats.linregress(x, y)
    assert fit.coefficients[1] == pytest.approx(reference.slope, abs=reference.stderr)
    assert math.sqrt(fit.covariance[1, 1]) == pytest.approx(reference.stderr, rel=0.2)
    assert interval_factor(fit.degrees) == pytest.approx(stats.t.ppf(0.975, 19))


def test_tuning_with_large_errors_has_small_weight():
    results = tunings(seeds=2, spread=0.0)
    far = replace(
        results[0], gains=replace(results[0].gains, I=70.0), log_errors=(0.01, 0.6, 0.01, 0.01)
    )
    without, with_it = fit_law(results[1:]), fit_law([far, *results[1:]])
    slopes = [law.fits["I"].slope for law in (without, with_it)]
    assert slopes[1].value == pytest.approx(slopes[0].value, abs=0.3 * slopes[0].half_width)


def test_outlier_is_reported_and_does_not_change_the_law():
    results = tunings(seeds=3)
    wild = replace(results[5], gains=replace(results[5].gains, I=200.0))
    law = fit_law([*results[:5], wild, *results[6:]])
    clean = fit_law(results)
    assert law.fits["I"].outliers == (wild.label,)
    assert law.remarks == (f"I: {wild.label} is an outlier, down-weighted",)
    difference = law.fits["I"].slope.value - clean.fits["I"].slope.value
    assert abs(difference) < clean.fits["I"].slope.half_width


# --- the form --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("law", "form"),
    [
        pytest.param(falling, "linear", marks=pytest.mark.slow),
        (inverse, "inverse"),
        (with_tension, "linear + tension"),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_cross_validation_selects_the_true_form(law, form):
    chosen = [
        str(fit_law(tunings(law, seed=s, seeds=3, tensions=(5.0, 20.0, 35.0))).fits["I"].form)
        for s in range(12)
    ]
    assert chosen.count(form) >= 10


def test_gain_without_dependence_is_constant():
    laws = [fit_law(tunings(seed=s, seeds=2)) for s in range(12)]
    assert sum(law.fits["P"].form.over_length == "constant" for law in laws) >= 10


def test_gain_whose_constant_form_is_rejected_is_not_called_constant():
    law = fit_law(tunings(lambda L, _T: 30.0 + 20.0 * (L - 0.95) ** 2, seeds=8, spread=0.0))
    assert law.fits["I"].form.over_length == "constant"
    assert "I: the constant form does not fit" in law.remarks[0]
    assert "I differs between lengths without a trend, about" in law.sentence


def test_lack_of_fit_is_reported():
    law = fit_law(tunings(inverse, seeds=6, spread=0.0), forms={"I": "linear"})
    assert law.fits["I"].lack_of_fit.p_value < 1e-6
    assert "I: the linear form does not fit the repeated tunings" in law.remarks[0]
    assert fit_law(tunings()).fits["I"].lack_of_fit is None  # nothing was repeated


def test_form_that_falls_below_zero_is_not_selected():
    def steep(L, _):
        return 0.02 + 3e3 * max(0.0, 0.9 - L) ** 3

    fit_law(tunings(steep, seeds=3, message=False)).schedule()
    law = fit_law(tunings(steep, message=False), forms={"I": "linear"})
    with pytest.raises(InvalidInput, match="narrow its range, or choose another form"):
        law.schedule()


# --- bands -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_prediction_band_has_its_nominal_coverage():
    hits = []
    for seed in range(40):
        law = fit_law(tunings(seed=seed, seeds=2), forms={"I": "linear"})
        further = tunings(seed=1000 + seed)
        band = law.band("I", [t.length_m for t in further])
        measured = np.array([t.gains.I for t in further])
        hits += list((band.new_low <= measured) & (measured <= band.new_high))
        assert (band.new_low < band.low).all()
        assert (band.low < band.gain).all()
    assert 0.9 < np.mean(hits) < 0.99


def test_band_refuses_extrapolation_unless_requested():
    law = fit_law(tunings(tensions=(10.0, 20.0)))
    for length, tension in ((1.5, 15.0), (0.4, 15.0), (1.0, 25.0)):
        with pytest.raises(InvalidInput, match=r"holds from 0\.5 to 1\.4 m and 10 to 20 N"):
            law.band("I", [0.8, length], tension)
    band = law.band("I", [0.8, 1.5], extrapolate=True)
    assert band.extrapolated.tolist() == [False, True]
    width = band.high - band.low
    assert width[1] > width[0]
    assert law.schedule().length_m[1] < 1.5


# --- input and output ------------------------------------------------------------------------


def test_law_excludes_and_lists_unsafe_and_unconverged_tunings():
    results = tunings(seeds=2)
    bad = [
        replace(results[0], safe=False, gains=replace(results[0].gains, I=500.0)),
        replace(results[1], converged=False, gains=replace(results[1].gains, I=500.0)),
    ]
    law = fit_law([*bad, *results[2:]])
    assert law.excluded == ((bad[0].label, "unsafe"), (bad[1].label, "not converged"))
    assert law.fits["I"].slope == fit_law(results[2:]).fits["I"].slope
    assert law.remarks[0] == f"left out: {bad[0].label}, unsafe"


@pytest.mark.parametrize(
    ("some", "sentence"),
    [
        ([], "0 tunings at no length are too few"),
        (tunings(lengths=(0.5,), seeds=5), "5 tunings at 0.5 m are too few"),
        (
            [replace(t, converged=False) for t in tunings(lengths=(0.5, 1.0, 1.4))],
            r"left out: \d+ not converged$",
        ),
    ],
)
def test_fit_law_refuses_too_few_tunings(some, sentence):
    with pytest.raises(InvalidInput, match=sentence):
        fit_law(some)


def test_fit_law_refuses_confounded_length_and_tension():
    results = [
        t for t in tunings(tensions=(10.0, 20.0)) if (t.length_m > 0.9) == (t.tension_N > 15)
    ]
    together = [replace(t, tension_N=10.0 + 10.0 * t.length_m) for t in results]
    with pytest.raises(InvalidInput, match="vary length and tension separately"):
        fit_law(together)


def test_fit_law_refuses_unknown_gains_and_forms():
    with pytest.raises(InvalidInput, match="there is no form 'cubic'; the forms are constant"):
        fit_law(tunings(), forms={"I": "cubic"})
    with pytest.raises(InvalidInput, match="there is no gain 'Q'"):
        fit_law(tunings(), forms={"Q": "linear"})


def test_law_does_not_depend_on_the_order_of_tunings():
    results = tunings(seeds=2)
    one, other = fit_law(results), fit_law(results[::-1])
    assert one.fits["I"].slope.value == pytest.approx(other.fits["I"].slope.value, rel=1e-9)
    assert one.sentence == other.sentence


def test_constant_gain_gives_an_exact_law():
    results = [replace(t, gains=replace(t.gains, D=0.0)) for t in tunings()]
    law = fit_law(results)
    assert law.schedule().gains(0.7, 15.0).D == 0.0
    assert "D is 0 s throughout" in law.sentence


def test_gain_undetermined_in_a_tuning_ignores_that_tuning():
    results = tunings(seeds=2)
    flat = replace(
        results[3], gains=replace(results[3].gains, I=9.0), log_errors=(0.02, math.inf, 0.02, 0.02)
    )
    law = fit_law([*results[:3], flat, *results[4:]])
    assert flat.label not in law.fits["I"].labels
    assert flat.label in law.fits["P"].labels


def test_sentence_states_length_and_tension_dependence():
    law = fit_law(tunings(seeds=3))
    slope = law.fits["I"].slope
    start = f"I falls by {-slope.value:.3g} ±{slope.half_width:.2g} 1/s per metre"
    assert law.sentence.startswith(start)
    assert "P is constant within its error at 1.2" in law.sentence
    assert law.sentence.endswith("tension was not varied")
    varied = fit_law(tunings(seeds=2, tensions=(5.0, 20.0, 35.0)))
    assert varied.sentence.endswith("tension has no detectable effect")
    pulled = fit_law(tunings(with_tension, seeds=2, tensions=(5.0, 20.0, 35.0)))
    assert "each N of tension changes I by +0.39 ±" in pulled.sentence


def test_law_json_and_schedule_agree():
    law = fit_law(tunings(seeds=2, tensions=(5.0, 20.0)))
    data = json.loads(json.dumps(law.to_json(), allow_nan=False))
    assert list(data["fits"]) == list(GAIN_NAMES)
    schedule = law.schedule()
    for name, curve in zip(GAIN_NAMES, schedule.curves, strict=True):
        band = law.band(name, [0.6, 1.3], 8.0)
        assert [curve.at(0.6, 8.0), curve.at(1.3, 8.0)] == pytest.approx(band.gain.tolist())
