"""Friction at an eyelet: angles, forces, attenuation ratio and transparency."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.stats import gmean

from estune.errors import InvalidInput
from experiments.paper import two_reels as tr
from experiments.paper.two_reels import contact, friction_ratio, geometry, index

cones = st.floats(0.0, 1.5)
turns = st.floats(-7.0, 7.0)
coefficients = st.floats(0.0, 0.95)
angles = st.floats(0.0, 3.1)
tensions = st.floats(0.1, 200.0)


# Geometry


@pytest.mark.equation(11)
@pytest.mark.equation(12)
@given(cones, turns)
def test_directions_are_the_tilted_and_turned_axis(theta, phi):
    turn = Rotation.from_euler("z", phi)
    inside = (turn * Rotation.from_euler("y", theta)).apply([0.0, 0.0, 1.0])
    outside = (turn * Rotation.from_euler("y", -theta)).apply([0.0, 0.0, -1.0])
    assert geometry.direction_inside(theta, phi) == pytest.approx(inside, abs=1e-12)
    assert geometry.direction_outside(theta, phi) == pytest.approx(outside, abs=1e-12)


@pytest.mark.equation(13)
@given(cones, turns, cones, turns)
def test_eyelet_angle_is_between_the_two_directions(theta_1, phi_1, theta_2, phi_2):
    outside = Rotation.from_euler("yz", [-theta_1, phi_1]).apply([0.0, 0.0, -1.0])
    inside = Rotation.from_euler("yz", [theta_2, phi_2]).apply([0.0, 0.0, 1.0])
    gamma = geometry.eyelet_angle_rad(theta_1, phi_1, theta_2, phi_2)
    assert math.cos(gamma) == pytest.approx(outside @ inside, abs=1e-12)


def test_angle_of_a_nearly_straight_cable_is_accurate():
    assert math.pi - geometry.eyelet_angle_rad(1e-9, 0.3, 0.0, 0.0) == pytest.approx(
        1e-9, rel=1e-6
    )


def test_contact_line_is_normal_to_both_directions():
    P_1, P_2 = (
        geometry.direction_outside([0.3, 1.0], 0.2),
        geometry.direction_inside(0.8, [2.0, 0.1]),
    )
    line = geometry.contact_line(P_1, P_2)
    assert np.sum(line * P_1, axis=-1) == pytest.approx([0.0, 0.0], abs=1e-15)
    assert np.sum(line * P_2, axis=-1) == pytest.approx([0.0, 0.0], abs=1e-15)


# Forces at one contact


@pytest.mark.equation(14)
@given(st.floats(0.0, 1.57), st.integers(0, 1000), tensions)
def test_contact_force_splits_along_and_across_the_line(Psi, seed, size):
    frame = Rotation.random(random_state=seed)
    line = frame.apply([1.0, 0.0, 0.0])
    force = size * frame.apply([math.sin(Psi), 0.0, math.cos(Psi)])
    split = contact.split_contact_force(force, -3.0 * line)
    assert split.normal_N == pytest.approx(size * math.cos(Psi), abs=1e-9)
    assert split.lateral_N == pytest.approx(size * math.sin(Psi), abs=1e-9)
    assert split.angle_rad == pytest.approx(Psi, abs=1e-9)


def capstan(coefficient, wrap, tension_2):
    """Tension outside, and force on a drum as a vector, from the pressure along the wrap."""

    def tension(phi):
        return tension_2 * math.exp(-coefficient * phi)

    friction, _ = quad(lambda phi: coefficient * tension(phi), 0.0, wrap)
    # The cable arrives along -x, turns towards +y, presses inwards and drags against its motion.
    press = [
        quad(lambda phi, a=axis: tension(phi) * (a(phi)), 0.0, wrap)[0]
        for axis in (
            lambda phi: math.sin(phi) - coefficient * math.cos(phi),
            lambda phi: -math.cos(phi) - coefficient * math.sin(phi),
        )
    ]
    return friction, np.array(press)


@pytest.mark.equation(15)
@pytest.mark.equation(18)
@pytest.mark.equation(19)
@given(st.floats(0.0, 0.9), st.floats(1e-3, 3.0), tensions)
def test_tensions_balance_friction_and_pressure_along_a_wrap(coefficient, wrap, T_2):
    friction, press = capstan(coefficient, wrap, T_2)
    outside_N = contact.tension_outside_N(T_2, friction)
    assert outside_N == pytest.approx(T_2 * math.exp(-coefficient * wrap), rel=1e-9)
    size = contact.contact_force_N(outside_N, T_2, math.pi - wrap)
    assert size == pytest.approx(np.hypot(*press), rel=1e-8)


@pytest.mark.equation(16)
@pytest.mark.equation(20)
@given(st.floats(0.05, 0.9), st.floats(0.05, 0.9), st.floats(0.0, 0.95), st.floats(1.0, 100.0))
def test_cable_sticks_up_to_the_friction_ellipse(C_R, C_L, share, size):
    """Brute force: the contact's friction forces fill an ellipse."""
    Psi = share * math.atan(C_L)
    normal, lateral = size * math.cos(Psi), size * math.sin(Psi)
    around = np.linspace(0.0, math.pi / 2.0, 20001)
    enough = C_L * normal * np.sin(around) >= lateral
    greatest = float(np.max(C_R * normal * np.cos(around[enough])))
    assert contact.friction_N(size, C_R, Psi, C_L) == pytest.approx(greatest, rel=1e-3)
    force = contact.ContactForce(normal, lateral, Psi)
    assert contact.sticks(force, 0.998 * greatest, C_R, C_L)
    assert not contact.sticks(force, 1.002 * greatest, C_R, C_L)
    assert contact.friction_N(size, C_R) == pytest.approx(C_R * size)


@pytest.mark.equation(17)
@given(tensions, tensions, angles)
def test_plane_tensions_have_the_given_sizes_and_angle(T_1, T_2, gamma):
    outside, inside = contact.plane_tensions_N(T_1, T_2, gamma)
    assert np.linalg.norm(outside) == pytest.approx(T_1)
    assert np.linalg.norm(inside) == pytest.approx(T_2)
    turned = math.atan2(outside[1], outside[0]) - math.atan2(inside[1], inside[0])
    assert turned == pytest.approx(gamma, abs=1e-12)


# Attenuation ratio


def slides_at(coefficient, gamma, T_2=1.0):
    """Tension outside at which friction just fails to hold, found by bisection on vectors."""

    def excess(T_1):
        outside = T_1 * np.array([math.cos(gamma), math.sin(gamma)])
        return T_2 - T_1 - coefficient * np.linalg.norm(outside + np.array([T_2, 0.0]))

    return brentq(excess, 0.0, T_2, xtol=1e-15, rtol=1e-14)


@pytest.mark.equation(21)
@pytest.mark.equation(22)
@pytest.mark.equation(23)
@pytest.mark.equation(24)
@given(coefficients, angles, tensions)
def test_attenuation_balances_the_vectors(coefficient, gamma, T_2):
    T_1 = slides_at(coefficient, gamma, T_2)
    B = friction_ratio.attenuation(coefficient, gamma)
    assert friction_ratio.attenuated_tension_N(T_2, B) == pytest.approx(T_1, rel=1e-9)
    assert friction_ratio.sliding_excess_N(T_1, T_2, coefficient, gamma) == pytest.approx(
        0.0, abs=1e-9 * T_2
    )
    assert friction_ratio.sliding_excess_N(0.9 * T_1, T_2, coefficient, gamma) > 0.0
    both = np.roots([1.0, -2.0 * friction_ratio.capital_gamma(coefficient, gamma), 1.0])
    assert min(both.real) == pytest.approx(B, rel=1e-6)


@pytest.mark.equation(25)
@given(st.floats(0.0, 0.9), angles, tensions)
def test_capital_gamma_is_the_coefficient_of_the_quadratic(coefficient, gamma, T_2):
    """Polynomial in the outside tension through three samples of the square of (21)."""
    at = T_2 * np.array([0.0, 1.0, 2.0])
    outside = at[:, None] * [math.cos(gamma), math.sin(gamma)]
    press = np.linalg.norm(outside + np.array([T_2, 0.0]), axis=1)
    constant, linear, square = np.polynomial.polynomial.polyfit(
        at / T_2, ((T_2 - at) ** 2 - (coefficient * press) ** 2) / T_2**2, 2
    )
    assert constant == pytest.approx(square, rel=1e-9)
    assert friction_ratio.capital_gamma(coefficient, gamma) == pytest.approx(
        -0.5 * linear / square, rel=1e-9
    )


@pytest.mark.equation(26)
@pytest.mark.parametrize("wrap", [0.3, 1.5, 3.0])
def test_many_small_contacts_approach_a_capstan(wrap):
    n, friction_angle = 2000, 0.3
    parts = [friction_ratio.attenuation(math.sin(friction_angle), math.pi - wrap / n)] * n
    expected = math.exp(-math.tan(friction_angle) * wrap)
    assert friction_ratio.equivalent_attenuation(*parts) == pytest.approx(expected, rel=1e-6)


@given(
    st.floats(1e-4, 0.95),
    st.lists(angles, min_size=1, max_size=4),
)
def test_friction_coefficient_equals_the_root_by_bisection(coefficient, gammas):
    B = math.prod(slides_at(coefficient, gamma) for gamma in gammas)
    computed = friction_ratio.friction_coefficient(B, *gammas)
    assert friction_ratio.attenuation(computed, *gammas) == pytest.approx(B, rel=1e-12)

    def missing(C):
        ratios = []
        for gamma in gammas:
            G = (1.0 + C**2 * math.cos(gamma)) / (1.0 - C**2)
            ratios.append(1.0 / (G + math.sqrt(max(G**2 - 1.0, 0.0))))
        return math.prod(ratios) - B

    assert computed == pytest.approx(brentq(missing, 0.0, 0.999, xtol=1e-15), rel=1e-5)


def test_contact_functions_broadcast():
    C, gamma = np.linspace(0.05, 0.9, 4)[:, None], np.linspace(0.1, 3.0, 5)
    B = friction_ratio.attenuation(C, gamma, 2.0)
    assert B.shape == (4, 5)
    assert friction_ratio.friction_coefficient(B, gamma, 2.0) == pytest.approx(
        np.broadcast_to(C, (4, 5))
    )
    assert isinstance(friction_ratio.attenuation(0.1, 2.0), float)


# Transparency


@pytest.mark.equation(27)
@pytest.mark.equation(28)
def test_log_spread_and_mean_are_geometric_statistics():
    B = np.array([[0.95, 0.93, 0.91, 0.97], [0.8, 0.8, 0.8, 0.8]])
    assert np.exp(index.log_mean(B)) == pytest.approx(gmean(B, axis=1))
    ln = np.log(B[0]).tolist()
    by_pairs = sum((a - b) ** 2 for a in ln for b in ln) / (2.0 * len(ln) ** 2)
    assert index.log_spread(B[0]) == pytest.approx(math.sqrt(by_pairs))
    assert index.log_spread(B[1]) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.equation(29)
@given(coefficients, angles)
def test_friction_share_equals_one_minus_attenuation(C, gamma):
    T_1 = slides_at(C, gamma)
    share = index.friction_share(C, friction_ratio.attenuation(C, gamma), gamma)
    assert share == pytest.approx(1.0 - T_1, abs=1e-9)
    if abs(T_1 - 0.9) > 1e-6:
        assert (share < tr.WEBER_LIMIT) == (T_1 > 0.9)


@pytest.mark.parametrize(
    ("low", "value", "high", "verdict"),
    [
        (0.93, 0.94, 0.95, "transparent"),
        (0.85, 0.86, 0.87, "noticeable"),
        (0.89, 0.9, 0.92, "undecided"),
    ],
)
def test_weber_verdict_depends_on_the_interval(low, value, high, verdict):
    transparency = index.static_transparency([0.96, value], [0.95, low], [0.97, high])
    assert transparency.verdict == verdict


# Bad input


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: friction_ratio.attenuation(1.0, 2.0), "below 1"),
        (lambda: friction_ratio.attenuation(-0.1, 2.0), "friction coefficient is -0.1"),
        (lambda: friction_ratio.attenuation(0.1, 120.0), "in radians"),
        (lambda: friction_ratio.attenuation(0.1), "no angle"),
        (lambda: friction_ratio.attenuation([0.1, math.nan], 2.0), "at index 1"),
        (lambda: friction_ratio.friction_coefficient(0.0, 2.0), "attenuation ratio is 0"),
        (lambda: friction_ratio.friction_coefficient(1.02, 2.0), "at most 1"),
        (lambda: friction_ratio.friction_coefficient(0.9, math.pi), "straight cable"),
        (lambda: geometry.direction_outside(1.6, 0.0), "less than pi/2"),
        (lambda: geometry.contact_line([0, 0, 1], [0, 0, -2]), "collinear"),
        (lambda: geometry.angle_between_rad([0, 0, 0], [0, 0, 1]), "no length"),
        (lambda: geometry.angle_between_rad([0, 1], [0, 1]), "3 components"),
        (lambda: contact.friction_N(10.0, 0.2, 0.5, 0.3), "outside the friction cone"),
        (lambda: contact.tension_outside_N(5.0, 6.0), "slack"),
        (lambda: index.log_spread([]), "no attenuation ratio"),
    ],
)
def test_contact_functions_reject_bad_input_with_a_remedy(call, message):
    with pytest.raises(InvalidInput, match=message):
        call()
