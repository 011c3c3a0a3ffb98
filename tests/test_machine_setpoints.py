"""The reel machine under setpoints from above."""

import pytest

from estune.hardware.shared_memory import MotionPhase, SensorLevels, Word
from estune.trial import SETPOINT_S, Outcome
from tests.support_hardware import VirtualLoop, config
from tests.test_machine import GOOD, STEP


def follow(loop: VirtualLoop, setpoint_N: float) -> None:
    """What `HardwareRig.follow` writes."""
    loop.memory.target_N[0] = setpoint_N
    loop.memory.words[Word.SETPOINTS] += 1


def test_setpoint_takes_up_the_reel_holds_for_its_time_and_then_ramps_to_the_hold_tension():
    loop = VirtualLoop(config())
    follow(loop, 25.0)
    loop.step()
    assert loop.machine.phase is MotionPhase.TAKE_UP
    for _ in range(1000):
        follow(loop, 25.0)
        loop.step()
    assert loop.tension_N[-1] == pytest.approx(25.0, abs=0.1)
    last_s = loop.time_s
    loop.until(lambda: loop.memory.levels[SensorLevels.SETPOINT_N] < 25.0)
    assert loop.time_s - last_s == pytest.approx(SETPOINT_S, abs=2.0 / 632.0)
    ramped = loop.memory.levels[SensorLevels.SETPOINT_N]
    assert ramped == pytest.approx(25.0 - 50.0 / 632.0)  # at rate_N_s
    for _ in range(1000):
        loop.step()
    assert loop.machine.phase is MotionPhase.HOLD
    assert loop.tension_N[-1] == pytest.approx(15.0, abs=0.1)


def test_setpoints_do_not_move_a_reel_that_the_guard_has_latched():
    loop = VirtualLoop(config())
    for _ in range(1000):
        follow(loop, 25.0)
        loop.step()
    loop.board._motion.memory["x"][0] += 0.5  # a jerk of the cable
    for _ in range(1000):
        follow(loop, 25.0)
        loop.step()
    assert loop.machine.phase is MotionPhase.STOPPED
    assert not loop.machine.powered
    assert loop.memory.words[Word.LATCHED]


def test_trial_takes_the_reel_from_a_setpoint_to_its_preload():
    loop = VirtualLoop(config())
    for _ in range(1000):
        follow(loop, 25.0)
        loop.step()
    loop.ask(GOOD, STEP)
    while loop.machine.answer is None:
        follow(loop, 25.0)
        loop.step()
    assert loop.machine.answer.outcome is Outcome.DONE
    assert loop.columns(1)["tension_N"][0] == pytest.approx(15.0, abs=0.5)
