"""State machine of the reel where readings are bad, late or missing, in virtual time."""

import math

import numpy as np
import pytest

from estune.hardware.driver import Reading
from estune.hardware.shared_memory import MotionPhase, Word
from estune.trial import GUARD, LATE, Outcome
from tests.support_hardware import VirtualLoop, config
from tests.test_machine import GOOD, STEP, in_trial, settle

BAD = Reading(0.0, math.nan, 0, 0.0, "the board has not answered")


def encoder_jumps(loop: VirtualLoop) -> Reading:
    gauge, encoder = loop.board.read(loop.time_s)
    return Reading(loop.time_s + 1 / 632, gauge, encoder + 5000)


def stamp_stands(loop: VirtualLoop) -> Reading:
    return Reading(loop.time_s, *loop.board.read(loop.time_s))


def no_answer(loop: VirtualLoop) -> Reading:
    return BAD._replace(time_s=loop.time_s + 1 / 632)


BAD_READINGS = {
    encoder_jumps: "encoder went",
    stamp_stands: "time stamp",
    no_answer: "not answered",
}


@pytest.mark.parametrize("bad", BAD_READINGS, ids=lambda bad: bad.__name__)
def test_bad_readings_in_a_trial_are_bridged_up_to_the_rule_then_stop_and_latch(bad):
    loop = VirtualLoop(config())
    in_trial(loop)
    for _ in range(2):
        loop.step(bad(loop))
    assert loop.machine.phase is MotionPhase.TRIAL
    loop.step()
    for _ in range(3):
        loop.step(bad(loop))
    ended = loop.machine.answer
    assert ended.outcome is Outcome.INTERRUPTED
    assert BAD_READINGS[bad] in ended.reason
    assert "3 bad readings in a row" in ended.reason
    record = loop.columns(ended.samples)
    assert record["flags"][-6:].tolist() == [LATE, LATE, 0, LATE, LATE, GUARD]
    assert not np.isnan(record["tension_N"]).any()
    assert np.diff(record["time_s"]).min() > 0.0
    assert np.ptp(record["tension_N"][-3:]) == 0.0
    loop.until(lambda: loop.machine.phase is MotionPhase.STOPPED)
    loop.machine.answer = None
    loop.ask(GOOD, STEP, number=2)
    assert "clear it" in loop.answer().reason
    loop.machine.reset()
    loop.ask(GOOD, STEP, number=3)
    assert loop.answer().outcome is Outcome.DONE


def test_ramp_lasts_its_time_where_samples_are_long():
    loop = VirtualLoop(config(safe__state="ramp"))
    in_trial(loop)
    while loop.machine.phase is not MotionPhase.RAMP:
        loop.step(no_answer(loop))
    for _ in range(10):  # of 0.2 s
        loop.time_s += 0.02
        loop.step(no_answer(loop))
    assert loop.machine.phase is MotionPhase.STOPPED
    assert loop.current_A[-1] == 0.0


def test_ramp_lasts_its_number_of_samples_where_the_devices_clock_crawls():
    loop = VirtualLoop(config(safe__state="ramp"))
    in_trial(loop)
    while loop.machine.phase is not MotionPhase.RAMP:
        loop.step(no_answer(loop))
    stamp_s = loop.time_s
    for _ in range(round(0.21 * 632)):
        stamp_s += 1e-5
        loop.step(BAD._replace(time_s=stamp_s))
    assert loop.machine.phase is MotionPhase.STOPPED
    assert loop.current_A[-1] == 0.0


def test_time_without_a_good_reading_stops_the_reel_however_few_were_bad():
    loop = VirtualLoop(config(guard__bad_in_a_row=1000, guard__bad_s=0.02, guard__gap_s=1.0))
    in_trial(loop)
    loop.step(BAD._replace(time_s=loop.time_s + 0.019))
    assert loop.machine.phase is MotionPhase.TRIAL
    loop.step(BAD._replace(time_s=loop.time_s + 0.022))
    assert loop.machine.phase is MotionPhase.RAMP


def test_reel_at_rest_latches_after_half_a_second_without_a_reading_and_has_no_power():
    loop = VirtualLoop(config(safe__current_A=0.3))
    for _ in range(round(0.49 * 632)):
        loop.step(no_answer(loop))
    assert not loop.memory.words[Word.LATCHED]
    for _ in range(20):
        loop.step(no_answer(loop))
    assert loop.memory.words[Word.LATCHED]
    loop.machine.reset()
    settle(loop)
    for _ in range(200):
        loop.step(no_answer(loop))
    assert loop.machine.phase is MotionPhase.STOPPED
    assert loop.machine.powered  # the safe state has a current
    loop.machine.remove_power()
    assert not loop.machine.powered
    loop.machine.reset()
    settle(loop)
