"""Daemons with rigs over Zenoh: faults, overload, kills and restarts."""

import json
import signal
import time
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from estune.cli.faults import faults
from estune.core.gains import Gains
from estune.daemon.config import config_from
from estune.daemon.faults import FaultCode
from estune.daemon.rig_access import (
    VOID_TRIALS_MAX,
    VoidTrialCounter,
    open_rig,
)
from estune.daemon.store import RUNS, DaemonStore
from estune.daemon.supervisor import RigSupervisor
from estune.daemon.tuning_runs import TuningRuns
from estune.errors import InvalidInput, JournalError, RigError
from estune.remote import zenoh
from estune.remote.zenoh.network import Network
from estune.run import disk_space, loop
from estune.run.journal import Journal
from estune.run.planning import plan_from_json
from estune.trial import Outcome, TrialRequest
from tests.serve_rig import served
from tests.support_daemon import (
    ORIGINAL,
    WITHIN_S,
    daemon,
    daemon_process,
    live_gains,
    log_lines,
    rig_served,
    rig_table,
)
from tests.support_rigs import COLUMNS, ScriptedRig, response

FOREIGN = Gains(0.123, 4.5, 0.006, 0.03)


def _faults(source, capsys) -> list[tuple[str, str]]:
    capsys.readouterr()
    faults(str(source), json=True)
    return [(row["rig"], row["fault"]) for row in json.loads(capsys.readouterr().out)]


def test_emergency_stop_pauses_until_resume(tmp_path, capsys):
    with rig_served(duration_s=0.02) as (rig, where):
        with daemon(tmp_path, rig_table("drum", where)) as it:
            it.until(lambda s: s.trials > 5)
            with zenoh.connect(where) as other:
                other.estop("smoke")
                status = it.until_mode("paused")
                assert "smoke" in status.paused
                for source in (it.service.endpoint, tmp_path / "estune-state"):
                    assert ("drum", "emergency-stop") in _faults(source, capsys)
                with pytest.raises(InvalidInput):
                    it.command("accept")
                counts = it.service._supervised["drum"].counts
                assert counts.commands_refused == 1
                assert counts.faults["emergency-stop"] == 1
                assert counts.trials["done"] > 5
                other.clear()
            requests_before = len(rig.requests)
            time.sleep(0.5)
            assert len(rig.requests) == requests_before
            it.command("resume")
            it.until_mode("holding")
        assert rig.describe().gains == ORIGINAL


def test_trial_cut_off_on_a_real_rig_pauses(tmp_path):
    def plant(request):
        cut = request.number == 5 and request.attempt == 0
        record = response(request)
        return replace(record, outcome=Outcome.INTERRUPTED, reason="power") if cut else record

    rig = ScriptedRig(plant, name="drum", simulated=False)
    with (
        zenoh.serve(rig, ledger=tmp_path / "ledger") as server,
        daemon(tmp_path, rig_table("drum", server.endpoint)) as it,
    ):
        paused = it.until_mode("paused").paused
        assert paused.endswith("was interrupted (power); check the rig, then resume")
        it.command("resume")
        it.until_mode("holding")


@pytest.mark.parametrize(("simulated", "tries"), [(True, VOID_TRIALS_MAX), (False, 1)])
def test_rig_whose_program_fails_pauses_until_resume(simulated, tries, tmp_path):
    attempts, repaired = [], []

    def plant(request):
        if request.number == 7 and not repaired:
            attempts.append(request.attempt)
            raise RuntimeError("no gauge")
        return response(request)

    rig = ScriptedRig(plant, name="drum", simulated=simulated)
    with (
        zenoh.serve(rig, ledger=tmp_path / "ledger") as server,
        daemon(tmp_path, rig_table("drum", server.endpoint)) as it,
    ):
        assert "no gauge" in it.until_mode("paused").paused
        assert attempts == list(range(tries))
        assert rig.describe().gains == ORIGINAL
        assert it.kinds().count("trouble") == 1
        repaired.append(True)
        it.command("resume")
        it.until_mode("holding")


def test_repeated_failures_are_retried_at_growing_intervals(tmp_path, monkeypatch):
    waits = []

    def no_run(*_):
        raise JournalError("no folder for it")

    def rest(_, seconds):
        waits.append(seconds)
        time.sleep(0.01)
        return False

    monkeypatch.setattr(TuningRuns, "open", no_run)
    monkeypatch.setattr(RigSupervisor, "_rest", rest)
    with rig_served() as (_, where), daemon(tmp_path, rig_table("drum", where)) as it:
        # The rig is found and prepared between two faults.
        it.until(lambda _: len(waits) > 3)
        longest = [0.1, 0.2, 0.3, 0.3]
        assert all(0.5 * b <= a <= b for a, b in zip(waits, longest, strict=False))


def test_settings_that_do_not_suit_the_rig_pause(tmp_path):
    table = rig_table("drum", "{}") + "step = {step_N = 1000.0}\n"
    with rig_served() as (rig, where):
        with daemon(tmp_path, table.replace("{}", where)) as it:
            assert "setpoint 1010 is outside" in it.until_mode("paused").paused
            assert not rig.requests
        # As the remedy says, the corrected file alone does not end the pause.
        with daemon(tmp_path, rig_table("drum", where)) as it:
            it.until_mode("paused")
            it.command("resume")
            it.until(lambda s: s.trials > 0)
    assert "resume if it is paused" in FaultCode.SETTINGS.sentence


FAULTS = {
    "nan": (lambda r: replace(r, tension_N=np.where(r.time_s > 0.2, np.nan, 1.0)), "is nan"),
    "short": (
        lambda r: replace(r, **{n: c[:-3] for n in COLUMNS if (c := getattr(r, n)) is not None}),
        "97 samp",
    ),
    "clock": (lambda r: replace(r, time_s=r.time_s + 60.0 * (r.time_s > 0.3)), "clock jumps"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faulty_record_is_refused_and_the_trial_repeated(fault, tmp_path):
    spoil, words = FAULTS[fault]

    def plant(request):
        record = response(request)
        return spoil(record) if request.number == 5 and request.attempt == 0 else record

    with rig_served(plant=plant) as (_, where), daemon(tmp_path, rig_table("drum", where)) as it:
        run = it.until_mode("holding").run
    with Journal.open(tmp_path / "estune-state" / "drum" / RUNS / run) as book:
        void = [entry for entry in book.entries() if entry.outcome.is_void]
    assert [(entry.number, entry.attempt) for entry in void] == [(5, 0)]
    assert words in void[0].reason


def test_leases_lost_in_an_overload_need_no_operator(tmp_path):
    with rig_served() as (_, where), zenoh.connect(where, holder="estune daemon a") as rig:
        config = config_from(tomllib.loads(rig_table("drum", where)), "test", tmp_path)
        access = open_rig(config.rig[0], "estune daemon a", VoidTrialCounter(), Network())
        remote = access._rig
        cancelled = replace(
            response(TrialRequest("run", 0, ORIGINAL, rig.describe().step)),
            outcome=Outcome.CANCELLED,
        )

        def lose(request):
            remote._lease.drop(remote._lease.token or remote._lease.hold())
            return replace(cancelled, trial_id=request.trial_id)

        remote.run = lose
        for number in range(VOID_TRIALS_MAX + 1):
            request = TrialRequest("run", number, ORIGINAL, rig.describe().step)
            assert access.run(request).outcome is Outcome.CANCELLED
            remote.release()
            time.sleep(0.01)
        access.close()


@pytest.mark.slow
def test_hanging_rig_does_not_delay_another(tmp_path):
    with served("unhurried", "hung") as hung, rig_served() as (_, where):
        long = rig_table("hung", hung.endpoint, trials=400)
        long = long.replace("repeats = 3", "repeats = 3, tolerance = 0.0")  # takes all its trials
        with daemon(tmp_path, long, rig_table("drum", where)) as it:
            it.until(lambda s: s.trials > 5, "hung")
            hung.freeze()
            try:
                it.until_mode("holding")
                it.command("accept")
                it.until(lambda s: s.checks > 20)
                it.until(lambda s: bool(s.trouble), "hung")
            finally:
                hung.process.send_signal(signal.SIGCONT)
            trials_before = it.client.status("hung").trials
            it.until(lambda s: s.mode == "tuning" and s.trials > trials_before, "hung")


def test_full_disk_prevents_accept_and_still_stops_safely(tmp_path):
    with rig_served() as (rig, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
        store = it.service._supervised["drum"].store
        with store._file._lock:
            pages = store._file._connection.execute("PRAGMA page_count").fetchone()[0]
            store._file._connection.execute(f"PRAGMA max_page_count={pages}")
        # Refused commands are stored, too, until the store is full.
        while True:
            try:
                it.command("resume")
            except InvalidInput as error:
                if "the disk is full" in str(error):
                    break
        with pytest.raises(InvalidInput, match="the disk is full"):
            it.client.command("drum", "accept", "x" * 128, "y" * 128)
        assert it.client.status("drum").mode == "holding"
        it.service.stop()
        it.thread.join(WITHIN_S)
        assert rig.describe().gains == ORIGINAL


def test_daemon_warns_once_in_a_run_that_its_disk_will_be_full(tmp_path, monkeypatch):
    monkeypatch.setattr(disk_space.shutil, "disk_usage", lambda _: SimpleNamespace(free=1000.0))
    trials = 3 * disk_space.INTERVAL
    with (
        rig_served() as (_, where),
        daemon(tmp_path, rig_table("drum", where, trials=trials)) as it,
    ):
        it.until(lambda s: s.trials > 2.5 * disk_space.INTERVAL or s.mode == "holding")
        assert it.kinds().count("disk") == 1


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["tuning", "confirming", "holding", "watching"])
def test_killed_daemon_continues_where_it_was(moment, tmp_path):
    with served("unhurried", "drum") as server:
        table = rig_table("drum", server.endpoint, trials=30)
        with daemon_process(tmp_path, table) as (process, it):
            at = {
                "tuning": lambda s: s.trials >= 12,
                "confirming": lambda s: s.trials >= 35,
                "holding": lambda s: s.mode == "holding",
                "watching": lambda s: s.checks >= 3,
            }[moment]
            if moment == "watching":
                it.until_mode("holding")
                it.command("accept")
            killed = it.until(at)
            process.kill()
            process.wait()
        # The rig ends a trial whose daemon died; a candidate is live only during trials.
        nominal = killed.gains["accepted"] if moment == "watching" else ORIGINAL
        assert live_gains(server.endpoint) == nominal
        with daemon_process(tmp_path, table) as (process, it):
            mode = "watching" if moment == "watching" else "holding"
            status = it.until_mode(mode)
            assert status.run == killed.run
            assert status.live == ("accepted" if moment == "watching" else "original")
            process.terminate()
            assert process.wait(WITHIN_S) == 0
        assert live_gains(server.endpoint) == nominal
    with Journal.open(tmp_path / "estune-state" / "drum" / RUNS / killed.run) as book:
        entries = [entry for entry in book.entries() if not entry.outcome.is_void]
        plan = plan_from_json(book.fact("plan"))
    alone = ScriptedRig(name="drum")
    whole = loop.start(plan, alone.describe(), None)
    loop.run(whole, alone)
    assert [(e.gains, e.cost) for e in entries] == [(e.gains, e.cost) for e in whole.entries]
    assert {"started", "stopped"} <= {line.get("event") for line in log_lines(tmp_path)}


@pytest.mark.slow
def test_signals_restore_gains_or_a_lost_rigs_at_next_start(
    tmp_path,
):
    with served("unhurried", "drum") as server:
        table = rig_table("drum", server.endpoint)
        with daemon_process(tmp_path, table) as (process, it):
            it.until_mode("holding")
            process.send_signal(signal.SIGINT)
            assert process.wait(WITHIN_S) == 0
        assert live_gains(server.endpoint) == ORIGINAL
        with daemon_process(tmp_path, table) as (process, it):
            it.until_mode("holding")
            server.freeze()
            process.terminate()
            assert process.wait(WITHIN_S) == RigError.exit_code
            server.process.send_signal(signal.SIGCONT)
        assert "could not be confirmed" in (tmp_path / "log").read_text()
        with daemon_process(tmp_path, table) as (process, it):
            it.until_mode("holding")
            it.command("stop")
            assert process.wait(WITHIN_S) == 0
        assert live_gains(server.endpoint) == ORIGINAL


def test_store_of_another_rig_is_refused_unchanged(tmp_path):
    DaemonStore.open(tmp_path, "drum").close()
    before = (tmp_path / "daemon.sqlite").read_bytes()
    with pytest.raises(JournalError, match="that of rig 'drum', not of 'reel'"):
        DaemonStore.open(tmp_path, "reel")
    assert (tmp_path / "daemon.sqlite").read_bytes() == before


def test_another_rig_of_the_same_name_keeps_its_gains(tmp_path):
    with rig_served() as (_, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
    with (
        rig_served(newtons_per_ampere=7.0, gains=FOREIGN) as (rig, where),
        daemon(tmp_path, rig_table("drum", where)) as it,
    ):
        assert "7 N/A" in it.until_mode("paused").paused
        assert rig.describe().gains == FOREIGN
