"""The two-reel bench: friction at an eyelet, the procedure that measures it, and what it hides."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.stats import gmean

from estune.errors import InvalidInput, RigError
from plants import transparency as tr

SETPOINTS = (8.0, 16.0, 24.0, 32.0, 40.0)
GAUGE_Y = tr.Gauge(zero=3.0, sensitivity=0.8, curvature_per_N=1e-3)

cones = st.floats(0.0, 1.5)
turns = st.floats(-7.0, 7.0)
coefficients = st.floats(0.0, 0.95)
angles = st.floats(0.0, 3.1)
tensions = st.floats(0.1, 200.0)


# Geometry


@pytest.mark.equation(11)
@pytest.mark.equation(12)
@given(cones, turns)
def test_directions_are_the_axis_tilted_and_turned(theta, phi):
    turn = Rotation.from_euler("z", phi)
    inside = (turn * Rotation.from_euler("y", theta)).apply([0.0, 0.0, 1.0])
    outside = (turn * Rotation.from_euler("y", -theta)).apply([0.0, 0.0, -1.0])
    assert tr.direction_inside(theta, phi) == pytest.approx(inside, abs=1e-12)
    assert tr.direction_outside(theta, phi) == pytest.approx(outside, abs=1e-12)


@pytest.mark.equation(13)
@given(cones, turns, cones, turns)
def test_angle_at_the_eyelet_is_that_between_the_two_directions(theta_1, phi_1, theta_2, phi_2):
    outside = Rotation.from_euler("yz", [-theta_1, phi_1]).apply([0.0, 0.0, -1.0])
    inside = Rotation.from_euler("yz", [theta_2, phi_2]).apply([0.0, 0.0, 1.0])
    gamma = tr.eyelet_angle_rad(theta_1, phi_1, theta_2, phi_2)
    assert math.cos(gamma) == pytest.approx(outside @ inside, abs=1e-12)


def test_angle_of_an_almost_straight_cable_keeps_its_digits():
    assert math.pi - tr.eyelet_angle_rad(1e-9, 0.3, 0.0, 0.0) == pytest.approx(1e-9, rel=1e-6)


def test_contact_line_is_across_both_directions():
    P_1, P_2 = tr.direction_outside([0.3, 1.0], 0.2), tr.direction_inside(0.8, [2.0, 0.1])
    line = tr.contact_line(P_1, P_2)
    assert np.sum(line * P_1, axis=-1) == pytest.approx([0.0, 0.0], abs=1e-15)
    assert np.sum(line * P_2, axis=-1) == pytest.approx([0.0, 0.0], abs=1e-15)


# Forces at one contact


@pytest.mark.equation(14)
@given(st.floats(0.0, 1.57), st.integers(0, 1000), tensions)
def test_contact_force_splits_into_its_parts_along_and_across_the_line(Psi, seed, size):
    frame = Rotation.random(random_state=seed)
    line = frame.apply([1.0, 0.0, 0.0])
    force = size * frame.apply([math.sin(Psi), 0.0, math.cos(Psi)])
    split = tr.split_contact_force(force, -3.0 * line)
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
def test_tensions_balance_friction_and_pressure_summed_along_a_wrap(coefficient, wrap, T_2):
    friction, press = capstan(coefficient, wrap, T_2)
    left = tr.tension_outside_N(T_2, friction)
    assert left == pytest.approx(T_2 * math.exp(-coefficient * wrap), rel=1e-9)
    size = tr.contact_force_N(left, T_2, math.pi - wrap)
    assert size == pytest.approx(np.hypot(*press), rel=1e-8)


@pytest.mark.equation(16)
@pytest.mark.equation(20)
@given(st.floats(0.05, 0.9), st.floats(0.05, 0.9), st.floats(0.0, 0.95), st.floats(1.0, 100.0))
def test_cable_sticks_up_to_the_greatest_friction_in_the_ellipse(C_R, C_L, share, size):
    """Brute force: every friction the contact can give lies on an ellipse or within."""
    Psi = share * math.atan(C_L)
    normal, lateral = size * math.cos(Psi), size * math.sin(Psi)
    around = np.linspace(0.0, math.pi / 2.0, 20001)
    enough = C_L * normal * np.sin(around) >= lateral
    greatest = float(np.max(C_R * normal * np.cos(around[enough])))
    assert tr.friction_N(size, C_R, Psi, C_L) == pytest.approx(greatest, rel=1e-3)
    contact = tr.ContactForce(normal, lateral, Psi)
    assert tr.sticks(contact, 0.998 * greatest, C_R, C_L)
    assert not tr.sticks(contact, 1.002 * greatest, C_R, C_L)
    assert tr.friction_N(size, C_R) == pytest.approx(C_R * size)


@pytest.mark.equation(17)
@given(tensions, tensions, angles)
def test_plane_tensions_have_their_sizes_and_angle_from_any_frame(T_1, T_2, gamma):
    outside, inside = tr.plane_tensions_N(T_1, T_2, gamma)
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
def test_attenuation_is_where_the_vectors_balance(coefficient, gamma, T_2):
    T_1 = slides_at(coefficient, gamma, T_2)
    B = tr.attenuation(coefficient, gamma)
    assert tr.attenuated_tension_N(T_2, B) == pytest.approx(T_1, rel=1e-9)
    assert tr.sliding_excess_N(T_1, T_2, coefficient, gamma) == pytest.approx(0.0, abs=1e-9 * T_2)
    assert tr.sliding_excess_N(0.9 * T_1, T_2, coefficient, gamma) > 0.0
    both = np.roots([1.0, -2.0 * tr.capital_gamma(coefficient, gamma), 1.0])
    assert min(both.real) == pytest.approx(B, rel=1e-6)


@pytest.mark.equation(25)
@given(st.floats(0.0, 0.9), angles, tensions)
def test_capital_gamma_is_the_coefficient_of_the_squared_balance(coefficient, gamma, T_2):
    """The square of (21), sampled at three tensions, is a polynomial in the tension outside."""
    at = T_2 * np.array([0.0, 1.0, 2.0])
    outside = at[:, None] * [math.cos(gamma), math.sin(gamma)]
    press = np.linalg.norm(outside + np.array([T_2, 0.0]), axis=1)
    constant, linear, square = np.polynomial.polynomial.polyfit(
        at / T_2, ((T_2 - at) ** 2 - (coefficient * press) ** 2) / T_2**2, 2
    )
    assert constant == pytest.approx(square, rel=1e-9)
    assert tr.capital_gamma(coefficient, gamma) == pytest.approx(-0.5 * linear / square, rel=1e-9)


@pytest.mark.equation(26)
@pytest.mark.parametrize("wrap", [0.3, 1.5, 3.0])
def test_many_small_contacts_make_a_capstan(wrap):
    n, friction_angle = 2000, 0.3
    parts = [tr.attenuation(math.sin(friction_angle), math.pi - wrap / n)] * n
    expected = math.exp(-math.tan(friction_angle) * wrap)
    assert tr.equivalent_attenuation(*parts) == pytest.approx(expected, rel=1e-6)


@given(
    st.floats(1e-4, 0.95),
    st.lists(angles, min_size=1, max_size=4),
)
def test_friction_coefficient_is_the_root_that_bisection_finds(coefficient, gammas):
    B = math.prod(slides_at(coefficient, gamma) for gamma in gammas)
    found = tr.friction_coefficient(B, *gammas)
    assert tr.attenuation(found, *gammas) == pytest.approx(B, rel=1e-12)

    def missing(C):
        ratios = []
        for gamma in gammas:
            G = (1.0 + C**2 * math.cos(gamma)) / (1.0 - C**2)
            ratios.append(1.0 / (G + math.sqrt(max(G**2 - 1.0, 0.0))))
        return math.prod(ratios) - B

    assert found == pytest.approx(brentq(missing, 0.0, 0.999, xtol=1e-15), rel=1e-5)


def test_functions_take_arrays_and_broadcast():
    C, gamma = np.linspace(0.05, 0.9, 4)[:, None], np.linspace(0.1, 3.0, 5)
    B = tr.attenuation(C, gamma, 2.0)
    assert B.shape == (4, 5)
    assert tr.friction_coefficient(B, gamma, 2.0) == pytest.approx(np.broadcast_to(C, (4, 5)))
    assert isinstance(tr.attenuation(0.1, 2.0), float)


# Transparency


@pytest.mark.equation(27)
@pytest.mark.equation(28)
def test_spread_and_mean_are_those_of_the_geometric_statistics():
    B = np.array([[0.95, 0.93, 0.91, 0.97], [0.8, 0.8, 0.8, 0.8]])
    assert np.exp(tr.log_mean(B)) == pytest.approx(gmean(B, axis=1))
    ln = np.log(B[0]).tolist()
    by_pairs = sum((a - b) ** 2 for a in ln for b in ln) / (2.0 * len(ln) ** 2)
    assert tr.log_spread(B[0]) == pytest.approx(math.sqrt(by_pairs))
    assert tr.log_spread(B[1]) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.equation(29)
@given(coefficients, angles)
def test_friction_share_is_the_loss_of_tension_and_its_limit_a_ratio_of_nine_tenths(C, gamma):
    T_1 = slides_at(C, gamma)
    share = tr.friction_share(C, tr.attenuation(C, gamma), gamma)
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
def test_weber_verdict_waits_for_its_interval(low, value, high, verdict):
    found = tr.static_transparency([0.96, value], [0.95, low], [0.97, high])
    assert found.verdict == verdict


# The simulated bench


def bench(eyelet=None, *, seed=0, noise_N=0.011, wander_N=0.0, other=None, drive=None):
    """Two reels with the same eyelet, and an unknown gauge at Y."""
    eyelet, drive = eyelet or tr.Eyelet(), drive or tr.Drive()
    quiet = {"noise_N": noise_N, "wander_N": wander_N}
    x = tr.ReelModel(eyelet, tr.Gauge(**quiet), drive)
    y = tr.ReelModel(other or eyelet, replace(GAUGE_Y, **quiet), drive)
    return tr.SimulatedBench(x, y, seed=seed)


def test_simulated_reels_do_what_the_protocol_says():
    two = bench(noise_N=0.0)
    started = two.record(1.0)
    assert started.time_s.shape == started.x.gauge.shape == started.y.angle_rad.shape == (50,)
    two.x.hold_tension(20.0, 1.0)
    rising = two.record(8.0)
    assert rising.time_s[0] > started.time_s[-1]
    assert rising.x.gauge.max() < 20.0 * 1.001
    assert rising.x.gauge[-1] == pytest.approx(20.0, rel=1e-3)
    assert rising.x.angle_rad[-1] > started.x.angle_rad[-1]
    assert rising.y.angle_rad[-1] == pytest.approx(started.y.angle_rad[-1], abs=2e-3)
    two.x.hold_position()
    goal = GAUGE_Y.reading(25.0)
    two.y.hold_tension(goal, 1.0)
    assert two.record(8.0).y.gauge[-1] == pytest.approx(goal, rel=1e-3)
    two.x.hold_velocity(-0.2)
    moving = two.record(6.0).x
    assert np.polyfit(np.arange(100) / 50.0, moving.angle_rad[-100:], 1)[0] == pytest.approx(
        -0.2, rel=0.02
    )
    two.x.hold_position(float(moving.angle_rad[-1]) - 0.1)
    assert two.record(6.0).x.angle_rad[-1] == pytest.approx(moving.angle_rad[-1] - 0.1, abs=1e-3)
    two.x.hold_velocity(0.0, -1.0)
    gives = two.record(2.0).x
    assert gives.angle_rad[0] - gives.angle_rad[-1] > 0.02


@settings(max_examples=30)
@given(st.lists(st.tuples(st.booleans(), st.floats(6.0, 40.0)), min_size=1, max_size=6))
def test_no_eyelet_of_the_bench_ever_holds_more_than_its_friction(commands):
    eyelet = tr.Eyelet(0.15, (2.0,), scatter=0.0)
    two = bench(eyelet, noise_N=0.0)
    B = slides_at(0.15, 2.0)
    for on_x, tension in commands:
        puller, holder = (two.x, two.y) if on_x else (two.y, two.x)
        holder.hold_position()
        puller.hold_tension(tension if on_x else GAUGE_Y.reading(tension), 1.0)
        two.record(3.0)
        outside = 10e3 * (two.x.slid_m + two.y.slid_m)
        for reel in (two.x, two.y):
            assert B - 1e-9 <= outside / reel.tension_N <= 1.0 / B + 1e-9


def test_bench_of_the_same_seed_reads_the_same():
    first, second = (bench(seed=7, wander_N=0.1).record(1.0) for _ in range(2))
    assert np.array_equal(first.y.gauge, second.y.gauge)


# The procedure


def measure(two, angles, angles_y=None, **choices):
    choices = {"setpoints_N": SETPOINTS, "preload_N": 2.0, **choices}
    return tr.evaluate(tr.TwoReelProcedure(**choices).run(two), angles, angles_y)


benches = st.fixed_dictionaries(
    {
        "coefficient": st.floats(0.03, 0.25),
        "gamma": st.floats(1.6, 2.9),
        "noise_N": st.floats(0.002, 0.05),
        "wander_N": st.floats(0.0, 0.05),
        "scatter": st.floats(0.0, 0.02),
        "seed": st.integers(0, 2**16),
    }
)


@pytest.mark.slow
@settings(max_examples=40)
@given(benches)
def test_procedure_finds_the_coefficient_within_two_percent_or_says_that_it_cannot(drawn):
    eyelet = tr.Eyelet(drawn["coefficient"], (drawn["gamma"],), scatter=drawn["scatter"])
    quiet = {name: drawn[name] for name in ("seed", "noise_N", "wander_N")}
    stuck = ""
    try:
        result = measure(bench(eyelet, **quiet), eyelet.angles_rad, sweeps=6)
    except RigError as error:
        stuck = str(error)
    if stuck:
        event("the cable stuck")
        # The tension comes back as B^4 of the setpoint, which must clear the preload.
        assert "did not slide through" in stuck
        assert slides_at(drawn["coefficient"], drawn["gamma"]) ** 4 < 0.6
    elif result.resolved:
        event("resolved")
        assert result.friction_coefficient.value == pytest.approx(eyelet.coefficient, rel=0.02)
    else:
        event("not resolved")
        assert result.remarks


@pytest.mark.parametrize(
    ("coefficient", "angles"), [(0.1, (2.1,)), (0.04, (2.6,)), (0.06, (2.2, 2.8))]
)
def test_procedure_resolves_an_ordinary_bench(coefficient, angles):
    result = measure(bench(tr.Eyelet(coefficient, angles), seed=3), angles)
    assert result.resolved
    assert result.friction_coefficient.value == pytest.approx(coefficient, rel=0.01)
    assert result.curve.follows_coulomb
    B = math.prod(slides_at(coefficient, gamma) for gamma in angles)
    assert result.attenuation.value == pytest.approx(B, abs=0.01 * (1.0 - B))


def test_procedure_calibrates_the_gauge_of_the_other_reel():
    result = measure(bench(seed=4), (2.1,))
    calibration = result.calibration_y()
    tension = np.array([8.0, 15.0, 22.0, 30.0])
    found = calibration.force_N([GAUGE_Y.reading(T) for T in tension])
    assert found == pytest.approx(tension, rel=2e-3)


def test_friction_that_grows_with_tension_is_seen_and_measured_at_the_mean_tension():
    eyelet = tr.Eyelet(growth_per_N=5e-4)
    result = measure(bench(eyelet, seed=3), eyelet.angles_rad)
    assert not result.curve.follows_coulomb
    assert any("Coulomb's law" in remark for remark in result.remarks)
    truth = eyelet.coefficient_at(result.mean_tension_N)
    assert result.friction_coefficient.value == pytest.approx(truth, rel=0.01)
    ratios = [B.value for B in result.ratio_at_setpoints()]
    assert ratios == sorted(ratios, reverse=True)
    assert result.transparency().log_spread > 1e-3


def test_dynamic_ratio_is_measured_at_the_velocity_of_the_cable():
    eyelet = tr.Eyelet(dynamic_share=0.7, viscous_s_m=0.5)
    result = measure(
        bench(eyelet, seed=5),
        eyelet.angles_rad,
        setpoints_N=(15.0, 20.0, 25.0, 32.0, 40.0),
        holding="moving",
        velocity_m_s=0.02,
    )
    truth = eyelet.coefficient_at(0.0, 0.02)
    assert truth < 0.93 * eyelet.coefficient
    assert result.friction_coefficient.value == pytest.approx(truth, rel=0.02)


def test_a_tension_controller_that_leads_moves_the_cable_off_the_verge_and_breakout_finds_it():
    eager = tr.Drive(position_lag_s=3.0, give_m_N=3e-5)
    excess = {}
    for holding in ("position", "breakout"):
        two = bench(tr.Eyelet(scatter=0.0), noise_N=0.0, drive=eager)
        result = measure(two, (2.1,), holding=holding, sweeps=3, settle_s=1.0)
        excess[holding] = result.ratios - slides_at(0.1, 2.1)
    assert excess["position"].min() > 50.0 * np.abs(excess["breakout"]).max()


def test_noise_that_hides_friction_is_said():
    eyelet = tr.Eyelet(0.01, (2.9,))
    result = measure(bench(eyelet, noise_N=0.3, wander_N=0.3), eyelet.angles_rad, preload_N=3.5)
    assert not result.resolved
    assert "no friction can be told" in result.remarks[0]
    assert result.friction_coefficient.low <= 0.01 <= result.friction_coefficient.high


def test_scatter_asks_for_the_sweeps_it_needs():
    eyelet = tr.Eyelet(scatter=0.05)
    result = measure(bench(eyelet, seed=1), eyelet.angles_rad, sweeps=5)
    assert not result.resolved
    assert result.sweeps_needed > 5
    assert f"take about {result.sweeps_needed} sweeps" in result.remarks[0]
    # By then, the promised interval is as wide as the tolerance: 3.29 standard errors for many.
    error = result.friction_coefficient.standard_error * math.sqrt(5.0 / result.sweeps_needed)
    assert 3.29 * error == pytest.approx(0.02 * result.friction_coefficient.value, rel=0.1)


def test_an_uncertain_angle_widens_the_interval_and_is_said():
    measurements = tr.TwoReelProcedure(SETPOINTS, preload_N=2.0, sweeps=4).run(bench(seed=2))
    known, unsure = (
        tr.evaluate(measurements, (2.1,), angle_error_rad=error) for error in (0.0, 0.03)
    )
    # C_R goes as 1/cos(gamma/2): relative, the uncertainty is tan(gamma/2)/2 times the angle's.
    expected = 0.5 * math.tan(1.05) * 0.03 * known.friction_coefficient.value
    added = math.sqrt(
        unsure.friction_coefficient.standard_error**2
        - known.friction_coefficient.standard_error**2
    )
    assert added == pytest.approx(expected, rel=0.05)
    assert unsure.sweeps_needed is None
    assert any("angles" in remark for remark in unsure.remarks)


def test_ratios_above_one_are_no_friction_that_can_be_told():
    rows = [m._replace(x_2_N=2.01 * m.x_1_N - m.x_2_N / 0.9**4) for m in drifting(0.0)]
    result = tr.evaluate(rows, [2.1])
    assert result.attenuation.value > 1.0
    assert not result.resolved
    assert result.friction_coefficient.low == 0.0
    assert result.friction_coefficient.high > 0.0
    assert result.transparency().friction_share == 0.0


def drifting(per_sweep):
    """Readings whose friction grows from sweep to sweep, with a little scatter."""
    scatter = np.random.default_rng(0).normal(0.0, 1e-4, (6, 5))
    rows = []
    for sweep in range(6):
        for k, x in enumerate(SETPOINTS):
            B = 0.9 - per_sweep * sweep + scatter[sweep, k]
            rows.append(tr.Measurement(x, sweep, x, 3.0 + B**2 * x, B**4 * x, 3.0 + B**2 * x))
    return rows


def test_drift_between_sweeps_is_said():
    assert tr.evaluate(drifting(0.0), [2.1]).resolved
    result = tr.evaluate(drifting(0.0005), [2.1])
    assert not result.resolved
    assert any("drifts" in remark for remark in result.remarks)


def test_exchanged_angles_tell_unlike_reels_apart_and_alike_ones_not():
    for other, alike in ((0.1, True), (0.15, False)):
        runs = [
            measure(
                bench(tr.Eyelet(0.1, (a,)), other=tr.Eyelet(other, (b,)), seed=seed), (a,), (b,)
            )
            for seed, (a, b) in enumerate([(1.9, 2.5), (2.5, 1.9)])
        ]
        found = tr.likeness(*runs)
        assert found.alike is alike
        assert found.coefficient_x.value == pytest.approx(0.1, rel=0.03)
        assert found.coefficient_y.value == pytest.approx(other, rel=0.03)
    with pytest.raises(InvalidInput, match="exchange the angles"):
        tr.likeness(runs[0], runs[0])


def test_hysteresis_loop_has_the_edges_of_the_ratio():
    two = bench(tr.Eyelet(scatter=0.0), noise_N=0.0)
    loop = tr.HysteresisTest(6.0, 36.0).run(two)
    B = slides_at(0.1, 2.1)
    y = np.array([brentq(lambda T, r=r: GAUGE_Y.reading(T) - r, 0.0, 100.0) for r in loop.y])
    rising = (loop.rising == 1.0) & (loop.x_N > 1.2 * 6.0 / B**4)
    falling = (loop.rising == 0.0) & (loop.x_N < 36.0 * B**4 / 1.2)
    assert rising.sum() > 10
    assert y[rising] / loop.x_N[rising] == pytest.approx(B**2, rel=5e-3)
    assert y[falling] / loop.x_N[falling] == pytest.approx(B**-2, rel=5e-3)


def test_loop_and_procedure_agree_on_the_ratio():
    two = bench(seed=6)
    result = measure(two, (2.1,))
    loop = tr.HysteresisTest(6.0, 36.0).run(two, result.calibration_y(margin=0.4))
    assert loop.attenuation() == pytest.approx(result.attenuation.value, abs=2e-3)
    heavy = bench(tr.Eyelet(0.3, (1.2,)))
    with pytest.raises(InvalidInput, match="too narrow"):
        tr.HysteresisTest(10.0, 20.0).run(heavy).attenuation()


class FaultyBench:
    """Obeys the protocol and keeps what it was told; its gauges fail after some records."""

    def __init__(self, good_records):
        self.told = []
        self.x, self.y = self._Reel("x", self.told), self._Reel("y", self.told)
        self._good, self._time = good_records, 0.0

    class _Reel:
        drum_radius_m = 0.025

        def __init__(self, name, told):
            self._name, self._told = name, told

        def hold_tension(self, setpoint, within_s):  # noqa: ARG002  the protocol's
            self._told.append((self._name, "tension"))

        def hold_position(self, angle_rad=None):  # noqa: ARG002  the protocol's
            self._told.append((self._name, "position"))

        def hold_velocity(self, velocity_rad_s, force_ramp_N_s=0.0):  # noqa: ARG002  likewise
            self._told.append((self._name, "velocity"))

    def record(self, duration_s):
        time = self._time + np.arange(1, 11) * duration_s / 10.0
        self._time += duration_s
        self._good -= 1
        level = 16.0 if self._good > 0 else math.nan
        side = tr.Reading(np.full(10, level), np.zeros(10))
        return tr.BenchRecord(time, side, side)


@pytest.mark.parametrize("good_records", [1, 3, 5, 6])
def test_both_reels_hold_their_position_after_a_gauge_failed(good_records):
    faulty = FaultyBench(good_records)
    procedure = tr.TwoReelProcedure((16.0, 17.0, 18.0, 19.0, 20.0), holding="position")
    with pytest.raises(RigError):
        procedure.run(faulty)
    assert faulty.told[-2:] == [("x", "position"), ("y", "position")]


def test_cable_that_never_breaks_out_is_said():
    with pytest.raises(RigError, match="did not break out"):
        tr.TwoReelProcedure((16.0, 17.0, 18.0, 19.0, 20.0)).run(FaultyBench(10**6))


# Bad input


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: tr.attenuation(1.0, 2.0), "below 1"),
        (lambda: tr.attenuation(-0.1, 2.0), "friction coefficient is -0.1"),
        (lambda: tr.attenuation(0.1, 120.0), "in radians"),
        (lambda: tr.attenuation(0.1), "no angle"),
        (lambda: tr.attenuation([0.1, math.nan], 2.0), "at index 1"),
        (lambda: tr.friction_coefficient(0.0, 2.0), "attenuation ratio is 0"),
        (lambda: tr.friction_coefficient(1.02, 2.0), "at most 1"),
        (lambda: tr.friction_coefficient(0.9, math.pi), "straight cable"),
        (lambda: tr.direction_outside(1.6, 0.0), "less than pi/2"),
        (lambda: tr.contact_line([0, 0, 1], [0, 0, -2]), "collinear"),
        (lambda: tr.angle_between_rad([0, 0, 0], [0, 0, 1]), "no length"),
        (lambda: tr.angle_between_rad([0, 1], [0, 1]), "3 components"),
        (lambda: tr.friction_N(10.0, 0.2, 0.5, 0.3), "outside the friction cone"),
        (lambda: tr.tension_outside_N(5.0, 6.0), "slack"),
        (lambda: tr.log_spread([]), "no attenuation ratio"),
        (lambda: tr.TwoReelProcedure((8.0, 16.0, 24.0, 32.0)), "5 or more"),
        (lambda: tr.TwoReelProcedure(SETPOINTS, sweeps=2), "3 or more"),
        (lambda: tr.TwoReelProcedure(SETPOINTS, preload_N=5.0), "twice"),
        (lambda: tr.TwoReelProcedure(SETPOINTS, holding="moving"), "velocity_m_s"),
        (lambda: tr.HysteresisTest(10.0, 5.0), "must rise"),
        (lambda: tr.Eyelet(angles_rad=(4.0,)), "in radians"),
        (lambda: tr.evaluate(drifting(0.0), [math.pi]), "straight cable"),
        (lambda: tr.evaluate(drifting(0.0)[:-1], [2.1]), "whole sweeps"),
        (lambda: tr.evaluate(drifting(0.0)[:10], [2.1]), "2 sweeps"),
        (
            lambda: tr.evaluate([m._replace(y_2=m.y_2 - 9.0) for m in drifting(0.0)], [2.1]),
            "too far off",
        ),
        (lambda: tr.evaluate(drifting(0.0), [3.1], angle_error_rad=0.1), "straight to within"),
    ],
)
def test_bad_input_is_named_with_its_remedy(call, said):
    with pytest.raises(InvalidInput, match=said):
        call()
