import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from estune.core import pidf
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings, PidfState
from estune.errors import InvalidInput
from estune.reel import hybrid
from estune.reel.hybrid import HybridCoefficients, HybridSignals, HybridState, SwitchingRules
from experiments.paper.demonstrations.workspace_boundary import parallel_step

RATE = 632.0


def coefficients(position, tension, rate=RATE, limit=120.0):
    settings_ = ControllerSettings(rate, 0.002, -limit, limit)
    return HybridCoefficients(
        pidf.coefficients(settings_, position), pidf.coefficients(settings_, tension)
    )


def gains(scale):
    share = st.floats(0.01, 1.0)
    return st.builds(
        lambda P, I, D, F: Gains(scale * P, 20.0 * scale * I, 0.05 * scale * D, 0.1 * F),
        share, st.one_of(st.just(0.0), share), share, share,
    )  # fmt: skip


def signals_at(t, seed):
    """Smooth signals with setpoint steps, as of a platform at its boundary."""
    a, b, c, d = np.random.default_rng(seed).uniform(0.3, 1.0, 4)
    return HybridSignals(
        0.1 * a * math.sin(3.0 * t) + (0.05 if t > 0.4 else 0.0),
        0.1 * b * math.sin(5.0 * c * t),
        15.0 + 5.0 * c * math.sin(4.0 * t) + (8.0 if t > 0.6 else 0.0),
        15.0 + 7.0 * d * math.sin(9.0 * a * t),
    )


START = HybridState(PidfState(15.0, 0.0, 0.0), pidf.state_at_rest(15.0, 15.0), in_tension=True)


@pytest.mark.equation(36)
@pytest.mark.equation(37)
@settings(max_examples=15)
@given(which=gains(1.0), effort=st.floats(-50.0, 50.0), seed=st.integers(0, 99))
def test_handed_over_integral_gives_the_effort_of_the_other(which, effort, seed):
    for scale in (1.0, 2000.0):  # (36), the tension controller; (37), the position controller
        c = coefficients(which, which)[1]
        r, y = (v / scale for v in signals_at(0.5, seed)[2:])
        state = PidfState(3.0, 0.9 * r, 1.1 * y)
        after, effort_taken = hybrid.hand_over(c, state, r, y, effort)
        # By root finding, with the whole controller as a black box.
        integral = brentq(
            lambda value, c=c, state=state, r=r, y=y: (
                pidf.step(c, state._replace(integral=value), r, y)[1] - effort
            ),
            -1e5, 1e5, xtol=1e-12,
        )  # fmt: skip
        expected, _, _ = pidf.step(c, state._replace(integral=integral), r, y)
        assert effort_taken == pytest.approx(effort, abs=1e-9)
        assert after == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.equation(36)
@pytest.mark.equation(37)
def test_handed_over_integral_at_rest_is_effort_over_gain():
    c = coefficients(Gains(2000.0, 6000.0, 120.0, 0.0), Gains(0.6, 12.0, 0.01, 0.02))
    for controller, integral_gain, level in ((c.tension, 12.0, 15.0), (c.position, 6000.0, 0.3)):
        state = PidfState(99.0, level, level)
        after, _ = hybrid.hand_over(controller, state, level, level, 18.0)
        assert after.integral / integral_gain == pytest.approx(18.0 / integral_gain)


@settings(max_examples=80)
@given(
    position=gains(3000.0),
    tension=gains(2.0),
    limit=st.sampled_from([20.0, 120.0]),
    switches=st.lists(st.integers(1, 630), min_size=1, max_size=8, unique=True),
    seed=st.integers(0, 999),
)
def test_effort_at_a_switch_is_that_without_it(position, tension, limit, switches, seed):
    c = coefficients(position, tension, limit=limit)
    state, mode = START, True
    for k in range(632):
        signals = signals_at(k / RATE, seed)
        if k in switches:
            mode = not mode
            _, unswitched = hybrid.step(c, state, signals, not mode)
            following, effort = hybrid.step(c, state, signals, mode)
            # Rounding of the largest term in the sum, P e or D dy/dt.
            largest = position.P + position.D * RATE + 50.0 * (tension.P + tension.D * RATE)
            assert effort == pytest.approx(unswitched, abs=1e-14 * largest + 1e-12)
            # After the hand-over the effort follows the incoming controller's law.
            assert following.in_tension is mode
            state = following
        else:
            state, effort = hybrid.step(c, state, signals, mode)
        assert abs(effort) <= limit


def greatest_step_at_switches(advance, rate):
    c = coefficients(
        Gains(2000.0, 6000.0, 120.0, 0.0), Gains(0.6, 12.0, 0.01, 0.02), rate, limit=1e4
    )
    state, mode, last, greatest, switched_before = START, True, 15.0, 0.0, False
    for k in range(round(2.0 * rate)):
        t = k / rate
        toggled = k > 0 and k % round(0.125 * rate) == 0
        mode = mode ^ toggled
        smooth = HybridSignals(
            0.01, 0.01 * math.sin(5.0 * t), 15.0, 15.0 + 2.0 * math.sin(7.0 * t)
        )
        state, effort = advance(c, state, smooth, mode)
        if k > 0 and (toggled or switched_before):
            greatest = max(greatest, abs(effort - last))
        last, switched_before = effort, toggled
    return greatest


def test_effort_is_continuous_only_with_hand_over():
    coarse, fine = (greatest_step_at_switches(hybrid.step, rate) for rate in (632.0, 6320.0))
    assert fine < 0.2 * coarse
    coarse, fine = (greatest_step_at_switches(parallel_step, rate) for rate in (632.0, 6320.0))
    assert fine > 0.8 * coarse > 5.0


def test_several_reels_at_once_equal_each_reel_alone():
    c = coefficients(Gains(2000.0, 6000.0, 120.0, 0.0), Gains(0.6, 12.0, 0.01, 0.02))
    selections = np.random.default_rng(0).random((200, 3)) < 0.5
    together = HybridState(
        PidfState(*np.array([[15.0] * 3, [0.0] * 3, [0.0] * 3])),
        PidfState(*np.full((3, 3), 15.0)),
        np.array([True] * 3),
    )
    alone = [START] * 3
    for k, selection in enumerate(selections):
        each = [signals_at(k / RATE, seed) for seed in range(3)]
        together, efforts = hybrid.step(c, together, HybridSignals(*np.array(each).T), selection)
        for n in range(3):
            alone[n], effort = hybrid.step(c, alone[n], each[n], bool(selection[n]))
            assert efforts[n] == effort


def test_selection_follows_the_rules_of_the_paper():
    rules = SwitchingRules(tension_min_N=2.0, margin_N=1.0)
    for was in (True, False):
        for solved in (True, False):
            for tension in (0.0, 1.9, 2.5, 3.1, 20.0):
                if solved:
                    expected = True
                elif tension < 2.0:
                    expected = True  # otherwise the cable would sag
                else:
                    expected = was and tension < 3.0  # hysteresis while a slack cable is pulled
                assert rules.select(was, tension, solved) is expected
    both = rules.select(np.array([True, False]), np.array([2.5, 2.5]), np.array([False, False]))
    assert both.tolist() == [True, False]
    assert rules.tension_setpoint_N(15.0, solved=True) == 15.0
    assert rules.tension_setpoint_N(0.5, solved=True) == 2.0
    setpoint_N = rules.tension_setpoint_N(0.5, solved=False)
    assert not rules.select(previous=True, tension_N=setpoint_N, solved=False)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["tension_min_N", "margin_N"])
def test_rules_out_of_range_are_refused(name, value):
    with pytest.raises(InvalidInput, match=name):
        SwitchingRules(**{"tension_min_N": 2.0, "margin_N": 1.0, name: value})
