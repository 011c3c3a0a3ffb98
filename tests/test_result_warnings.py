"""Result warnings on costs and margins whose warnings are known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune.core.gains import Gains
from estune.core.margins import Margins
from estune.run.results.result_warnings import at_bounds, flat_directions, low_margins, near_limits
from estune.tuners.search_space import SearchSpace

BEST = (1.0, 10.0, 0.01, 0.005)
SPACE = SearchSpace.around(Gains(*BEST))
NOISE = 0.01


def findings(cost, *, trials=120, noise=NOISE, seed=0):
    """Warnings for a cost of the logarithms, sampled about its minimum with noise."""
    random = np.random.default_rng(seed)
    z = random.normal(0.0, 0.5, (trials, 4))
    costs = np.array([cost(row) for row in z]) + noise * random.normal(size=trials)
    return flat_directions(
        SPACE, BEST, cost(np.zeros(4)), points=BEST * np.exp(z), costs=costs, noise=noise
    )


def flat(warnings):
    return {f.parameters for f in warnings if f.kind == "flat"}


@pytest.mark.parametrize("seed", range(5))
def test_flat_parameter_is_named_with_its_range(seed):
    warnings = findings(lambda z: 1.0 + z[0] ** 2 + 2.0 * z[1] ** 2 + z[3] ** 2, seed=seed)
    assert flat(warnings) == {("D",)}
    assert "D may change by a factor" in warnings[0].sentence


@pytest.mark.parametrize("seed", range(5))
def test_parameters_with_an_effective_product_are_named_together(seed):
    warnings = findings(
        lambda z: 1.0 + 2.0 * (z[0] + z[1]) ** 2 + z[2] ** 2 + z[3] ** 2, seed=seed
    )
    assert flat(warnings) == {("P", "I")}
    ways = next(f.sentence for f in warnings if f.kind == "flat")
    assert ("raising P" in ways) == ("lowering I" in ways)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    "cost",
    [
        lambda z: 1.0 + z @ z,
        lambda z: np.cosh(z[0]) + np.cosh(2.0 * z[1]) + np.exp(z[2]) - z[2] + z[3] ** 2,
        lambda z: 1.0 + (z[0] + z[1]) ** 2 + (z[0] - z[1]) ** 2 + z[2] ** 2 + z[3] ** 2,
    ],
    ids=["a bowl", "not a quadratic", "a turned bowl"],
)
def test_cost_of_all_parameters_has_no_flat_direction(cost, seed):
    assert not flat(findings(cost, seed=seed))


@given(trials=st.integers(0, 20), seed=st.integers(0, 99))
def test_too_few_trials_are_inconclusive(trials, seed):
    warnings = findings(lambda z: 1.0 + z[0] ** 2, trials=trials, seed=seed)
    assert [f.kind for f in warnings] == ["unknown"]
    assert warnings[0].parameters == SPACE.names


def test_unexplored_direction_is_not_flat():
    random = np.random.default_rng(1)
    z = random.normal(0.0, 0.5, (120, 4)) * (1.0, 1.0, 0.05, 1.0)
    costs = 1.0 + z[:, 0] ** 2 + z[:, 1] ** 2 + z[:, 3] ** 2 + NOISE * random.normal(size=120)
    warnings = flat_directions(SPACE, BEST, 1.0, points=BEST * np.exp(z), costs=costs, noise=NOISE)
    assert not flat(warnings)
    assert any(f.kind == "unknown" and "D" in f.parameters for f in warnings)


def test_flatness_is_unknown_without_repeats():
    warnings = findings(lambda z: 1.0 + z[0] ** 2, noise=float("nan"))
    assert [f.kind for f in warnings] == ["unknown"]


@pytest.mark.parametrize(
    ("factors", "named"),
    [
        ((1.0, 1.0, 1.0, 1.0), {}),
        ((100.0, 1.0, 1.0, 1.0), {"P": "upper"}),
        ((1.0, 0.01, 1.0, 97.0), {"I": "lower", "setpoint_filter_s": "upper"}),
        ((50.0, 0.02, 1.0, 1.0), {}),
    ],
)
def test_bound_warning_names_parameter_and_side(factors, named):
    warnings = at_bounds(SPACE, tuple(np.multiply(BEST, factors)))
    sides = {f.parameters[0]: f.sentence for f in warnings}
    assert sides.keys() == named.keys()
    assert all(f"at its {side} bound" in sides[name] for name, side in named.items())


@pytest.mark.parametrize(
    ("share", "words"),
    [(math.inf, None), (0.3, None), (0.11, "gains is 11% of"), (-0.2, "gains is 0% of")],
)
def test_near_limits_warns_below_the_share(share, words):
    sentences = [finding.sentence for finding in near_limits(share, "tension or effort")]
    assert len(sentences) == (words is not None)
    assert all(words in sentence for sentence in sentences)


@pytest.mark.parametrize(
    ("loop_margins", "words"),
    [
        (Margins(4.0, 55.0, 5.0, 20.0, stable=True), None),
        (Margins(4.0, 20.0, 5.0, 20.0, stable=True), "phase margin of 20°"),
        (Margins(1.5, 55.0, 5.0, 20.0, stable=True), "gain margin of 3.5 dB"),
        (Margins(math.nan, math.nan, math.nan, math.nan, stable=False), "unstable"),
        (None, None),
    ],
)
def test_low_margins_warns_below_usual_values(loop_margins, words):
    sentences = [finding.sentence for finding in low_margins(loop_margins)]
    assert len(sentences) == (words is not None)
    assert all(words in sentence for sentence in sentences)


def test_low_margins_of_a_tuner_without_limits_are_not_put_down_to_the_loop():
    loop = Margins(4.0, 20.0, 5.0, 20.0, stable=True)
    (warning,) = low_margins(loop, limited=True, by_records=False)
    assert "linear" not in warning.sentence.removeprefix("the phase margin")
    assert "tune with --tuner model_based" in warning.sentence
