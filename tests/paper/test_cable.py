"""The cable, against numerical integration of its differential equation and other mechanics."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_bvp, solve_ivp
from scipy.linalg import eigh_tridiagonal

from estune.errors import InvalidInput
from experiments.paper import cable
from plants.models.path_structure import GRAVITY_M_S2

TOLERANCE = {"rtol": 1e-12, "atol": 1e-13, "method": "DOP853"}

# (T_x, mean of asinh(V/T_x), half its change, weight): taut to slack, sloping to nearly upright.
courses = st.tuples(
    st.floats(0.05, 50.0), st.floats(-4.0, 4.0), st.floats(1e-3, 4.0), st.floats(0.01, 5.0)
)


def quantities(H, m, d, w):
    """The eight quantities of a cable, from its hyperbolic parametrisation."""
    swept = 2.0 * H * np.sinh(d) / w
    values = (
        *(swept * np.cosh(m), swept * np.sinh(m), 2.0 * H * d / w, H),
        *(H * np.sinh(m - d), H * np.sinh(m + d), H * np.cosh(m - d), H * np.cosh(m + d)),
    )
    return dict(zip(cable.NAMES, values, strict=True))


def integrated(w, H, slope, span):
    """Rise and length of a cable over a span, from `z'' = w/H sqrt(1 + z'^2)`."""

    def course(_x, y):
        grows = np.hypot(1.0, y[1])
        return [y[1], w / H * grows, grows]

    end = solve_ivp(course, (0.0, span), [0.0, slope, 0.0], **TOLERANCE)
    assert end.success
    return end.y[0, -1], end.y[2, -1], end.y[1, -1]


@pytest.mark.equation(3)
@pytest.mark.equation(4)
@pytest.mark.equation(5)
@given(st.floats(0.05, 50.0), st.floats(0.01, 5.0), st.floats(-5.0, 5.0), st.floats(0.02, 6.0))
def test_catenary_solves_the_differential_equation(H, w, slope, swing):
    span = swing * H / w
    rise, length, far_slope = integrated(w, H, slope, span)
    near = dict(zip(cable.NAMES, (length, rise, span), strict=False))
    for given_values in (
        near,
        {"length_m": length, "rise_m": rise, "tension_1_N": H * np.hypot(1.0, slope)},
        {"span_m": span, "tension_x_N": H, "tension_1z_N": H * slope},
    ):
        c = cable.catenary(w, **given_values)
        expected = (length, rise, span, H, H * slope, H * far_slope)
        sizes = (length, length, span, H, c.tension_1_N, c.tension_3_N)
        for name, value, size in zip(cable.NAMES, expected, sizes, strict=False):
            assert getattr(c, name) == pytest.approx(value, abs=1e-7 * size)


@pytest.mark.equation(3)
def test_catenary_between_two_points_solves_the_boundary_value_problem():
    span, rise, length, w = 1.2, 0.7, 1.6, 0.0687

    def course(_x, y, curvature):
        grows = np.hypot(1.0, y[1])
        return np.stack([y[1], curvature[0] * grows, grows])

    def ends(y, z, _curvature):
        return np.array([y[0], y[2], z[0] - rise, z[2] - length])

    x = np.linspace(0.0, span, 41)
    z, slope = rise / span * x - x * (span - x), rise / span - span + 2.0 * x  # a parabola
    start = np.stack([z, slope, length / span * x])
    solved = solve_bvp(course, ends, x, start, p=[2.0], tol=1e-9, max_nodes=10_000)
    assert solved.success
    c = cable.catenary(w, span_m=span, rise_m=rise, length_m=length)
    assert w / c.tension_x_N == pytest.approx(solved.p[0], rel=1e-7)
    x, z, _ = c.points(5)
    assert z == pytest.approx(solved.sol(x)[0], abs=1e-7)


@pytest.mark.equation(6)
@given(courses)
def test_far_tension_includes_the_weight_of_the_cable(course):
    H, m, d, w = course
    q = quantities(H, m, d, w)
    T = np.array([H, q["tension_1z_N"]])
    for piece in np.full(1000, q["length_m"] / 1000.0):  # each piece in equilibrium by itself
        T[1] += w * piece
    far = cable.far_tension_N([H, q["tension_1z_N"]], w, q["length_m"])
    assert far == pytest.approx(T, rel=1e-9, abs=1e-9 * q["tension_1_N"])
    assert np.hypot(*far) == pytest.approx(q["tension_3_N"], rel=1e-9)


def test_admissible_triples_are_the_independent_ones():
    def logarithms(point):
        return np.array(list(quantities(*point, 1.0).values()))

    point = np.array([1.3, 0.4, 0.7])
    columns = []
    for i in range(3):
        step = np.zeros(3)
        step[i] = 1e-6
        columns.append((logarithms(point + step) - logarithms(point - step)) / 2e-6)
    jacobian = np.array(columns).T
    for rows in combinations(range(8), 3):
        singular = np.linalg.svd(jacobian[list(rows)], compute_uv=False)
        independent = singular[-1] > 1e-6 * singular[0]
        assert (frozenset(cable.NAMES[r] for r in rows) in cable.ADMISSIBLE) == independent
    assert len(cable.ADMISSIBLE) == 52


@pytest.mark.parametrize(
    ("triple", "solutions"), cable.ADMISSIBLE.items(), ids=lambda v: " ".join(sorted(v))
)
def test_catenary_is_recovered_from_any_admissible_triple(triple, solutions):
    rng = np.random.default_rng(3)
    n = 3000
    H, w = np.exp(rng.uniform(-3.0, 3.0, n)), np.exp(rng.uniform(-5.0, 2.0, n))
    m, d = rng.uniform(-3.0, 3.0, n), np.exp(rng.uniform(np.log(1e-3), np.log(3.0), n))
    truth = quantities(H, m, d, w)
    given_values = {name: truth[name] for name in triple}
    curves = [cable.catenary(w, solution=s, **given_values) for s in solutions]
    for c in curves:
        assert np.max(c.residual()) < 1e-9
        for name in triple:
            assert np.array_equal(getattr(c, name), given_values[name])
    # One solution is the original cable; `solution` names the two by their order.
    # Ill-conditioned triples keep fewer digits; four are required of all.
    errors = [
        np.max(
            [np.abs(getattr(c, f"tension_{k}_N") / truth[f"tension_{k}_N"] - 1.0) for k in "x13"],
            0,
        )
        for c in curves
    ]
    assert np.max(np.min(errors, axis=0)) < 1e-4
    if len(curves) == 2:
        name = "length_m" if solutions[0] == "shorter" else "rise_m"
        assert np.all(getattr(curves[0], name) <= getattr(curves[1], name))


@given(courses, st.sampled_from(sorted(map(sorted, cable.ADMISSIBLE))))
def test_catenary_is_solved_or_rejected_with_a_reason(course, triple):
    H, m, d, w = course
    truth = quantities(H, 3.0 * m, d / 4.0, w)  # nearly vertical, and taut to the last digits
    for solution in cable.ADMISSIBLE[frozenset(triple)]:
        message, residual = "", 0.0
        try:
            c = cable.catenary(w, solution=solution, **{n: truth[n] for n in triple})
            residual = c.residual()
        except InvalidInput as refused:
            message = str(refused)
        assert residual < 1e-9
        assert not message or "rounding" in message or "no cable hangs so" in message


@pytest.mark.parametrize(
    ("given_values", "bound"),
    [
        ({"span_m": 3.0, "rise_m": 4.0, "length_m": 5.0}, "exceed the distance of 5 m"),
        ({"length_m": 2.0, "rise_m": 1.0, "tension_1_N": 0.049}, "more than 0.05 N"),
        ({"length_m": 2.0, "rise_m": 1.0, "tension_3_N": 0.149}, "more than 0.15 N"),
        ({"span_m": 2.0, "rise_m": 0.0, "tension_1_N": 0.1508}, "0.150888 N or more"),
        ({"span_m": 1.0, "length_m": 1.5, "tension_1_N": 0.01}, "at most span_m"),
        ({"span_m": 1.0, "length_m": 1.5, "tension_x_N": 0.01}, "at least 14.8"),
        ({"tension_1_N": 1.0, "tension_x_N": 2.0, "length_m": 1.0}, "tension_x_N of 2 N"),
        ({"rise_m": -20.0, "tension_1_N": 1.0, "tension_x_N": 0.5}, "would be -1 N"),
        ({"rise_m": 0.0, "length_m": 1.0, "tension_1z_N": -0.05}, "half the weight for any"),
        ({"length_m": 1.0, "rise_m": 0.5, "tension_x_N": 0.0}, "above 0 N"),
        ({"length_m": [1.0, np.nan], "rise_m": 0.5, "tension_x_N": 1.0}, "nan m at index 1"),
        ({"length_m": 1.0, "rise_m": 0.5}, "determined by three"),
        ({"length_m": 1.0, "tension_1z_N": 0.5, "tension_3z_N": 0.6}, "not independent"),
        ({"length_m": 1.0, "rise_m": 0.5, "height_m": 0.5}, "no height_m"),
        ({"length_m": [1.0, 2.0], "rise_m": [0.5] * 3, "tension_x_N": 1.0}, "do not broadcast"),
    ],
)
def test_impossible_catenary_is_rejected_with_its_bound(given_values, bound):
    solution = cable.ADMISSIBLE.get(frozenset(given_values), ("only",))[0]
    with pytest.raises(InvalidInput, match=bound):
        cable.catenary(0.1, solution=solution, **given_values)


def test_bounds_of_the_catenary_are_sharp():
    # A level cable's |T_1| is w dx/2 cosh(d)/d, which is least, 1.50888 w dx/2, at d tanh(d) = 1.
    c = cable.catenary(0.1, solution="shorter", span_m=2.0, rise_m=0.0, tension_1_N=0.15089)
    assert c.tension_1_N == 0.15089
    assert cable.catenary(0.1, length_m=2.0, rise_m=1.0, tension_1_N=0.0501).residual() < 1e-9
    assert cable.catenary(0.1, span_m=3.0, rise_m=4.0, length_m=5.0 + 1e-9).tension_x_N > 1e3


def test_ambiguous_catenary_needs_a_chosen_solution():
    given_values = {"span_m": 1.0, "rise_m": 0.3, "tension_1_N": 0.5}
    with pytest.raises(InvalidInput, match=r"two cables fit.*'shorter'.*'longer'"):
        cable.catenary(0.07, **given_values)
    taut = cable.catenary(0.07, solution="shorter", **given_values)
    assert taut.length_m < 1.1 < cable.catenary(0.07, solution="longer", **given_values).length_m
    with pytest.raises(InvalidInput, match="it is 'only' or 'shorter' or 'longer'"):
        cable.catenary(0.07, solution="lower", **given_values)


def test_catenary_of_scalars_is_floats_and_of_arrays_arrays():
    c = cable.catenary(0.07, span_m=1.0, rise_m=0.3, length_m=1.2)
    assert type(c.tension_x_N) is type(c.residual()) is float
    c = cable.catenary(0.07, span_m=np.ones((2, 1, 3)), rise_m=np.zeros((4, 1)), length_m=1.2)
    assert c.tension_3_N.shape == c.residual().shape == (2, 4, 3)
    assert c.points(7)[0].shape == (2, 4, 3, 7)


def test_taut_catenary_approaches_the_parabola():
    # Sag of a taut level cable: w L^2/(8 H), length L (1 + w^2 L^2/(24 H^2)).
    H, w, span = 1e3, 0.07, 2.0
    c = cable.catenary(w, span_m=span, rise_m=0.0, tension_x_N=H)
    _, z, _ = c.points(3)
    assert z[1] == pytest.approx(-w * span**2 / (8.0 * H), rel=1e-7)
    assert c.length_m - span == pytest.approx(span * (w * span / H) ** 2 / 24.0, rel=1e-4)


@pytest.mark.equation(1)
@given(st.floats(-1.5, 1.5), st.floats(0.01, 0.3), st.floats(0.1, 5.0))
def test_least_taut_tension_is_uniform_within_beta(angle, beta, length):
    mu = 0.007
    T = cable.least_taut_tension_N(mu, length, beta)
    assert mu * GRAVITY_M_S2 * length / T == pytest.approx(beta)

    # Pieces of cable, each in equilibrium, upright at worst; (1) bounds the change of tension.
    pieces = np.full(2000, mu * GRAVITY_M_S2 * length / 2000.0)
    V = T * np.sin(angle) + np.concatenate([[0.0], np.cumsum(pieces)])
    along = np.hypot(T * np.cos(angle), V)
    assert np.max(np.abs(along / T - 1.0)) <= beta * (1.0 + 1e-9)
    upright = np.abs(T + np.cumsum(pieces))
    assert np.max(np.abs(upright / T - 1.0)) == pytest.approx(beta)


@pytest.mark.equation(1)
@pytest.mark.equation(2)
@given(st.floats(0.5, 5.0), st.floats(0.02, 0.3), st.floats(0.5, 1e4))
def test_least_taut_tension_uses_the_loaded_density_of_an_elastic_cable(length, beta, EA):
    T = cable.least_taut_tension_N(0.02, length, beta, EA)
    mu = cable.loaded_density_kg_m(0.02, T, EA)
    assert T * beta == pytest.approx(mu * GRAVITY_M_S2 * length, rel=1e-12)


@pytest.mark.equation(2)
def test_loaded_density_matches_a_row_of_springs():
    mu_0, T, EA, length, count = 0.007, 30.0, 400.0, 1.3, 1000
    spring_N_m = EA / (length / count)
    stretched = sum(length / count + T / spring_N_m for _ in range(count))
    assert cable.loaded_density_kg_m(mu_0, T, EA) == pytest.approx(mu_0 * length / stretched)


@pytest.mark.equation(7)
@given(st.floats(0.02, 40.0), st.floats(-30.0, 30.0), st.floats(0.2, 5.0), st.floats(5.0, 1e6))
def test_elastic_rise_solves_the_differential_equation(H, V_1, rest, EA):
    mu_0 = 0.05
    w = mu_0 * GRAVITY_M_S2

    def climb(p, _y):
        V = V_1 + w * p
        T = np.hypot(H, V)
        return [V / T * (1.0 + T / EA), 1.0 + T / EA]

    rise, length = solve_ivp(climb, (0.0, rest), [0.0, 0.0], **TOLERANCE).y[:, -1]
    T_1, T_3 = np.hypot(H, V_1), np.hypot(H, V_1 + w * rest)
    by_tensions = cable.elastic_rise_m(mu_0, EA, T_1, T_3)
    rounding = 1e-14 * max(T_1, T_3) * (1.0 + T_1 / EA) / w
    assert by_tensions == pytest.approx(rise, abs=1e-9 * length + rounding)


def test_catenary_rejects_results_lost_in_rounding():
    with pytest.raises(InvalidInput, match="rounding"):
        cable.catenary(1.0, solution="shorter", span_m=1.0, rise_m=1e12, tension_1_N=30.0)


@pytest.mark.equation(31)
@pytest.mark.parametrize("order", [1, 2, 3])
def test_string_frequency_matches_a_row_of_beads(order):
    mu, length, T, beads = 0.007, 0.8, 15.0, 4000
    spacing = length / beads
    diagonal = np.full(beads - 1, 2.0 * T / (mu * spacing**2))
    squares = eigh_tridiagonal(
        diagonal,
        -0.5 * diagonal[:-1],
        eigvals_only=True,
        select="i",
        select_range=(order - 1, order - 1),
    )
    expected = np.sqrt(squares[0]) / (2.0 * np.pi)
    assert cable.string_frequency_Hz(mu, length, T, order) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    "call",
    [
        lambda: cable.string_frequency_Hz(0.007, 0.8, 15.0, 1.5),
        lambda: cable.string_frequency_Hz(0.007, 0.0, 15.0),
        lambda: cable.least_taut_tension_N(0.007, 0.8, 1.0),
        lambda: cable.loaded_density_kg_m(0.007, np.inf, 1e4),
        lambda: cable.string_frequency_Hz(0.007, 0.8, "fifteen"),
        lambda: cable.elastic_rise_m(0.007, -1e4, 1.0, 2.0),
        lambda: cable.far_tension_N([1.0, 2.0, 3.0], 0.1, 1.0),
        lambda: cable.catenary(0.1, span_m=1.0, rise_m=0.0, length_m=1.2).points(1),
    ],
)
def test_cable_functions_reject_values_out_of_range(call):
    with pytest.raises(InvalidInput):
        call()
