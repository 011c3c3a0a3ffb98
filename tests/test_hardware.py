"""Rig on hardware in wall-clock time: rig, loop and emulated reel in their own processes."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from estune.core.gains import Gains
from estune.errors import InvalidInput, RigError
from estune.hardware import HardwareRig
from estune.hardware.shared_memory import MotionPhase, Word
from estune.trial import LATE, Outcome, Setpoint, TrialRequest
from plants.emulator import EmulatedDriver
from plants.emulator.driver import emulated_hardware
from tests.support_hardware import loop_state, quick

pytestmark = pytest.mark.slow  # the loop keeps real time in a process of its own

ROOT = Path(__file__).parents[1]
GAINS = Gains(0.7, 12.0, 0.004, 0.01)
GIVE_UP_S = 30.0


@pytest.fixture(scope="module")
def address():
    """Address of emulated hardware, which outlives its drivers."""
    with emulated_hardware({"electronics": {"watchdog_s": 0.2}, "seed": 1}) as address:
        yield address


@pytest.fixture
def hardware(address):
    """Address of the hardware, and a function that reads its true state."""
    with EmulatedDriver(address) as watcher:
        before = watcher.truth().tripped

        def truth():
            now = watcher.truth()
            return now._replace(tripped=now.tripped - before)

        yield address, truth


def configuration(address: str, **changes):
    return quick(driver__settings={"address": address}, **changes)


@pytest.fixture
def rig(hardware):
    with HardwareRig(configuration(hardware[0])) as rig:
        yield rig


def ask(rig, number=0, gains=GAINS, **changes) -> TrialRequest:
    step = rig.describe().step
    profile = type(step)(**{n: getattr(step, n) for n in step.__slots__ if n != "kind"} | changes)
    return TrialRequest("run", number, gains, profile)


def eventually(holds) -> None:
    """Waits for a condition, with a limit for slow machines."""
    end = time.monotonic() + GIVE_UP_S
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.005)


@contextmanager
def in_background(call):
    """Runs a call in a thread; yields a list that receives its result or its error."""
    results = []

    def run():
        try:
            results.append(call())
        except RigError as error:
            results.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield results
    finally:
        thread.join(GIVE_UP_S)


@contextmanager
def agent(address: str):
    """Process with a rig on this hardware that holds the reel after one trial."""
    code = (
        "import sys; from estune.hardware import HardwareRig;"
        "from tests.support_hardware import quick; from tests.test_hardware import ask;"
        f"rig = HardwareRig(quick(driver__settings={{'address': {address!r}}}));"
        "rig.run(ask(rig)); print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout.readline() == "held\n"
            yield process
        finally:
            process.kill()


def test_rig_is_unpowered_before_the_first_trial_and_after_close(hardware):
    address, truth = hardware
    with HardwareRig(configuration(address)) as rig:
        eventually(lambda: rig.timing().samples > 50)
        assert not truth().powered
        assert rig.run(ask(rig)).outcome is Outcome.DONE
        assert truth().powered
        assert loop_state(rig).phase == "hold"
    assert not truth().powered
    assert truth().current_A == 0.0


def test_record_holds_what_the_hardware_did(rig, hardware):
    record = rig.run(ask(rig))
    assert record.outcome is Outcome.DONE
    spacing = np.diff(record.time_s)
    assert spacing.min() > 0.0  # time stamp of the reading, not of its deadline
    assert spacing.std() > 0.0
    assert record.tension_N[:20].mean() == pytest.approx(15.0, abs=1.0)
    eventually(lambda: abs(loop_state(rig).tension_N - hardware[1]().tension_N) < 0.5)


def test_telemetry_shows_a_trial_while_it_runs(rig):
    assert rig.telemetry(0) is None
    batches = []
    with in_background(lambda: rig.run(ask(rig, duration_s=1.0))) as results:
        eventually(lambda: rig.telemetry(0) is not None)
        while (batch := rig.telemetry(sum(part.tension_N.size for part in batches))) is not None:
            batches.append(batch)
    (record,) = results
    tension = np.concatenate([part.tension_N for part in batches])
    assert {part.trial_id for part in batches} == {record.trial_id}
    assert 0 < tension.size <= record.tension_N.size
    np.testing.assert_array_equal(tension, record.tension_N[: tension.size])


def test_apply_changes_gains_while_the_reel_is_held(rig, hardware):
    rig.run(ask(rig))
    for P in (0.2, 0.8, 0.4):
        rig.apply(Gains(P, 12.0, 0.01, 0.03))
    assert rig.describe().gains.P == 0.4
    assert loop_state(rig).phase == "hold"
    assert hardware[1]().tripped == 0


def test_killed_loop_leaves_the_reel_to_the_hardwares_watchdog(hardware):
    address, truth = hardware
    with HardwareRig(configuration(address)) as rig:
        rig.run(ask(rig))
        os.kill(rig._loop.process.pid, signal.SIGKILL)
        eventually(lambda: truth().tripped == 1)
        assert truth().current_A == 0.0
        for call in (rig.describe, rig.timing, lambda: rig.run(ask(rig, 1)), rig.abort):
            with pytest.raises(RigError, match="loop has ended"):
                call()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_loop_killed_or_hung_in_a_trial_is_a_permanent_error(hardware, number):
    address, truth = hardware
    with HardwareRig(configuration(address)) as rig:
        with in_background(lambda: rig.run(ask(rig, duration_s=8.0))) as results:
            eventually(lambda: loop_state(rig).phase == "trial")
            os.kill(rig._loop.process.pid, number)
        (error,) = results
        assert isinstance(error, RigError)
        assert rig._loop.process.poll() is not None
        eventually(lambda: truth().tripped == 1)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_killed_or_hung_rig_program_leaves_the_reel_safe(hardware, number):
    address, truth = hardware
    with agent(address) as process:
        assert truth().powered
        process.send_signal(number)
        if number == signal.SIGKILL:
            eventually(lambda: not truth().powered)
            assert truth().tripped == 0  # regular release by the loop itself
        else:
            written = truth().written
            eventually(lambda: truth().written > written + 500)
            assert truth().powered  # its safe state is closed-loop control with the live gains
            assert truth().tension_N == pytest.approx(15.0, abs=3.0)


def test_jump_of_the_time_of_day_is_logged_once(rig, monkeypatch, caplog):
    rig.run(ask(rig))
    assert "time of day" not in caplog.text
    day = time.time
    monkeypatch.setattr(time, "time", lambda: day() - 3600.0)
    rig.run(ask(rig, 1))
    rig.run(ask(rig, 2))
    assert caplog.text.count("the time of day jumped by -3.6e+03 s") == 1


class ObservedLock:
    """Lock that sets an event when an acquisition times out."""

    def __init__(self, lock, in_vain):
        self._lock, self._in_vain = lock, in_vain

    def acquire(self, timeout=-1):
        acquired = self._lock.acquire(timeout=timeout)
        if not acquired:
            self._in_vain.set()
        return acquired

    def release(self):
        self._lock.release()

    def __enter__(self):
        return self.acquire()

    def __exit__(self, *_):
        self.release()


def test_abort_during_preparation_stops_the_trial(hardware):
    with HardwareRig(configuration(hardware[0])) as rig:
        prepare, started, aborted = rig._prepare, threading.Event(), threading.Event()

        def until_said(request, compensation):
            started.set()
            assert aborted.wait(GIVE_UP_S)
            return prepare(request, compensation)

        # The abort comes once before the trial has a number, so it reaches no trial.
        rig._prepare, rig._trial = until_said, ObservedLock(rig._trial, aborted)
        with in_background(lambda: rig.run(ask(rig, duration_s=8.0))) as results:
            assert started.wait(GIVE_UP_S)
            assert rig.abort().gains == rig.describe().gains
        (record,) = results
        assert record.outcome is Outcome.CANCELLED


def test_interrupted_call_stops_its_trial_and_the_next_one_runs(rig):
    pipe, words = rig._loop._pipe, rig._memory.words
    interrupts = iter([KeyboardInterrupt])

    def poll(within_s):
        if words[Word.PHASE] == MotionPhase.TRIAL:
            for interrupt in interrupts:
                raise interrupt
        return pipe.poll(within_s)

    rig._loop._pipe = SimpleNamespace(poll=poll, send=pipe.send, recv=pipe.recv, close=pipe.close)
    with pytest.raises(KeyboardInterrupt):
        rig.run(ask(rig, duration_s=8.0))
    assert rig.abort().gains == rig.describe().gains
    assert words[Word.PHASE] == MotionPhase.HOLD
    assert rig.run(ask(rig, 1)).outcome is Outcome.DONE


def test_lost_hardware_stops_the_reel_and_ends_nothing(hardware):
    address, _ = hardware
    with emulated_hardware({"electronics": {"watchdog_s": 0.2}}) as other:
        rig = HardwareRig(configuration(other))
        rig.run(ask(rig))
    eventually(lambda: loop_state(rig).phase == "stopped")
    with pytest.raises(RigError, match=r"emulated hardware .* clear it"):
        rig.run(ask(rig, 1))
    rig.close()
    with HardwareRig(configuration(address)) as rig:  # another rig is unaffected
        assert rig.run(ask(rig)).outcome is Outcome.DONE


def stalling(address, stalled, **changes):
    """Configuration of a rig so many of whose readings in a row do not come, in its trial."""
    stall = {"address": address, "stall_at": 300, "stalled": stalled}
    table = {"use": "tests.support_drivers:StallingDriver", "settings": stall}
    return quick(driver=table, **changes)


def test_bad_readings_within_the_rule_are_bridged_and_flagged(address):
    with HardwareRig(stalling(address, 2, guard__bad_s=1.0)) as rig:
        record = rig.run(ask(rig, step_at_s=0.9, duration_s=1.0))
        assert record.outcome is Outcome.DONE
        assert (record.flags & LATE).sum() >= 2
        assert rig._memory.fault == "reading 301 did not come"


def test_bad_readings_beyond_the_rule_stop_the_reel_until_it_is_cleared(address):
    with HardwareRig(stalling(address, 10)) as rig:
        record = rig.run(ask(rig, step_at_s=0.9, duration_s=1.0))
        assert record.outcome is Outcome.INTERRUPTED
        assert re.match("reading 30[0-2] did not come .*bad reading", record.reason)
        with pytest.raises(RigError, match=r"did not come .* clear it"):
            rig.run(ask(rig, 1))
        eventually(lambda: loop_state(rig).phase == "stopped")
        rig.clear()
        assert rig.run(ask(rig, 2)).outcome is Outcome.DONE


def test_device_that_falls_silent_is_opened_again_without_power(address):
    with EmulatedDriver(address) as watcher, HardwareRig(stalling(address, 10**6)) as rig:
        rig.run(ask(rig, step_at_s=0.9, duration_s=1.0))
        # The driver that is opened again reads 299 times before it falls silent, too.
        eventually(lambda: rig._memory.fault == "reading 300 did not come")
        bad = rig._memory.words[Word.BAD]
        eventually(lambda: rig._memory.words[Word.BAD] > bad + 1000)
        assert not watcher.truth().powered
        assert loop_state(rig).latched
        assert rig.describe().gains == quick().describe().gains


def test_estop_acts_at_once_and_stays_until_cleared(rig, hardware):
    with in_background(lambda: rig.run(ask(rig, duration_s=8.0))) as results:
        eventually(lambda: loop_state(rig).phase == "trial")
        rig.estop("a hand in the cable")
        eventually(lambda: not hardware[1]().powered)
    (record,) = results
    assert (record.outcome, record.reason) == (
        Outcome.CANCELLED,
        "emergency stop: a hand in the cable",
    )
    assert loop_state(rig).latched
    for call in (lambda: rig.run(ask(rig, 1)), lambda: rig.apply(GAINS)):
        with pytest.raises(RigError, match="a hand in the cable"):
            call()
    rig.clear()
    assert rig.run(ask(rig, 2)).outcome is Outcome.DONE


def test_setpoints_are_followed_until_they_stop_or_the_rig_is_stopped(rig):
    def follow():
        return rig.follow(Setpoint(20.0))

    eventually(lambda: abs(follow().tension_N - 20.0) < 0.5)
    eventually(lambda: abs(loop_state(rig).tension_N - 15.0) < 0.5)  # no more setpoints
    with pytest.raises(InvalidInput, match="no position controller"):
        rig.follow(Setpoint(20.0, 1.0))
    with pytest.raises(InvalidInput, match="outside the rig's range"):
        rig.follow(Setpoint(4.0))
    rig.estop("a hand in the cable")
    with pytest.raises(RigError, match="a hand in the cable"):
        follow()


def test_close_ends_a_trial_under_way(hardware):
    rig = HardwareRig(configuration(hardware[0]))
    with in_background(lambda: rig.run(ask(rig, duration_s=8.0))) as results:
        eventually(lambda: loop_state(rig).phase == "trial")
        rig.close()
    assert results[0].outcome is Outcome.CANCELLED
    assert not hardware[1]().powered


def test_unstable_gains_give_a_record_and_live_gains_are_restored(rig):
    wild = Gains(12.0, 600.0, 0.015, 0.005)
    record = rig.run(ask(rig, gains=wild, duration_s=3.0))
    assert record.outcome is Outcome.GUARD
    assert "limit" in record.reason
    assert rig.run(ask(rig, 1)).outcome is Outcome.DONE


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"driver__use": "nobody"}, "no installed package offers a driver 'nobody'"),
        ({"driver__use": "plants.emulator:Nothing"}, "has no 'Nothing'"),
        ({"driver__use": "argparse:Namespace"}, "is no driver"),
        ({"driver__settings": {"colour": "red"}}, "colour"),
        ({"driver__settings": {"reel": {"tension_N": 1e3}}}, "tension is 1000 N"),
    ],
)
def test_unusable_driver_is_refused_with_the_reason(changes, words):
    with pytest.raises((InvalidInput, RigError), match=words):
        HardwareRig(quick(**changes))


def test_missing_hardware_is_reported(tmp_path):
    with pytest.raises(RigError, match="no emulated hardware at"):
        HardwareRig(configuration(str(tmp_path / "nothing")))


def test_driver_is_found_by_its_entry_point_name(tmp_path, monkeypatch):
    package = tmp_path / "acme-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: acme\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text(
        "[estune.drivers]\nacme = plants.emulator:EmulatedDriver\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with HardwareRig(quick(driver__use="acme")) as rig:
        assert rig.run(ask(rig)).outcome is Outcome.DONE
