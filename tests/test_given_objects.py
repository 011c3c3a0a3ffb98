"""Linear systems and functions as targets, without a wrapper."""

import math

import control
import matplotlib.figure
import numpy as np
import pytest
from scipy import signal

import estune
import plants
from estune.errors import InvalidInput, UnsafeStart
from estune.run.targets import open_target

LAG = control.tf([2.0], [3.0, 1.0])


def described(target, **options):
    with open_target(target, **options) as rig:
        return rig.describe()


def motor(speed, effort, dt_s):
    return speed + dt_s * (2.0 * effort - speed) / 3.0, speed


def servo(state, effort, dt_s):
    angle, speed = state
    return np.array([angle + dt_s * speed, speed + dt_s * (effort - 0.5 * speed)]), angle


def rubbing_motor(speed, effort, dt_s):
    return speed + dt_s * (effort - 0.2 * speed - 0.3 * np.sign(speed)) / 0.05, speed


def oven(kelvin=293.0, watts=0.0, dt_s=1.0):
    return kelvin + dt_s * (0.01 * watts - (kelvin - 293.0) / 300.0), kelvin


@pytest.mark.parametrize(
    "system",
    [
        LAG,
        control.ss(LAG),
        signal.lti([2.0], [3.0, 1.0]),
        signal.TransferFunction([2.0], [3.0, 1.0]),
        signal.ZerosPolesGain([], [-1.0 / 3.0], 2.0 / 3.0),
        signal.StateSpace([[-1.0 / 3.0]], [[1.0]], [[2.0 / 3.0]], [[0.0]]),
    ],
    ids=lambda system: type(system).__module__ + type(system).__name__,
)
def test_linear_system_is_a_plant_sampled_at_its_own_scale(system):
    by_hand = plants.linear_plant(LAG, 0.5).rig().describe()
    found = described(system, dead_time_s=0.5)
    assert found.controller == by_hand.controller
    assert found.step == by_hand.step
    assert found.gains.as_tuple() == pytest.approx(by_hand.gains.as_tuple(), rel=1e-9)
    assert described(system, sampling_Hz=7.0).controller.sampling_Hz == 7.0


def test_discrete_system_runs_at_its_own_rate():
    system = signal.dlti([0.1], [1.0, -0.9], dt=0.25)
    assert described(system).controller.sampling_Hz == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("function", "slowest_s", "at_rest"),
    [(motor, 3.0, 0.0), (servo, 2.0, 0.0), (oven, 300.0, 293.0)],
)
def test_function_is_a_plant_of_the_time_scale_of_its_equations(function, slowest_s, at_rest):
    found = described(function)
    assert found.settling_time_s == pytest.approx(2.0 * np.pi * slowest_s, rel=0.02)
    assert found.controller.sampling_Hz * found.settling_time_s == pytest.approx(200.0)
    assert found.step.preload_N == at_rest


def test_function_that_integrates_alone_is_a_plant_of_the_time_of_its_gain():
    def tank(level, inflow, dt_s):
        return level + 0.02 * inflow * dt_s, level

    assert 50.0 <= described(tank).settling_time_s / (2.0 * np.pi) < 100.0


def test_function_without_arguments_is_called():
    assert described(lambda: LAG).settling_time_s == described(LAG).settling_time_s
    assert described(plants.reference_reel) == plants.reference_reel().rig().describe()


@pytest.mark.parametrize(
    ("target", "options", "message"),
    [
        (3.0, {}, "of type float; give an endpoint .* a linear system .* or a function"),
        (lambda x: x, {}, "takes neither 0.0 nor 8 or fewer zeros as its state"),
        (control.tf([1.0, 0.0], [1.0]), {}, "more zeros than poles; add the pole"),
        (plants.reference_reel(), {"dead_time_s": 1.0}, "dead_time_s .* which has its own"),
        (LAG, {"sampling_Hz": -1.0}, "sampling rate"),
        (lambda x, _u, _dt: (x * math.nan, x), {}, "a state that is not finite"),
        (lambda x, _u, _dt: (x, math.nan), {}, "a measurement of nan in the state 0.0"),
        (control.tf([-3.0], [10.0, 1.0]), {}, "lowers the measurement.*turn the sign"),
        (rubbing_motor, {}, "as with dry friction: that hides its time constants"),
    ],
)
def test_what_is_no_plant_is_refused_with_the_remedy(target, options, message):
    with pytest.raises((InvalidInput, UnsafeStart), match=message):
        described(target, **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dead_time_s": "0.1 s"}, "dead_time_s is '0.1 s'; it must be a number of s"),
        ({"start": (1.0, 1.0, 0.0, 0.0)}, "give estune.Gains"),
    ],
)
def test_option_of_another_type_is_refused_by_its_name(options, message):
    with pytest.raises(InvalidInput, match=message):
        estune.tune(LAG, journal=False, watch=None, **options)


def test_unstable_system_is_tuned_from_the_gains_that_hold_it():
    unstable = control.tf([1.0], [1.0, -1.0])
    with pytest.raises(UnsafeStart, match=r"start=Gains\(\.\.\.\) of estune\.tune"):
        described(unstable)
    start = estune.Gains(3.0, 1.0, 0.01, 0.05)
    assert described(unstable, gains=start).gains == start


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    return estune.tune(LAG, dead_time_s=0.5, folder=folder, run="lag", watch=None)


def test_system_is_tuned_plotted_on_given_axes_and_closed_into_a_loop(tuned):
    assert tuned.success
    axes = matplotlib.figure.Figure().subplots(2, 2).ravel()
    plots = (tuned.plot, tuned.plot_step, tuned.plot_bode, tuned.plot_nyquist)
    for plot, ax in zip(plots, axes, strict=True):
        assert plot(ax=ax) is ax
        assert ax.lines
        assert plot()._repr_png_().startswith(b"\x89PNG")
    own, given = tuned.loop(), tuned.loop(LAG, dead_time_s=0.5)
    assert np.sort_complex(own.poles()) == pytest.approx(np.sort_complex(given.poles()))
    assert np.abs(own.poles()).max() < 1.0


def test_run_of_a_system_is_resumed_with_its_dead_time(tuned):
    again = estune.resume(tuned.folder, LAG, watch=None)
    assert again.gains == tuned.gains
    assert again.rig.linear_model.dead_time_s == 0.5
