"""Link over Zenoh: restarts, cuts and kills."""

import signal
import sqlite3
import subprocess
import sys
import threading
import time
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import estune
import plants
from estune.core.gains import Gains
from estune.errors import Interrupted, InvalidInput, RigError
from estune.remote import zenoh
from estune.remote.state_machine.state import Mode
from estune.remote.state_machine.trials import TrialState
from estune.remote.zenoh.endpoints import with_port
from estune.trial import Outcome, TrialRequest
from experiments.chaos.wire import Wire
from tests.serve_rig import served
from tests.support_rigs import ScriptedRig, description, response, same

SOON_S = 0.3
"""Timeout for a rig that is known to be absent."""
ENDS_WITHIN_S = 30.0
"""Generous time limit of a process, on a slow machine."""


def trial(number: int = 0, **changes) -> TrialRequest:
    gains = Gains(0.7, 12.0, 0.004, 0.01)
    return TrialRequest("run", number, gains, replace(description().step, **changes))


def until(condition) -> None:
    """Waits until a condition holds."""
    while not condition():
        time.sleep(0.005)


# --- restarts, cuts and kills ---


def test_second_client_is_refused_with_the_holder_but_may_stop():
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


def test_trials_over_a_wire_cut_repeatedly_run_once_each():
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
    assert rig.requests == trials
    assert all(same(response(t), r) for t, r in zip(trials, records, strict=True))


@pytest.mark.slow
def test_tuning_survives_an_outage_within_the_patience(caplog):
    rig = ScriptedRig(duration_s=0.05)
    with zenoh.serve(rig) as server, Wire(server.endpoint) as wire:
        threading.Timer(1.0, wire.stall).start()
        threading.Timer(7.0, wire.flow).start()
        result = estune.tune(wire.endpoint, trials=25, journal=False, watch=None)
    assert result.success
    ids = [request.trial_id for request in rig.requests]
    assert len(set(ids)) == len(ids)
    client = (r for r in caplog.records if r.name == "estune.remote.zenoh.rig_connection")
    waiting, back = (
        record.getMessage() for record in client if "lease" not in record.getMessage()
    )
    assert "its process has ended or the network is cut" in waiting
    assert "waiting for it, at most 30 s" in waiting
    assert back.endswith("replies again")


def test_rig_that_appears_later_is_found_within_the_patience():
    endpoint = with_port("tcp/127.0.0.1:0")
    servers = []
    late = threading.Timer(0.5, lambda: servers.append(zenoh.serve(ScriptedRig(), endpoint)))
    with pytest.raises(RigError, match="start a rig"):
        zenoh.connect(endpoint, timeout_s=0.2)
    late.start()
    with zenoh.connect(endpoint, timeout_s=0.2, found_within_s=30.0) as rig:
        assert rig.run(trial()).outcome is Outcome.DONE
    servers[0].close()


def test_outage_beyond_the_patience_ends_the_wait_but_abort_is_not_delayed():
    rig = ScriptedRig(duration_s=0.05)
    with (
        zenoh.serve(rig) as server,
        Wire(server.endpoint) as wire,
        zenoh.connect(wire.endpoint, timeout_s=SOON_S, patience_s=60.0) as patient,
        zenoh.connect(wire.endpoint, timeout_s=SOON_S, patience_s=1.0) as client,
    ):
        wire.stall()
        began_s = time.monotonic()
        with pytest.raises(RigError, match=r"does not reply|network is cut"):
            client.describe()
        assert time.monotonic() - began_s > 1.0
        with pytest.raises(RigError, match="network is cut"):
            patient.abort()
        assert time.monotonic() - began_s < 30.0


def test_trial_whose_first_reply_is_lost_runs_once():
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
    assert rig.requests == trials


@pytest.mark.slow
def test_trial_survives_a_rig_frozen_longer_than_the_lease():
    with served("unhurried") as server, zenoh.connect(server.endpoint, timeout_s=10.0) as client:
        server.freeze()
        threading.Timer(2.5, server.process.send_signal, [signal.SIGCONT]).start()
        assert same(client.run(trial()), replace(response(trial()), rig="reel"))


@pytest.mark.slow
def test_rig_killed_during_a_trial_raises_that_it_may_have_run():
    with (
        served("slow scripted") as server,
        zenoh.connect(server.endpoint, timeout_s=SOON_S) as client,
    ):
        threading.Timer(0.2, server.process.kill).start()
        with pytest.raises(RigError, match=r"trial run-00000 may have run: .*is gone.* resume"):
            client.run(trial())
        with pytest.raises(RigError, match=r"is gone.* restart it"):
            client.describe()


def states(ledger: Path) -> list[str]:
    """States of the trials in a ledger that another process writes."""
    with closing(sqlite3.connect(ledger)) as file:
        return [state for (state,) in file.execute("SELECT state FROM trial")]


@contextmanager
def run_across_a_restart(kind: str, first: Path, second: Path):
    """A trial on a slow rig that is killed in the middle of it and restarted as a quick one."""
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
        # Not the mode: a trial that has only been accepted never started, and is no cut.
        until(lambda: states(first) == [TrialState.RUNNING])
        server.process.kill()
        server.process.wait()
        quick = "scripted" if kind == "slow scripted" else kind
        with served(quick, "reel", server.endpoint, ledger=second):
            running.join()
            yield client, results[0]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["slow scripted", "moving scripted"])
def test_trial_interrupted_by_a_restart_is_reported_not_repeated(kind, tmp_path):
    with run_across_a_restart(kind, tmp_path / "l", tmp_path / "l") as (client, record):
        assert record.outcome is Outcome.INTERRUPTED
        assert "restarted in the middle" in record.reason
        assert record.trial_id == trial().trial_id
        assert record.time_s.size == 0
        assert client.run(trial()).outcome is Outcome.INTERRUPTED


@pytest.mark.slow
def test_trial_on_a_moving_rig_without_its_ledger_is_not_repeated(tmp_path):
    with run_across_a_restart("moving scripted", tmp_path / "1", tmp_path / "2") as (_, error):
        assert isinstance(error, Interrupted)  # so that a daemon pauses
        assert "with another ledger" in str(error)
        assert "trial run-00000 may have run" in str(error)


@pytest.mark.slow
def test_trial_on_a_simulated_rig_without_its_ledger_is_repeated(tmp_path):
    with run_across_a_restart("slow scripted", tmp_path / "1", tmp_path / "2") as (_, record):
        assert same(record, replace(response(trial()), rig="reel"))


@pytest.mark.slow
def test_client_follows_a_rig_restarted_between_trials(tmp_path):
    ledger = tmp_path / "ledger"
    with served("scripted", ledger=ledger) as server, zenoh.connect(server.endpoint) as client:
        first = client.run(trial())
        server.process.kill()
        server.process.wait()
        with served("scripted", "reel", server.endpoint, ledger=ledger):
            assert same(client.run(trial()), first)
            assert client.run(trial(1)).outcome is Outcome.DONE


@pytest.mark.slow
def test_client_killed_during_a_trial_stops_it():
    text = """
import sys
from estune.remote import zenoh
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
        assert "for 1 s, so the lease expired" in record.reason


@pytest.mark.slow
def test_lease_is_renewed_while_the_main_thread_computes():
    text = """
import sys, time
from estune.remote import zenoh
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


def test_client_reacquires_an_expired_lease():
    with served("scripted") as server, zenoh.connect(server.endpoint) as client:
        client.run(trial())
        client._lease._renewal.remove(client._lease)  # it renews no more
        with zenoh.connect(server.endpoint) as witness:
            until(lambda: witness.status().mode is Mode.IDLE)
        assert client.run(trial(1)).outcome is Outcome.DONE


def test_run_assembles_records_in_parts():
    rig = ScriptedRig()
    with zenoh.serve(rig, part_bytes=1000) as server, zenoh.connect(server.endpoint) as client:
        for number in range(3):
            assert same(client.run(trial(number)), response(trial(number)))
    assert len(rig.requests) == 3


def test_watch_yields_samples_of_the_active_trial():
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
        assert (first.trial_id, first.first_sample) == (request.trial_id, 0)
        seen = first
        while seen.first_sample == 0:
            seen = next(chunks)
        place = slice(seen.first_sample, seen.first_sample + seen.tension_N.size)
        np.testing.assert_allclose(seen.tension_N, record.tension_N[place], rtol=1e-6)
        np.testing.assert_allclose(seen.current_A, record.current_A[place], rtol=1e-6)
    rig.close()


def test_rig_is_asked_for_samples_only_while_somebody_subscribes(monkeypatch):
    rig, asked = plants.reference_reel().rig(name="reel", pace=0.5), []
    telemetry = type(rig).telemetry
    monkeypatch.setattr(type(rig), "telemetry", lambda *at: asked.append(at) or telemetry(*at))
    gains, step = rig.describe().gains, rig.describe().step
    with zenoh.serve(rig) as server, zenoh.connect(server.endpoint) as client:
        client.run(TrialRequest("unwatched", 0, gains, step))
        assert not asked
        with client.watch() as chunks:
            client.run(TrialRequest("watched", 0, gains, step))
            assert next(chunks).trial_id == "watched-00000"
    rig.close()


def test_serve_of_a_moving_rig_without_a_ledger_is_refused():
    with pytest.raises(InvalidInput, match="name a ledger file"):
        zenoh.serve(ScriptedRig(simulated=False))


# --- end of a process ---


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
    """Output of a process that ends by itself with exit code 0."""
    try:
        output, _ = process.communicate(timeout=ENDS_WITHIN_S)
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    assert process.returncode == 0, output
    return output
