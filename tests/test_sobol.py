"""The points of the Sobol sequence."""

import numpy as np
import pytest
from scipy.stats import qmc

from estune.loop_model.sobol import sobol_points


@pytest.mark.parametrize("dimensions", [1, 2, 3, 4])
def test_sobol_points_are_those_of_scipy(dimensions: int) -> None:
    expected = qmc.Sobol(dimensions, scramble=False).random(256)
    np.testing.assert_array_equal(sobol_points(dimensions, 256), expected)
