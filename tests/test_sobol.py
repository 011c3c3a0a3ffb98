"""The points of the Sobol sequence."""

import numpy as np
import pytest
from scipy.stats import qmc

from estune.loop_model.sobol import DIMENSIONS_MAX, sobol_points


@pytest.mark.parametrize("dimensions", range(1, DIMENSIONS_MAX + 1))
def test_sobol_points_are_those_of_scipy(dimensions: int) -> None:
    expected = qmc.Sobol(dimensions, scramble=False).random(256)
    np.testing.assert_array_equal(sobol_points(dimensions, 256), expected)
