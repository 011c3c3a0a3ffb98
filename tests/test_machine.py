"""State machine of the reel in virtual time, on emulated hardware without processes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import plants
from estune.core import pidf
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.hardware.config import config_from
from estune.hardware.driver import Reading
from estune.hardware.loop_messages import Ended, Refused
from estune.hardware.shared_memory import MotionPhase, Word
from estune.trial import GUARD, LATE, SATURATED, Outcome
from estune.trial.profiles import StepProfile, TriangleProfile
from tests.support_hardware import VirtualLoop, config, tables

GOOD = Gains(1.0, 40.0, 0.015, 0.005)
WILD = Gains(8.0, 400.0, 0.015, 0.005)
STEP = StepProfile(15.0, 10.0, 0.2, 1.0)
RADIUS_PER_TORQUE = 1.0 / 20.0  # A/N of the emulated reel


def in_trial(loop: VirtualLoop, samples: int = 50, gains=GOOD, profile=STEP) -> None:
    """Runs to the middle of a trial."""
    loop.ask(gains, profile)
    loop.until(lambda: loop.machine.phase is MotionPhase.TRIAL)
    for _ in range(samples):
        loop.step()


def settle(loop: VirtualLoop) -> None:
    """Runs until the reel is held, without a trial."""
    loop.ask(GOOD, STEP)
    loop.answer()


def test_loop_of_another_machine_is_closed_at_its_first_sample_with_power():
    given = tables(measurement="force of a web, N")
    del given["guard"]["slack_N"], given["motion"]["take_up_A"], given["motion"]["taut_N"]
    loop = VirtualLoop(config_from(given, "web.toml"))
    loop.ask(GOOD, STEP)
    loop.step()
    assert loop.machine.phase is MotionPhase.HOLD
    assert loop.answer().outcome is Outcome.DONE


def test_trial_on_the_emulated_reel_equals_the_simulation():
    loop = VirtualLoop(config(motion__settle_s=1.0))
    loop.ask(GOOD, STEP)
    ended = loop.answer()
    record = loop.columns(ended.samples)
    simulated = plants.simulate(plants.reference_reel(), GOOD, STEP)
    assert ended.outcome is Outcome.DONE
    assert np.abs(record["tension_N"] - simulated.tension_N).max() < 0.02
    assert np.abs(record["current_A"] - simulated.effort_N * RADIUS_PER_TORQUE).max() < 0.002
    angle = record["angle_rad"] - simulated.angle_rad  # each in whole counts of its encoder
    assert np.ptp(angle) <= 2.1 * 2.0 * math.pi / 8192
    assert np.allclose(record["time_s"], simulated.time_s)
    assert not record["flags"].any()


def test_slack_is_taken_up_before_the_loop_is_closed():
    loop = VirtualLoop(config())
    assert not loop.machine.powered
    loop.ask(GOOD, STEP)
    loop.until(lambda: loop.machine.phase is MotionPhase.HOLD)
    assert all(current <= 0.2 + 1e-3 for current in loop.current_A[:-1])
    assert loop.tension_N[-1] >= 2.0


def test_gains_change_without_a_jump_of_the_current():
    loop = VirtualLoop(config(), noise_N=0.04)
    in_trial(loop, 0)
    before = len(loop.current_A)
    loop.answer()
    loop.step()
    jumps = np.abs(np.diff(loop.current_A))
    one_count = 2.0e-4
    assert jumps[before - 1] <= 1.01 * one_count  # the trial's first sample
    assert jumps[before + STEP.samples(632.0) - 1] <= 1.01 * one_count  # the first one after it
    live = pidf.coefficients(loop.rig.settings(), replace(GOOD, P=0.5))
    loop.machine.set_live_gains(live)
    loop.step()
    assert abs(loop.current_A[-1] - loop.current_A[-2]) <= 1.01 * one_count


def test_live_gains_hold_the_reel_after_a_trial():
    loop = VirtualLoop(config())
    loop.ask(GOOD, STEP)
    loop.answer()
    for _ in range(2000):
        loop.step()
    assert loop.machine.phase is MotionPhase.HOLD
    assert loop.tension_N[-1] == pytest.approx(15.0, abs=0.05)


def test_open_loop_trial_commands_its_setpoint():
    profile = TriangleProfile(15.0, amplitude_N=5.0, period_s=0.5, duration_s=1.0, loop="open")
    loop = VirtualLoop(config())
    loop.ask(GOOD, profile)
    ended = loop.answer()
    record = loop.columns(ended.samples)
    assert np.allclose(record["current_A"], record["setpoint_N"] * RADIUS_PER_TORQUE)
    before = len(loop.current_A)
    loop.step()
    assert abs(loop.current_A[before] - loop.current_A[before - 1]) <= 3e-4


def violent(loop: VirtualLoop) -> None:
    in_trial(loop, 0, gains=WILD)
    loop.until(lambda: loop.machine.answer is not None)


def slack(loop: VirtualLoop) -> None:
    in_trial(loop)
    gauge = loop.rig.plan().gauge
    zero = next(n for n in range(0, 2_000_000, 1000) if abs(gauge.force_N(n) - 0.0) < 0.01)
    for k in range(80):
        loop.step(Reading(loop.time_s + 1 / 632, zero + k % 2, 0))


def unreadable(loop: VirtualLoop) -> None:
    in_trial(loop)
    loop.step(Reading(loop.time_s + 1 / 632, 2**24 - 1, 0))


def frozen(loop: VirtualLoop) -> None:
    in_trial(loop)
    counts = loop.board.read(loop.time_s)
    for _ in range(80):
        loop.step(Reading(loop.time_s + 1 / 632, *counts))


def late(loop: VirtualLoop) -> None:
    in_trial(loop)
    for _ in range(11):
        loop.step(late=True)


def silent(loop: VirtualLoop) -> None:
    in_trial(loop)
    loop.step(silence_s=0.6)


def turn(loop: VirtualLoop) -> None:
    """The drum turns by more than the travel that the guard allows, and a little back."""
    for _ in range(10):
        loop.turned += 1000
        loop.step()
        if loop.memory.reason:
            loop.turned -= 1000
            return


def turning(loop: VirtualLoop) -> None:
    in_trial(loop)
    turn(loop)


FAULTS = {
    # fault: (outcome, controlled with the live gains if the safe state is "hold", latched)
    violent: (Outcome.GUARD, True, False),
    slack: (Outcome.GUARD, True, False),
    turning: (Outcome.GUARD, True, False),
    silent: (Outcome.INTERRUPTED, True, False),
    late: (Outcome.INTERRUPTED, False, False),
    unreadable: (Outcome.INTERRUPTED, False, True),
    frozen: (Outcome.INTERRUPTED, False, True),
}


@pytest.mark.parametrize("state", ["hold", "ramp"])
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_fault_ends_the_trial_at_once_in_the_safe_state(fault, state):
    outcome, holds, latched = FAULTS[fault]
    loop = VirtualLoop(config(safe__state=state))
    fault(loop)
    ended = loop.machine.answer
    assert isinstance(ended, Ended)
    assert ended.outcome is outcome
    assert ended.reason == loop.memory.reason != ""
    record = loop.columns(ended.samples)
    assert record["flags"][-1] & GUARD
    assert not (record["flags"][:-1] & GUARD).any()
    expected = MotionPhase.HOLD if holds and state == "hold" else MotionPhase.RAMP
    assert loop.machine.phase in (expected, MotionPhase.STOPPED)
    loop.step()
    assert bool(loop.memory.words[Word.LATCHED]) is latched


def test_safe_current_is_commanded_at_the_sample_crossing_a_limit():
    loop = VirtualLoop(config(safe__state="ramp", safe__ramp_s=0.0))
    violent(loop)
    assert loop.tension_N[-1] > 60.0 > loop.tension_N[-2]
    assert loop.current_A[-1] == 0.0


def test_ramp_has_its_duration_and_final_current():
    loop = VirtualLoop(config(safe__state="ramp", safe__current_A=0.3, safe__ramp_s=0.1))
    in_trial(loop)
    start = loop.current_A[-1]
    loop.step(late=False, silence_s=9.0)
    samples = round(0.1 * 632)
    for _ in range(samples):
        loop.step()
    ramp = np.array(loop.current_A[-samples - 1 :])
    assert np.allclose(np.diff(ramp[:-1]), (0.3 - start) / samples, atol=5e-4)
    assert loop.machine.phase is MotionPhase.STOPPED
    assert loop.current_A[-1] == pytest.approx(0.3, abs=2e-4)
    assert loop.machine.powered  # the current is not zero


def test_live_gains_recover_the_reel_for_the_next_trial():
    loop = VirtualLoop(config())
    violent(loop)
    loop.answer()
    loop.ask(GOOD, STEP, number=2)
    assert loop.answer().outcome is Outcome.DONE


def test_failed_recovery_latches_the_stop():
    loop = VirtualLoop(config())
    in_trial(loop)
    gauge = loop.rig.plan().gauge
    high = next(n for n in range(1_000_000, 16_000_000, 1000) if gauge.force_N(n) > 65.0)
    while loop.machine.phase is not MotionPhase.STOPPED:
        loop.step(Reading(loop.time_s + 1 / 632, high + len(loop.current_A) % 2, 0))
    samples_above = sum(tension > 60.0 for tension in loop.tension_N)
    assert samples_above >= round(0.3 * 632)  # the time the live gains were given
    loop.machine.answer = None
    loop.ask(GOOD, STEP, number=2)
    assert "check it, then clear it" in loop.answer().reason
    loop.machine.reset()
    loop.ask(GOOD, STEP, number=3)
    assert loop.answer().outcome is Outcome.DONE


def test_limit_crossed_under_the_live_gains_latches_the_stop():
    loop = VirtualLoop(config())
    settle(loop)
    turn(loop)
    assert loop.machine.phase is MotionPhase.RAMP
    loop.ask(GOOD, STEP, number=2)
    assert isinstance(loop.answer(), Refused)


def test_rig_takes_trials_after_a_lost_heartbeat():
    for state, phase in (("hold", MotionPhase.HOLD), ("ramp", MotionPhase.STOPPED)):
        loop = VirtualLoop(config(safe__state=state))
        settle(loop)
        for _ in range(300):
            loop.step(silence_s=0.6)
        assert loop.machine.phase is phase
        loop.ask(GOOD, STEP, number=2)
        assert loop.answer().outcome is Outcome.DONE


def test_hold_without_a_heartbeat_is_still_guarded():
    loop = VirtualLoop(config())
    settle(loop)
    loop.step(silence_s=0.6)
    assert loop.machine.phase is MotionPhase.HOLD
    for _ in range(5):  # further than the guard allows
        loop.turned += 1000
        loop.step(silence_s=0.6)
    assert loop.machine.phase in (MotionPhase.RAMP, MotionPhase.STOPPED)
    assert loop.memory.words[Word.LATCHED]


def test_recovery_from_a_trial_ends_with_the_next_one():
    """Its limits are wide, and know neither cost nor duration."""
    loop = VirtualLoop(config(safe__recover_s=30.0))
    violent(loop)
    loop.answer()
    violent(loop)
    assert loop.machine.answer.outcome is Outcome.GUARD
    assert "tension" in loop.machine.answer.reason


def test_missing_cable_is_reported():
    loop = VirtualLoop(config(motion__take_up_s=0.5))
    loop.ask(GOOD, STEP)
    for k in range(500):
        loop.step(Reading(loop.time_s + 1 / 632, 1_000_000 + k % 5, 0))
    assert "no tension above 2 N within 0.5 s" in loop.machine.answer.reason
    assert loop.machine.phase is MotionPhase.STOPPED


def test_unsettled_preload_is_reported():
    loop = VirtualLoop(config(motion__settle_N=1e-6, motion__settle_within_s=0.5), noise_N=0.04)
    loop.ask(GOOD, STEP)
    assert "have not kept the tension within 1e-06 N" in loop.answer().reason
    assert loop.machine.phase is MotionPhase.HOLD


def test_estop_acts_at_the_next_sample_and_stays():
    loop = VirtualLoop(config())
    in_trial(loop)
    loop.estop(on=True)
    loop.step()
    assert loop.machine.phase is MotionPhase.RAMP
    assert loop.machine.answer.outcome is Outcome.CANCELLED
    loop.machine.answer = None
    loop.machine.reset()  # while the stop is still pressed
    loop.ask(GOOD, STEP, number=2)
    assert "emergency stop" in loop.answer().reason
    loop.until(lambda: loop.machine.phase is MotionPhase.STOPPED)
    assert not loop.machine.powered
    assert loop.current_A[-1] == 0.0
    loop.estop(on=False)
    loop.machine.reset()
    loop.ask(GOOD, STEP, number=3)
    assert loop.answer().outcome is Outcome.DONE


@pytest.mark.parametrize("started", [True, False])
def test_abort_ends_a_trial_before_and_after_it_begins(started):
    loop = VirtualLoop(config())
    if started:
        in_trial(loop)
    else:
        loop.ask(GOOD, STEP)
    loop.memory.words[Word.ABORT] = 1
    ended = loop.answer()
    assert ended.outcome is Outcome.CANCELLED
    assert (ended.samples > 0) is started
    loop.ask(GOOD, STEP, number=2)
    assert loop.answer().outcome is Outcome.DONE


def test_shut_down_leaves_the_reel_without_current():
    loop = VirtualLoop(config())
    in_trial(loop)
    loop.machine.shut_down("over")
    loop.until(lambda: loop.machine.at_rest)
    assert loop.machine.answer.outcome is Outcome.INTERRUPTED
    assert loop.current_A[-1] == 0.0
    assert not loop.machine.powered


def test_late_and_saturated_samples_are_flagged():
    loop = VirtualLoop(config())
    in_trial(loop, 10)
    loop.step(late=True)
    record = loop.columns(11)
    assert record["flags"].tolist() == [0] * 10 + [LATE]
    low = VirtualLoop(config(limits__current_max_A=2.0, guard__current_max_A=3.0))
    low.ask(replace(GOOD, P=4.0, setpoint_filter_s=0.0), STEP)
    record = low.columns(low.answer().samples)
    limited = (record["current_A"] >= 2.0) | (record["current_A"] <= 0.0)
    assert 0 < limited.sum() < len(limited)
    assert np.array_equal(record["flags"] == SATURATED, limited)


def test_running_cost_equals_the_score_and_stops_the_trial():
    loop = VirtualLoop(config())
    cost = StepCost(0.13)
    shape = STEP.shape(632.0)
    weights = np.zeros(STEP.samples(632.0))
    weights[shape.sample :] = cost.weights(632.0, shape, len(weights)) / STEP.step_N**2
    loop.memory.weights[: len(weights)] = weights.data
    loop.ask(GOOD, STEP)
    whole = loop.columns(loop.answer().samples)
    error = whole["setpoint_N"] - whole["tension_N"]
    eta = cost.evaluate(632.0, shape, whole["setpoint_N"], whole["tension_N"], whole["current_A"])
    running = np.cumsum(weights * error**2)
    assert running[-1] == pytest.approx(eta)
    limit = 0.5 * eta
    loop.ask(GOOD, STEP, number=2, cost_max=limit)
    ended = loop.answer()
    assert ended.outcome is Outcome.GUARD
    assert "cost so far" in ended.reason
    assert ended.samples == pytest.approx(int(np.argmax(running > limit)) + 1, abs=1)


counts = st.floats(0.0, 2.0**24) | st.sampled_from([math.nan, math.inf, -1.0])
events = st.sampled_from(["", "", "", "", "ask", "ask", "estop", "release", "clear", "abort"])


@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(events, counts, st.integers(-9000, 9000), st.floats(-0.001, 0.1), st.booleans()),
        max_size=60,
    ),
    st.sampled_from(["hold", "ramp"]),
)
def test_machine_keeps_current_limits_and_estop_stops_the_drum(history, state):
    loop = VirtualLoop(config(safe__state=state, motion__settle_s=0.0, motion__settle_N=50.0))
    number, trials = 0, 0
    for event, gauge, encoder, gap, is_late in history:
        if event == "ask" and trials == 0:
            number, trials = number + 1, 1
            loop.ask(WILD, StepProfile(15.0, 10.0, 0.001, 0.01), number)
        elif event in ("estop", "release"):
            loop.estop(on=event == "estop")
        elif event == "clear":
            loop.machine.reset()
        elif event == "abort":
            loop.memory.words[Word.ABORT] = number
        loop.step(Reading(loop.time_s + gap, gauge, encoder), late=is_late)
        if loop.machine.answer is not None:
            assert trials == 1  # one answer for each trial
            trials, loop.machine.answer = 0, None
    assert all(-1e-3 <= current <= 6.0 + 1e-3 for current in loop.current_A)
    loop.estop(on=True)
    for _ in range(round(0.2 * 632) + 3):
        loop.step()
    assert loop.machine.at_rest
    assert loop.current_A[-1] == 0.0
