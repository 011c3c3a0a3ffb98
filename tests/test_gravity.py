"""The feed-forward of the cable's weight, against a cable integrated piece by piece."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from estune.errors import InvalidInput
from estune.reel.gravity import gravity_force_by_position_N, gravity_force_N

W = 0.07

hanging = st.tuples(st.floats(0.01, 50.0), st.floats(-1.55, 1.55), st.floats(0.1, 5.0))


def course(T_1, angle, length):
    """Far point and vertical tension of a cable that leaves the reel at an angle, integrated."""
    H, V_1 = T_1 * np.cos(angle), T_1 * np.sin(angle)

    def slopes(_s, y):
        T = np.hypot(H, y[2])
        return [H / T, y[2] / T, W]

    solved = solve_ivp(slopes, (0.0, length), [0.0, 0.0, V_1], rtol=1e-12, atol=1e-14)
    return solved.y[:, -1]


@pytest.mark.equation(8)
@given(hanging)
def test_compensation_is_the_weight_along_the_cable_at_the_reel(cable):
    T_1, angle, length = cable
    pieces = np.full(500, W * length / 500.0)  # weight acts downwards; component along the cable
    direction, down = np.array([np.cos(angle), np.sin(angle)]), np.array([0.0, -1.0])
    expected = sum(float(piece * down @ direction) for piece in pieces)
    force = gravity_force_N(W, length, tension_1z_N=T_1 * np.sin(angle), tension_1_N=T_1)
    assert force == pytest.approx(expected, abs=1e-12)


@pytest.mark.equation(9)
@given(hanging)
def test_compensation_by_position_agrees_with_the_integrated_cable(cable):
    T_1, angle, length = cable
    _, rise, V_3 = course(T_1, angle, length)
    force = gravity_force_by_position_N(W, length, rise_m=rise, tension_1_N=T_1)
    assert force == pytest.approx(-W * length * np.sin(angle), abs=1e-8 * W * length)
    # It equals the added tension to first order in weight over tension.
    added = np.hypot(T_1 * np.cos(angle), V_3) - T_1
    second_order = W**2 * (length**2 - rise**2) / (2.0 * T_1)
    assert force + added == pytest.approx(second_order, abs=1e-8 * (T_1 + W * length))


@given(st.floats(0.0, 10.0), st.floats(-10.0, 10.0), st.floats(-1.0, 1e3), st.floats(-1e3, 1e3))
def test_compensation_never_exceeds_the_weight(length, rise, tension, vertical):
    limit = W * length * (1.0 + 1e-12)
    assert abs(gravity_force_by_position_N(W, length, rise_m=rise, tension_1_N=tension)) <= limit
    force = gravity_force_N(W, length, tension_1z_N=vertical, tension_1_N=tension)
    assert abs(force) <= limit


@pytest.mark.equation(9)
def test_compensation_of_a_slack_cable_is_its_weight():
    tensions = np.array([50.0, 5.0, 0.5, 0.05, 1e-9, 0.0, -0.1])
    force = gravity_force_by_position_N(W, 2.0, rise_m=1.0, tension_1_N=tensions)
    assert np.all(np.diff(force) >= 0.0)
    assert force[0] == pytest.approx(-W, rel=1e-2)
    assert np.all(force[-3:] == W * 2.0)
    # The limit begins where (4) asks for a T_1z beyond |T_1|: at w (ds - dz)/2.
    edge = W * (2.0 - 1.0) / 2.0
    assert gravity_force_by_position_N(W, 2.0, rise_m=1.0, tension_1_N=1.001 * edge) < W * 2.0
    assert gravity_force_by_position_N(W, 2.0, rise_m=1.0, tension_1_N=0.999 * edge) == W * 2.0


def test_compensation_of_a_vertical_cable_is_its_signed_weight():
    force = gravity_force_by_position_N(W, 2.0, rise_m=np.array([2.0, -2.0]), tension_1_N=9.0)
    assert force == pytest.approx([-2.0 * W, 2.0 * W])
    assert type(gravity_force_N(W, 2.0, tension_1z_N=1.0, tension_1_N=9.0)) is float
    assert gravity_force_by_position_N(W, 0.0, rise_m=0.0, tension_1_N=9.0) == 0.0


@pytest.mark.parametrize(
    "wrong",
    [{"length_m": np.nan}, {"length_m": -1.0}, {"rise_m": np.inf}, {"tension_1_N": np.nan}],
)
def test_invalid_values_are_refused(wrong):
    given_ = {"length_m": 1.0, "rise_m": 0.5, "tension_1_N": 10.0} | wrong
    with pytest.raises(InvalidInput, match=next(iter(wrong))):
        gravity_force_by_position_N(W, **given_)
