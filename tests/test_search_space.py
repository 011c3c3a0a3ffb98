"""The search space: coordinates, bounds, gains, and refused input."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.tuners.search_space import SearchSpace

GAINS = Gains(1.3, 50.0, 0.02, 0.01)
SPACE = SearchSpace.around(GAINS, 100.0)


def space(**changes):
    plain = {"names": ("P", "I"), "start": (1.0, 10.0), "low": (0.1, 1.0), "high": (10.0, 100.0)}
    return SearchSpace(**{**plain, **changes})


@given(st.lists(st.floats(allow_nan=False), min_size=4, max_size=4))
def test_point_is_within_the_bounds_for_any_coordinates(coordinates):
    for scale in ("log", "linear"):
        bounded = SearchSpace(SPACE.names, SPACE.start, SPACE.low, SPACE.high, scale=scale)
        point = bounded.point(tuple(coordinates))
        rows = zip(SPACE.low, point, SPACE.high, strict=True)
        assert all(low <= value <= high for low, value, high in rows)


@given(st.tuples(*[st.floats(-4.6, 4.6)] * 4))
def test_coordinates_invert_point(offsets):
    origin = SPACE.coordinates(SPACE.start)
    expected = tuple(o + d for o, d in zip(origin, offsets, strict=True))
    assert SPACE.coordinates(SPACE.point(expected)) == pytest.approx(expected, abs=1e-12)


def test_space_around_gains_extends_by_the_factor():
    assert SPACE.gains(SPACE.start) == GAINS
    assert SPACE.low == pytest.approx([v / 100 for v in GAINS.as_tuple()])
    assert SPACE.high == pytest.approx([v * 100 for v in GAINS.as_tuple()])
    assert SearchSpace.around(GAINS, bounds={"I": (40, 60)}).low[1] == 40.0


def test_zero_gain_is_held_at_zero_and_bounds_for_it_are_refused():
    space_around = SearchSpace.around(Gains(1.0, 10.0, 0.0, 0.0))
    assert space_around.names == ("P", "I")
    assert space_around.gains((2.0, 20.0)) == Gains(2.0, 20.0, 0.0, 0.0)
    for low in (0.0, 0.001):
        with pytest.raises(InvalidInput, match=r"D: (start|lower bound) 0 "):
            SearchSpace.around(Gains(1.0, 10.0, 0.0, 0.0), bounds={"D": (low, 0.1)})


@pytest.mark.parametrize("form", ["parallel", "standard"])
def test_directions_are_the_slopes_of_the_logarithms_of_the_gains(form):
    space = SearchSpace.around(GAINS, form=form)
    for n, direction in enumerate(space.directions):
        moved = [x * (np.e if i == n else 1.0) for i, x in enumerate(space.start)]
        ratios = np.divide(space.gains(tuple(moved)).as_tuple(), GAINS.as_tuple())
        assert np.log(ratios) == pytest.approx(direction)


def test_standard_form_gives_the_gains_of_the_parallel_form():
    standard = SearchSpace.around(GAINS, form="standard")
    assert standard.names == ("K", "Ti", "Td", "setpoint_filter_s")
    assert standard.gains(standard.start).as_tuple() == pytest.approx(GAINS.as_tuple())
    K, Ti, Td, tau = 2.0, 0.5, 0.1, 0.01
    assert standard.gains((K, Ti, Td, tau)) == Gains(K, K / Ti, K * Td, tau)


def test_untuned_parameters_keep_their_fixed_value():
    gains = space(fixed=(("D", 0.02),)).gains((2.0, 20.0))
    assert gains == Gains(2.0, 20.0, 0.02, 0.0)


def test_bounds_reached_are_named_by_parameter_and_side():
    low, high = SPACE.low, SPACE.high
    inside = tuple(math.sqrt(a * b) for a, b in zip(low, high, strict=True))
    assert SPACE.at_bound(inside) == {}
    assert SPACE.at_bound((low[0], high[1], *inside[2:])) == {"P": "low", "I": "high"}
    assert SPACE.at_bound((low[0] * 1.001, *inside[1:])) == {"P": "low"}
    assert SPACE.at_bound((low[0] * 1.1, *inside[1:])) == {}


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"low": (20.0, 1.0)}, ["P", "lower bound 20", "upper bound 10", "swap"]),
        ({"start": (11.0, 10.0)}, ["P", "start 11", "0.1 to 10", "widen the bounds"]),
        ({"start": (math.nan, 10.0)}, ["P", "start is nan", "finite"]),
        ({"high": (10.0, math.inf)}, ["I", "upper bound is inf", "finite"]),
        ({"low": (0.0, 1.0)}, ["P", "lower bound 0", "logarithm", "above zero"]),
        ({"low": (-1.0, 1.0)}, ["P", "lower bound -1", "logarithm"]),
        ({"low": (-1.0, 1.0), "scale": "linear"}, ["P", "lower bound -1", "negative"]),
        ({"names": ("P", "Ti")}, ["Ti", "parallel", "P, I, D"]),
        ({"names": ("P", "P")}, ["P", "more than once"]),
        ({"names": ("I", "D")}, ["P is neither tuned nor fixed"]),
        ({"names": ("P", "I", "D")}, ["names 3", "gives 2"]),
        ({"names": (), "start": (), "low": (), "high": ()}, ["no parameter"]),
        ({"fixed": (("D", -1.0),)}, ["D", "-1", "zero or above"]),
        ({"scale": "decibel"}, ["decibel", "'log' or 'linear'"]),
        ({"form": "series"}, ["series", "'parallel' or 'standard'"]),
    ],
)
def test_invalid_space_is_refused_with_a_remedy(changes, named):
    with pytest.raises(InvalidInput) as caught:
        space(**changes)
    message = str(caught.value)
    assert "\n" not in message
    assert all(part in message for part in named), message


@pytest.mark.parametrize("factor", [1.0, 0.5, math.nan, math.inf])
def test_factor_of_one_or_less_is_refused(factor):
    with pytest.raises(InvalidInput, match="factor"):
        SearchSpace.around(GAINS, factor)


def test_bounds_of_an_unknown_parameter_are_refused():
    with pytest.raises(InvalidInput, match="'Ti'"):
        SearchSpace.around(GAINS, bounds={"Ti": (1.0, 2.0)})
