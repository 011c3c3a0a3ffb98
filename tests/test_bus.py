"""The link over Zenoh: what it survives, and how it ends."""

import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import plants
from estune.core.gains import Gains
from estune.errors import InvalidInput, RigError
from estune.remote import zenoh
from estune.remote.state_machine.state import Mode
from estune.trial import Outcome, TrialRequest
from experiments.chaos.wire import Wire
from tests.serve_rig import served
from tests.support_rigs import ScriptedRig, description, response, same

SOON_S = 0.3
"""How long a test waits for a rig that it knows is not there."""
ENDS_WITHIN_S = 30.0
"""A generous time for a process that is not hung, on a slow machine."""


def trial(number: int = 0, **changes) -> TrialRequest:
    gains = Gains(0.7, 12.0, 0.004, 0.01)
    return TrialRequest("run", number, gains, replace(description().step, **changes))


def until(condition) -> None:
    """Waits until something has come about."""
    while not condition():
        time.sleep(0.005)


# --- what it survives ---


def test_a_second_client_is_told_who_holds_the_rig_and_can_stop_it_all_the_same():
    with (
        served("slow scripted") as server,
        zenoh.connect(server.endpoint, holder="anna") as first,
        zenoh.connect(server.endpoint, holder="bert") as second,
    ):
        records = []
        running = threading.Thread(target=lambda: records.append(first.run(trial())))
        running.start()
        until(lambda: second.status().mode is Mode.RUNNING)
        for call in (
            *(lambda: second.apply(trial().gains), lambda: second.run(trial(1))),
            second.abort,
        ):
            with pytest.raises(RigError, match="the rig is held by anna"):
                call()
        second.estop("it smokes")
        running.join()
        assert records[0].outcome is Outcome.CANCELLED
        assert records[0].reason == "emergency stop: it smokes"
        with pytest.raises(RigError, match=r"safe state after an emergency stop \(it smokes\)"):
            first.run(trial(1))
        first.release()
        second.clear()
        second.apply(trial().gains)
        assert second.describe().gains == trial().gains


def test_trials_over_a_wire_cut_again_and_again_run_once_each_and_arrive():
    rig = ScriptedRig(duration_s=0.02)
    trials = [trial(number) for number in range(25)]
    with (
        zenoh.serve(rig) as server,
        Wire(server.endpoint) as wire,
        zenoh.connect(wire.endpoint) as client,
    ):
        done = threading.Event()

        def cut() -> None:
            while not done.wait(0.07):
                wire.cut()

        cutting = threading.Thread(target=cut)
        cutting.start()
        try:
            records = [client.run(request) for request in trials]
        finally:
            done.set()
            cutting.join()
    assert rig.asked == trials
    assert all(same(response(t), r) for t, r in zip(trials, records, strict=True))


def test_a_trial_whose_first_answer_is_lost_runs_once_all_the_same():
    rig = ScriptedRig()
    trials = [trial(number) for number in range(5)]
    with (
        zenoh.serve(rig) as server,
        Wire(server.endpoint) as wire,
        zenoh.connect(wire.endpoint) as client,
    ):
        for request in trials:
            wire.lose_next_answer()
            assert same(client.run(request), response(request))
    assert rig.asked == trials


def test_a_trial_survives_a_rig_that_hangs_longer_than_its_lease():
    with served("unhurried") as server, zenoh.connect(server.endpoint, timeout_s=10.0) as client:
        server.process.send_signal(signal.SIGSTOP)
        threading.Timer(2.5, server.process.send_signal, [signal.SIGCONT]).start()
        assert same(client.run(trial()), replace(response(trial()), rig="reel"))


def test_a_rig_killed_in_a_trial_is_gone_and_the_error_says_what_is_known():
    with (
        served("slow scripted") as server,
        zenoh.connect(server.endpoint, timeout_s=SOON_S) as client,
    ):
        threading.Timer(0.2, server.process.kill).start()
        with pytest.raises(RigError, match=r"is gone.* trial run-00000 may have run.* resume"):
            client.run(trial())
        with pytest.raises(RigError, match=r"is gone.* start it again"):
            client.describe()


@contextmanager
def run_across_a_restart(kind: str, first: Path, second: Path):
    """A trial on a slow rig that is killed in the middle of it and comes back quick."""
    with (
        served(kind, ledger=first) as server,
        zenoh.connect(server.endpoint, timeout_s=20) as client,
    ):
        results = []

        def run() -> None:
            try:
                results.append(client.run(trial()))
            except RigError as error:
                results.append(error)

        running = threading.Thread(target=run)
        running.start()
        with zenoh.connect(server.endpoint) as witness:
            until(lambda: witness.status().mode is Mode.RUNNING)
        server.process.kill()
        server.process.wait()
        quick = "scripted" if kind == "slow scripted" else kind
        with served(quick, "reel", server.endpoint, ledger=second):
            running.join()
            yield client, results[0]


@pytest.mark.parametrize("kind", ["slow scripted", "moving scripted"])
def test_a_trial_interrupted_by_a_restart_is_told_as_that_and_not_run_again(kind, tmp_path):
    with run_across_a_restart(kind, tmp_path / "l", tmp_path / "l") as (client, record):
        assert record.outcome is Outcome.INTERRUPTED
        assert "restarted in the middle" in record.reason
        assert record.trial_id == trial().trial_id
        assert record.time_s.size == 0
        assert client.run(trial()).outcome is Outcome.INTERRUPTED


def test_a_trial_on_a_rig_that_moves_and_lost_its_ledger_is_not_asked_for_again(tmp_path):
    with run_across_a_restart("moving scripted", tmp_path / "1", tmp_path / "2") as (_, error):
        assert "remembers nothing" in str(error)
        assert "trial run-00000 may have run" in str(error)


def test_a_trial_on_a_simulated_rig_that_lost_its_ledger_is_run_again(tmp_path):
    with run_across_a_restart("slow scripted", tmp_path / "1", tmp_path / "2") as (_, record):
        assert same(record, replace(response(trial()), rig="reel"))


def test_a_rig_restarted_between_two_trials_is_followed(tmp_path):
    ledger = tmp_path / "ledger"
    with served("scripted", ledger=ledger) as server, zenoh.connect(server.endpoint) as client:
        first = client.run(trial())
        server.process.kill()
        server.process.wait()
        with served("scripted", "reel", server.endpoint, ledger=ledger):
            assert same(client.run(trial()), first)
            assert client.run(trial(1)).outcome is Outcome.DONE


def test_a_client_killed_in_a_trial_has_it_stopped_within_its_lease():
    text = """
import sys
from estune import bus
from tests.test_bus import trial
zenoh.connect(sys.argv[1]).run(trial())
"""
    with served("slow scripted") as server, zenoh.connect(server.endpoint) as witness:
        process = script(text, server.endpoint)
        until(lambda: witness.status().mode is Mode.RUNNING)
        process.kill()
        process.wait()
        process.stdout.close()
        until(lambda: witness.status().mode is Mode.IDLE)
        record = witness.run(trial())
        assert record.outcome is Outcome.CANCELLED
        assert "has not been heard of for 1 s" in record.reason


def test_a_client_whose_main_thread_computes_keeps_its_lease():
    text = """
import sys, time
from estune import bus
from tests.test_bus import trial
with zenoh.connect(sys.argv[1]) as rig:
    rig.apply(trial().gains)
    lease = rig._lease.token
    until = time.monotonic() + 3.0
    while time.monotonic() < until:
        sum(range(10**6))
    rig.apply(trial().gains)
    print(lease == rig._lease.token)
"""
    with served("scripted") as server:
        assert end(script(text, server.endpoint)).split() == ["True"]


def test_a_client_that_was_stopped_longer_than_its_lease_takes_it_again():
    with served("scripted") as server, zenoh.connect(server.endpoint) as client:
        client.run(trial())
        client._lease._ended.set()  # it renews no more
        with zenoh.connect(server.endpoint) as witness:
            until(lambda: witness.status().mode is Mode.IDLE)
        assert client.run(trial(1)).outcome is Outcome.DONE


def test_records_in_parts_are_put_together():
    rig = ScriptedRig()
    with zenoh.serve(rig, part_bytes=1000) as server, zenoh.connect(server.endpoint) as client:
        for number in range(3):
            assert same(client.run(trial(number)), response(trial(number)))
    assert len(rig.asked) == 3


def test_samples_of_a_trial_under_way_can_be_watched():
    rig = plants.reference_reel().rig(name="reel", pace=1.0)
    with (
        zenoh.serve(rig) as server,
        zenoh.connect(server.endpoint) as client,
        zenoh.connect(server.endpoint) as onlooker,
        onlooker.watch() as chunks,
    ):
        request = TrialRequest("watched", 0, rig.describe().gains, rig.describe().step)
        record = client.run(request)
        first = next(chunks)
        assert (first.trial_id, first.first) == (request.trial_id, 0)
        seen = first
        while seen.first == 0:
            seen = next(chunks)
        place = slice(seen.first, seen.first + seen.tension_N.size)
        np.testing.assert_allclose(seen.tension_N, record.tension_N[place], rtol=1e-6)
        np.testing.assert_allclose(seen.current_A, record.current_A[place], rtol=1e-6)
    rig.close()


def test_a_rig_that_moves_is_not_served_without_a_ledger():
    with pytest.raises(InvalidInput, match="name a ledger file"):
        zenoh.serve(ScriptedRig(simulated=False))


def test_what_a_rigs_own_program_raises_reaches_the_client():
    with served("broken") as server, zenoh.connect(server.endpoint) as client:
        for _ in range(2):
            with pytest.raises(RigError, match="ZeroDivisionError: no answer to 0"):
                client.run(trial())


# --- how it ends ---


def script(text: str, *arguments: str, **options) -> subprocess.Popen:
    """A process that runs a few lines of Python."""
    return subprocess.Popen(
        [sys.executable, "-c", text, *arguments],
        cwd=Path(__file__).parent.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        **options,
    )


def end(process: subprocess.Popen) -> str:
    """What a process printed, once it has ended by itself, in good order."""
    try:
        output, _ = process.communicate(timeout=ENDS_WITHIN_S)
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    assert process.returncode == 0, output
    return output


def test_a_client_that_forgets_to_close_ends_all_the_same():
    text = """
import sys
from estune import bus
from tests.test_bus import trial
rig = zenoh.connect(sys.argv[1])
print(rig.run(trial()).outcome)
"""
    with served("scripted") as server:
        assert end(script(text, server.endpoint)).split() == ["done"]


def test_a_server_that_forgets_to_close_stops_its_trial_and_ends():
    text = """
import threading
from estune import bus
from tests.support_rigs import ScriptedRig
from tests.test_bus import trial

class Telling(ScriptedRig):
    def _perform(self, request):
        record = super()._perform(request)
        print(record.outcome)
        return record

rig = Telling(duration_s=100.0)
server = zenoh.serve(rig)
client = zenoh.connect(server.endpoint)
threading.Thread(target=client.run, args=(trial(),), daemon=True).start()
while not rig.asked:
    pass
"""
    assert "cancelled" in end(script(text))


def test_ctrl_c_gets_through_while_a_trial_runs_and_the_trial_can_be_stopped():
    text = """
import signal, sys
from estune import bus
from tests.test_bus import trial
signal.signal(signal.SIGINT, signal.default_int_handler)  # also where a shell's & has it ignored
with zenoh.connect(sys.argv[1]) as rig:
    try:
        print("running", flush=True)
        rig.run(trial())
    except KeyboardInterrupt:
        print(rig.abort().name)
"""
    with served("slow scripted") as server, zenoh.connect(server.endpoint) as witness:
        process = script(text, server.endpoint)
        assert process.stdout.readline() == "running\n"
        until(lambda: witness.status().mode is Mode.RUNNING)
        process.send_signal(signal.SIGINT)
        assert end(process).split() == ["reel"]
        witness.apply(trial().gains)


def test_a_rig_let_go_of_closes_its_session():
    with zenoh.serve(ScriptedRig()) as server:
        client = zenoh.connect(server.endpoint)
        client.run(trial())  # which begins to keep a lease
        session = client._talk.session
        del client
        assert session.is_closed()


def test_a_closed_server_is_not_found_and_its_port_is_free():
    server = zenoh.serve(ScriptedRig())
    server.close()
    server.wait()
    with pytest.raises(RigError, match="nothing"):
        zenoh.connect(server.endpoint, timeout_s=SOON_S)
    with zenoh.serve(ScriptedRig(), server.endpoint) as again:
        assert again.instance != server.instance
    server.close()
