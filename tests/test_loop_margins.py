"""Stability margins, against a scan, python-control and the closed loop's eigenvalues."""

import math
import subprocess
import sys

import control
import numpy as np
import pytest

from estune.core.gains import Gains
from estune.core.margins import controller_response, largest_sensitivity
from estune.core.pidf import PidfState, coefficients, state_at_rest, step
from estune.interop import (
    linear_model,
    margins,
)
from estune.trial import LinearModel
from tests.test_interop import s, sampled_model_of, settings

REEL = (
    (188.0**2 / (s**2 + 2 * 0.15 * 188.0 * s + 188.0**2))
    * (1822.0**2 / (s**2 + 2 * 0.03 * 1822.0 * s + 1822.0**2)),
    1.0 / 632.0,
    Gains(0.5, 20.0, 0.001, 0.01),
    settings(632.0, 5e-4),
)
LAG = 1 / (1 + 20 * s)
LOOPS = {
    "reel with a gauge mode": REEL,
    "lag and dead time": (
        *(LAG, 5.0),
        *(Gains.from_standard(3.58, 27.8, 2.15), settings(10.0, 0.1)),
    ),
    "dead time of 2000 samples": (
        *(LAG, 20.0),
        *(Gains.from_standard(0.93, 30.1, 6.06), settings(100.0, 0.1)),
    ),
    "fraction of a sample": (4 / (s + 4), 0.0137, Gains(2.0, 3.0, 0.0, 0.0), settings(50.0, 0.0)),
    "eight lags, sampled fast": (
        *(1 / (1 + 10 * s) ** 8, 0.0),
        *(Gains.from_standard(0.684, 54.9, 19.5), settings(100.0, 1.0)),
    ),
    "undamped": (
        *(100 / (s**2 + 100), 0.001),
        *(Gains(0.1, 0.1, 0.1, 0.0), settings(640.0, 0.001)),
    ),
    "integrators": (1 / s**2, 0.001, Gains(1.0, 0.1, 1.0, 0.0), settings(632.0, 0.001)),
    "gain alone": (
        *(control.tf([2.0], [1.0]), 0.013),
        *(Gains(0.1, 0.5, 0.001, 0.0), settings(100.0, 0.01)),
    ),
}


def closed_loop_radius(model, gains, controller):
    """Spectral radius of the loop, built from `step` applied to unit signals."""
    plant, c = sampled_model_of(model, controller.sampling_Hz), coefficients(controller, gains)
    n, d = plant.C.size, plant.delay

    def advance(loop):
        x, past, (integral, filtered) = loop[:n], loop[n : n + d + 1], loop[n + d + 1 :]
        y = plant.C @ x + plant.E * past[-1]
        state, u, _ = step(c, PidfState(integral, 0.0, filtered), 0.0, y)
        line = np.concatenate([[u], past])
        x = plant.Phi @ x + plant.now * line[-2] + plant.before * line[-1]
        return np.concatenate([x, line[:-1], [state.integral, state.filtered_measurement]])

    present = [True] * (n + d + 1) + [gains.I > 0.0, gains.D > 0.0]
    matrix = np.array([advance(unit) for unit in np.eye(len(present))]).T[np.ix_(present, present)]
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def scale_gains(gains, factor):
    P, I, D, setpoint_filter_s = gains.as_tuple()
    return Gains(factor * P, factor * I, factor * D, setpoint_filter_s)


def test_controller_response_matches_its_difference_equation():
    gains, controller = Gains(1.3, 60.0, 0.01, 0.0), settings(632.0, 0.004)
    theta = np.array([0.03, 0.4, 2.5])
    c = coefficients(controller, gains)
    for angle, response in zip(theta, controller_response(gains, controller, theta), strict=True):
        state, effort = state_at_rest(0.0, 0.0), []
        k = np.arange(40_000)
        for y in np.cos(angle * k).tolist():
            state, u, _ = step(c, state, 0.0, y)
            effort.append(-u)
        late = slice(20_000, None)
        basis = np.column_stack([np.cos(angle * k), -np.sin(angle * k), np.ones(k.size)])[late]
        real, imaginary, _ = np.linalg.lstsq(basis, np.array(effort)[late], rcond=None)[0]
        assert complex(real, imaginary) == pytest.approx(response, rel=1e-6)


@pytest.mark.parametrize("name", LOOPS)
def test_margins_match_a_brute_force_scan(name):
    system, dead_time_s, gains, controller = LOOPS[name]
    model = linear_model(system, dead_time_s)
    result = margins(model, gains, controller)
    assert result.stable

    theta = np.unique(np.r_[np.geomspace(1e-5, np.pi, 50_000), np.linspace(1e-5, np.pi, 50_000)])
    loop = controller_response(gains, controller, theta) * sampled_model_of(
        model, controller.sampling_Hz
    ).response(theta)
    at_one = np.flatnonzero(np.diff(np.sign(np.abs(loop) - 1.0)))
    turns = np.abs(np.angle(-loop[at_one], deg=True))
    real_axis = np.flatnonzero((np.diff(np.sign(loop.imag)) != 0) & (loop.real[1:] < 0.0))
    real_axis = real_axis[np.abs(loop[real_axis]) < 1e4]  # not across an undamped pole
    factors = 1.0 / np.abs(np.append(loop[real_axis], loop[-1] if loop[-1].real < 0.0 else 1e-9))
    nearest = factors[np.abs(np.log(factors)).argmin()]
    assert result.phase_margin_deg == pytest.approx(turns.min(initial=np.inf), abs=0.02)
    assert result.gain_margin == pytest.approx(nearest, rel=1e-3)
    per_sample = controller.sampling_Hz / (2.0 * np.pi)
    if turns.size:
        crossover_Hz = theta[at_one[turns.argmin()]] * per_sample
        assert result.gain_crossover_Hz == pytest.approx(crossover_Hz, rel=1e-3)


SLOW_LOOP = (
    *(1 / (1 + 100 * s) / (1 + 50 * s), 0.0),
    *(Gains(100.0, 0.0, 0.0, 0.0), settings(1000.0, 0.0)),
)
"""Ms of 5 at 1.4e-4 rad/sample, far above the slowest pole and far below half the rate."""


@pytest.mark.parametrize("name", [*LOOPS, "slow"])
def test_largest_sensitivity_matches_a_brute_force_scan(name):
    system, dead_time_s, gains, controller = {**LOOPS, "slow": SLOW_LOOP}[name]
    plant = sampled_model_of(linear_model(system, dead_time_s), controller.sampling_Hz)
    theta = np.unique(np.r_[np.geomspace(1e-6, np.pi, 50_000), np.linspace(1e-5, np.pi, 50_000)])
    loop = controller_response(gains, controller, theta) * plant.response(theta)
    expected = (1.0 / np.abs(1.0 + loop)).max()
    assert largest_sensitivity(plant, gains, controller) == pytest.approx(expected, rel=0.01)


def test_margins_match_python_control_where_well_conditioned():
    system, dead_time_s, gains, controller = REEL
    h, lag = 1.0 / controller.sampling_Hz, controller.derivative_filter_s
    z = control.tf([1.0, 0.0], [1.0], h)
    C_y = gains.P + gains.I * h / (z - 1) + gains.D * (z - 1) / ((lag + h) * z - lag)
    loop = C_y * control.tf(control.sample_system(control.ss(system), h, "zoh")) / z
    gain, phase, _, phase_rad_s, gain_rad_s, _ = control.stability_margins(loop, method="poly")
    result = margins(linear_model(system, dead_time_s), gains, controller)
    assert result.gain_margin == pytest.approx(gain, rel=1e-5)
    assert result.phase_margin_deg == pytest.approx(phase, rel=1e-5)
    assert result.phase_crossover_Hz == pytest.approx(phase_rad_s / (2.0 * np.pi), rel=1e-5)
    assert result.gain_crossover_Hz == pytest.approx(gain_rad_s / (2.0 * np.pi), rel=1e-5)


@pytest.mark.parametrize("name", [name for name in LOOPS if "2000" not in name])
def test_closed_loop_at_gain_margin_is_marginally_stable(name):
    system, dead_time_s, gains, controller = LOOPS[name]
    model = linear_model(system, dead_time_s)
    factor = margins(model, gains, controller).gain_margin
    for share, stable in ((0.98, True), (1.02, False)):
        there = scale_gains(gains, factor**share)
        assert margins(model, there, controller).stable is stable
        assert (closed_loop_radius(model, there, controller) < 1.0) is stable


def test_stability_matches_the_eigenvalues():
    rng = np.random.default_rng(1)
    stable = 0
    for _ in range(40):
        sampling_Hz = 10.0 ** rng.uniform(0.0, 4.0)
        system = control.tf([1.0], [1.0])
        for _ in range(rng.integers(1, 4)):
            a, b = sampling_Hz * 10.0 ** rng.uniform(-3.0, 0.3, 2)
            system = system * rng.choice(
                [1 / (1 + s / a), (1 - s / b) / (1 + s / a), 1 / (1 + s * 0.02 / a + (s / a) ** 2)]
            )
        P = 10.0 ** rng.uniform(-2.0, 1.0)
        gains = Gains(
            P,
            P * sampling_Hz * 10.0 ** rng.uniform(-3.0, 0.0) * rng.integers(0, 2),
            P / sampling_Hz * 10.0 ** rng.uniform(-1.0, 2.0) * rng.integers(0, 2),
            0.0,
        )
        controller = settings(sampling_Hz, rng.uniform(0.0, 10.0) / sampling_Hz)
        model = linear_model(system, rng.choice([0.0, 3.0, rng.uniform(0.0, 30.0)]) / sampling_Hz)
        radius = closed_loop_radius(model, gains, controller)
        if abs(radius - 1.0) > 1e-6:
            assert margins(model, gains, controller).stable is (radius < 1.0)
            stable += radius < 1.0
    assert 7 < stable < 33


@pytest.mark.parametrize(
    ("system", "gains"),
    [
        (REEL[0], Gains(3.0, 20.0, 0.001, 0.0)),
        (1 / (s - 2), Gains(1.0, 0.0, 0.0, 0.0)),
        (s / (s + 1), Gains(1.0, 1.0, 0.0, 0.0)),  # the integrator is cancelled and drifts
    ],
    ids=["too much gain", "unstable plant", "no gain at rest"],
)
def test_unstable_loop_has_no_margins(system, gains):
    result = margins(linear_model(system), gains, settings(632.0, 5e-4))
    plant = sampled_model_of(linear_model(system), 632.0)
    assert largest_sensitivity(plant, gains, settings(632.0, 5e-4)) == math.inf
    assert result.stable is False
    assert list(map(math.isnan, result[:4])) == [True] * 4


@pytest.mark.parametrize("rates", [(12.0, 30.0), (17.0, 60.0)])
def test_undamped_modes_that_the_loop_does_not_move_leave_it_unstable(rates):
    """Each turns the return difference by half a turn, one of them back."""
    A = np.zeros((5, 5))
    A[0, 0] = -1.0
    for n, rate in zip((1, 3), rates, strict=True):
        A[n, n + 1], A[n + 1, n] = rate, -rate
    model = LinearModel(tuple(map(tuple, A)), (1.0, 0.0, 1.0, 0.0, 1.0), (1.0, *[0.0] * 4))
    assert not margins(model, Gains(1.0, 1.0, 0.0, 0.0), settings(100.0, 0.0)).stable


def test_stabilised_unstable_plant_has_margins():
    result = margins(linear_model(1 / (s - 2)), Gains(6.0, 1.0, 0.0, 0.0), settings(632.0, 0.0))
    assert result.stable
    assert result.gain_margin == pytest.approx(1.0 / 3.0, rel=1e-3)  # s^2 + (6 k - 2) s + k
    assert result.phase_margin_deg > 40.0


def test_rest_of_an_integrating_plant_is_no_crossing():
    controller = settings(1000.0, 0.0)
    result = margins(linear_model(1 / s), Gains(0.01, 0.0, 0.0, 0.0), controller)
    # P h/(z - 1) is -P h/2 at half the sampling rate.
    assert result.gain_margin == pytest.approx(2.0 * 1000.0 / 0.01, rel=1e-3)


@pytest.mark.parametrize("slow_s", [10.0, 1000.0])
def test_slow_plant_without_a_crossover_is_stable_however_fast_it_is_sampled(slow_s):
    model, controller = linear_model(1 / (1 + slow_s * s)), settings(1000.0, 0.0)
    result = margins(model, Gains(0.1, 0.0, 0.0, 0.0), controller)
    assert result.stable
    assert result.phase_margin_deg == math.inf


def test_loop_with_little_integral_action_is_stable_though_its_slow_pole_is_hardly_off_one():
    """At 100 I h/(1 + 100 P) = 2e-8 per sample, where the plant's own pole is at 1e-3."""
    model, controller = linear_model(100 / (1 + s)), settings(1000.0, 0.0)
    assert margins(model, Gains(19.0, 4e-4, 0.0, 0.0), controller).stable


def test_loop_that_meets_the_negative_real_axis_only_at_an_end_has_its_margin_there():
    controller, lag, decay = settings(1000.0, 0.0), 1 / (s + 1), math.exp(-1e-3)
    fast = margins(linear_model(lag), Gains(0.1, 0.5, 0.0, 0.0), controller)
    # At z = -1 the controller is P - I h/2 and the plant -(1 - decay)/(1 + decay).
    expected = (1.0 + decay) / (1.0 - decay) / (0.1 - 0.5e-3 / 2.0)
    assert fast.gain_margin == pytest.approx(expected, rel=1e-6)
    assert fast.phase_crossover_Hz == pytest.approx(500.0)
    for P, expected in ((0.0025, (1.0 + decay) / (1.0 - decay) / 0.0025), (0.0015, math.inf)):
        quiet = margins(linear_model(lag), Gains(P, 0.0, 0.0, 0.0), controller)
        assert quiet.gain_margin == pytest.approx(expected, rel=1e-6)  # up to a million
    at_rest = margins(linear_model(-0.5 * lag), Gains(1.0, 0.0, 0.0, 0.0), controller)
    assert at_rest.gain_margin == pytest.approx(2.0, rel=1e-4)
    assert at_rest.phase_crossover_Hz < 1e-3


@pytest.mark.parametrize("system", [0.2 / (s + 1), control.tf([0.0], [1.0, 1.0])])
def test_loop_below_one_has_no_crossover(system):
    result = margins(linear_model(system), Gains(0.5, 0.0, 0.0, 0.0), settings(100.0, 0.0))
    assert result.phase_margin_deg == math.inf
    assert math.isnan(result.gain_crossover_Hz)
    assert result.gain_margin > 100.0


def test_margins_do_not_import_python_control():
    program = (
        "import sys\n"
        "from estune.interop import margins\n"
        "from estune.core.gains import Gains\n"
        "from estune.core.pidf import ControllerSettings\n"
        "from estune.trial import LinearModel\n"
        "model = LinearModel(A=((-1.0,),), B=(1.0,), C=(1.0,))\n"
        "print(margins(model, Gains(1, 1, 0, 0), ControllerSettings(50, 0, -1, 1)).stable)\n"
        "print('control' in sys.modules)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, check=True, text=True
    )
    assert done.stdout.split() == ["True", "False"]
