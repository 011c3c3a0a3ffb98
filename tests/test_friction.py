import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from estune.errors import InvalidInput
from estune.reel.friction import StribeckFriction

DRY = StribeckFriction(coulomb_Nm=0.02, static_Nm=0.03, stribeck_rad_s=0.8)


def lugre_steady_friction(velocity, stiffness=50.0):
    """Steady friction at constant velocity by integration of the LuGre model."""
    fade = math.exp(-((velocity / DRY.stribeck_rad_s) ** 2))
    g = DRY.coulomb_Nm + (DRY.static_Nm - DRY.coulomb_Nm) * fade

    def rate(_, z):
        return velocity - stiffness * abs(velocity) * z / g

    solved = solve_ivp(rate, (0.0, 0.1 / abs(velocity)), [0.0], "Radau", rtol=1e-10, atol=1e-16)
    return stiffness * solved.y[0, -1]


@pytest.mark.equation(10)
@pytest.mark.parametrize("velocity", [-5.0, -0.7, -0.01, 0.02, 0.4, 0.8, 3.0])
def test_stribeck_friction_is_the_steady_state_of_the_lugre_model(velocity):
    assert DRY.torque_Nm(velocity) == pytest.approx(lugre_steady_friction(velocity), rel=1e-6)


@pytest.mark.equation(10)
def test_stribeck_friction_has_its_static_and_dynamic_limits():
    v = np.array([-1e-9, 0.0, 1e-9, 100.0])
    assert DRY.torque_Nm(v) == pytest.approx([-0.03, 0.0, 0.03, 0.02])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: StribeckFriction(0.03, 0.02, 1.0), "static one not below"),
        (lambda: StribeckFriction(-0.1, 0.02, 1.0), "zero or above"),
        (lambda: StribeckFriction(0.02, 0.03, 0.0), "Stribeck velocity"),
        (lambda: StribeckFriction(0.02, math.nan, 1.0), "not finite"),
    ],
)
def test_friction_out_of_range_is_refused(call, message):
    with pytest.raises(InvalidInput, match=message):
        call()
