"""Discrete filters agree with those of SciPy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from estune.core.filtering import lfilter

coefficients = st.lists(st.floats(-2.0, 2.0), min_size=1, max_size=4)


@given(
    coefficients,
    st.lists(st.floats(-0.95, 0.95), max_size=3),
    st.sampled_from([(7,), (3, 40), (2, 2, 9)]),
)
def test_filter_gives_the_output_of_scipy(numerator, poles, shape):
    denominator = 2.0 * np.atleast_1d(np.poly(poles))
    samples = np.random.default_rng(1).standard_normal(shape)
    expected = signal.lfilter(numerator, denominator, samples)
    assert lfilter(numerator, denominator, samples) == pytest.approx(expected, abs=1e-9)
