"""A daemon's life with rigs over Zenoh: what it does, what is live, what survives."""

import signal
import time
from dataclasses import replace

import numpy as np
import pytest

from estune.core.gains import Gains
from estune.daemon.rig_access import GIVE_UP_AFTER
from estune.daemon.store import RUNS, DaemonStore
from estune.daemon.supervisor import RigSupervisor
from estune.daemon.tuning_runs import TuningRuns
from estune.errors import InvalidInput, JournalError, RigError
from estune.remote import zenoh
from estune.run import loop
from estune.run.journal import Journal
from estune.run.plan import plan_from_json
from estune.trial import Outcome
from tests.serve_rig import served
from tests.support_daemon import (
    ORIGINAL,
    WITHIN_S,
    Plant,
    daemon,
    daemon_process,
    live_gains,
    log_lines,
    rig_served,
    rig_table,
)
from tests.support_rigs import COLUMNS, ScriptedRig, response

STRANGE = Gains(0.123, 4.5, 0.006, 0.03)


def test_a_whole_life_from_tuning_over_a_drift_to_the_next_tuning(tmp_path):
    plant = Plant()
    with rig_served(plant=plant) as (rig, where):
        with daemon(tmp_path, rig_table("drum", where)) as it:
            held = it.until_mode("holding")
            assert held.live == "original"
            assert rig.describe().gains == ORIGINAL != held.gains["candidate"]
            it.say("accept")
            watching = it.until(lambda s: s.mode == "watching" and s.checks >= 14)
            assert watching.live == "accepted"
            assert watching.gains == {"original": ORIGINAL, "accepted": held.gains["candidate"]}
            assert "drifted" not in it.kinds()
            plant.slower = 3.0
            again = it.until(lambda s: s.run.endswith("-002") and s.mode == "holding")
            assert "drifted" in it.kinds()
            assert again.gains["candidate"] != held.gains["candidate"]
        # Stopped while a second candidate waits: what was accepted before is live.
        assert rig.describe().gains == held.gains["candidate"]


def test_gains_better_beyond_doubt_are_accepted_unasked_where_the_file_says_so(tmp_path):
    with rig_served() as (rig, where):
        with daemon(tmp_path, rig_table("drum", where, accept="auto")) as it:
            status = it.until_mode("watching")
            assert status.live == "accepted"
            assert "95% interval" in status.why
        assert rig.describe().gains == status.gains["accepted"]


def test_gains_that_are_no_better_are_not_taken(tmp_path):
    # Every response is the same, but for the noise.
    def deaf(request):
        return replace(response(replace(request, gains=ORIGINAL)), gains=request.gains)

    with rig_served(plant=deaf) as (rig, where):
        with daemon(tmp_path, rig_table("drum", where, accept="auto")) as it:
            status = it.until_mode("watching")
            assert status.live == "original"
            assert status.gains == {"original": ORIGINAL}
            assert "kept" in it.kinds()
        assert rig.describe().gains == ORIGINAL


@pytest.mark.parametrize("verb", ["reject", "revert", "stop"])
def test_a_candidate_that_is_not_accepted_is_never_live(verb, tmp_path):
    given = []
    with rig_served() as (rig, where), daemon(tmp_path, rig_table("drum", where)) as it:
        apply = rig.apply
        rig.apply = lambda gains: (given.append(gains), apply(gains))[1]
        it.until_mode("holding")
        it.say(verb)
        if verb == "stop":
            it.thread.join(WITHIN_S)
        else:
            it.until_mode({"reject": "watching", "revert": "paused"}[verb])
        assert rig.describe().gains == ORIGINAL
        assert set(given) <= {ORIGINAL}


def test_revert_brings_the_original_gains_back_after_others_were_accepted(tmp_path):
    with rig_served() as (rig, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
        it.say("accept")
        it.until(lambda s: s.live == "accepted")
        it.say("revert")
        status = it.until(lambda s: s.mode == "paused" and s.live == "original")
        assert rig.describe().gains == ORIGINAL
        assert status.gains == {"original": ORIGINAL}
        it.say("resume")
        it.until(lambda s: s.run.endswith("-002"))
        said = [(row["verb"], row["done"]) for row in it.client.history("drum").commands]
        assert said == [("accept", 1), ("revert", 1), ("resume", 1)]


def test_a_stop_in_the_middle_of_a_trial_does_not_wait_for_it(tmp_path):
    with (
        rig_served(duration_s=1000.0) as (rig, where),
        daemon(tmp_path, rig_table("drum", where)) as it,
    ):
        it.until_mode("tuning")
        while not rig.asked:
            time.sleep(0.01)
        it.say("stop")
        it.thread.join(WITHIN_S)
        assert not it.thread.is_alive()
        assert rig.describe().gains == ORIGINAL
        assert not it.failed


def test_verbs_without_a_place_are_refused_and_commands_are_carried_out_once(tmp_path):
    with rig_served() as (_, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
        with pytest.raises(InvalidInput, match="not paused"):
            it.say("resume")
        it.say("pause")
        with pytest.raises(InvalidInput, match="paused already"):
            it.say("pause")
        with pytest.raises(RigError, match="there is: drum"):
            it.say("pause", rig="other")


def test_a_paused_rig_is_others_to_use_and_strange_gains_are_not_written_over(tmp_path):
    with rig_served() as (rig, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
        it.say("reject")
        it.until_mode("watching")
        it.say("pause")
        it.until_mode("paused")
        with zenoh.connect(where) as other:
            other.apply(STRANGE)
        # Found again after the link was cut: nobody has said to go on.
        it.service._keepers[0]._disconnect()
        status = it.until(lambda s: "not set through this daemon" in s.paused)
        assert "revert the original" in status.paused
        assert rig.describe().gains == STRANGE
        it.say("revert")
        it.until(lambda s: s.live == "original")
        assert rig.describe().gains == ORIGINAL


def test_the_home_gains_are_put_back_on_a_rig_that_was_restarted(tmp_path):
    table = rig_table("drum", "{}")
    with rig_served() as (_, where):
        pass  # a port that is free again
    with daemon(tmp_path, table.replace("{}", where)) as it:
        it.until(lambda s: "nothing that speaks Zenoh" in s.trouble)
        with zenoh.serve(ScriptedRig(Plant(), name="drum"), where):
            it.until_mode("holding")
            it.say("accept")
            kept = it.until(lambda s: s.live == "accepted")
        it.until_mode("waiting")
        again = ScriptedRig(Plant(), name="drum")
        with zenoh.serve(again, where):
            it.until_mode("watching")
            assert again.describe().gains == kept.gains["accepted"] != ORIGINAL


def test_a_single_bad_check_is_repeated_and_counts_for_nothing(tmp_path):
    bad = []

    def plant(request):
        record = response(request)
        if "check" in request.run and request.number == 13:
            bad.append(request.number)
            slow = replace(request, gains=replace(request.gains, P=request.gains.P / 4.0))
            record = replace(response(slow), gains=request.gains)
        return record

    with rig_served(plant=plant) as (_, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
        it.say("accept")
        it.until(lambda s: s.checks >= 18)
        assert bad == [13]
        kinds = it.kinds()
        assert kinds.count("suspect") == kinds.count("outlier") == 1
        assert "drifted" not in kinds


def test_gains_that_have_become_unsafe_give_way_to_the_original_ones(tmp_path):
    plant = Plant()
    with rig_served(plant=plant) as (rig, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
        it.say("accept")
        it.until(lambda s: s.checks >= 14)
        plant.slower = 100.0
        status = it.until(lambda s: s.mode == "paused" and s.live == "original")
        assert "unsafe" in status.paused
        assert rig.describe().gains == ORIGINAL


def test_after_an_emergency_stop_nothing_moves_until_somebody_resumes(tmp_path):
    with rig_served(duration_s=0.02) as (rig, where):
        with daemon(tmp_path, rig_table("drum", where)) as it:
            it.until(lambda s: s.trials > 5)
            with zenoh.connect(where) as other:
                other.estop("smoke")
                status = it.until_mode("paused")
                assert "smoke" in status.paused
                other.clear()
            asked = len(rig.asked)
            time.sleep(0.5)
            assert len(rig.asked) == asked
            it.say("resume")
            it.until_mode("holding")
        assert rig.describe().gains == ORIGINAL


def test_a_trial_cut_off_on_a_rig_that_moves_waits_for_somebody(tmp_path):
    def plant(request):
        cut = request.number == 5 and request.attempt == 0
        record = response(request)
        return replace(record, outcome=Outcome.INTERRUPTED, reason="power") if cut else record

    rig = ScriptedRig(plant, name="drum", simulated=False)
    with (
        zenoh.serve(rig, ledger=tmp_path / "ledger") as server,
        daemon(tmp_path, rig_table("drum", server.endpoint)) as it,
    ):
        assert "cut off (power)" in it.until_mode("paused").paused
        it.say("resume")
        it.until_mode("holding")


@pytest.mark.parametrize(("simulated", "tries"), [(True, GIVE_UP_AFTER), (False, 1)])
def test_a_rig_whose_own_program_fails_is_given_up_until_it_is_mended(simulated, tries, tmp_path):
    asked, mended = [], []

    def plant(request):
        if request.number == 7 and not mended:
            asked.append(request.attempt)
            raise RuntimeError("no gauge")
        return response(request)

    rig = ScriptedRig(plant, name="drum", simulated=simulated)
    with (
        zenoh.serve(rig, ledger=tmp_path / "ledger") as server,
        daemon(tmp_path, rig_table("drum", server.endpoint)) as it,
    ):
        assert "no gauge" in it.until_mode("paused").paused
        assert asked == list(range(tries))
        assert rig.describe().gains == ORIGINAL
        assert it.kinds().count("trouble") == 1
        mended.append(True)
        it.say("resume")
        it.until_mode("holding")


def test_what_fails_again_and_again_is_tried_ever_more_seldom(tmp_path, monkeypatch):
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
        # The rig is found and readied each time in between.
        it.until(lambda _: len(waits) > 3)
        assert waits[:4] == pytest.approx([0.1, 0.2, 0.3, 0.3])


def test_settings_that_do_not_suit_the_rig_are_not_tried_again_unasked(tmp_path):
    table = rig_table("drum", "{}") + "step = {step_N = 1000.0}\n"
    with rig_served() as (rig, where), daemon(tmp_path, table.replace("{}", where)) as it:
        assert "setpoint 1010 N is outside" in it.until_mode("paused").paused
        assert not rig.asked


FAULTS = {
    "nan": (lambda r: replace(r, tension_N=np.where(r.time_s > 0.2, np.nan, 1.0)), "is nan"),
    "short": (
        lambda r: replace(r, **{name: getattr(r, name)[:-3] for name in COLUMNS}),
        "97 samp",
    ),
    "clock": (lambda r: replace(r, time_s=r.time_s + 60.0 * (r.time_s > 0.3)), "clock jumps"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_record_that_cannot_be_is_refused_and_the_trial_asked_for_again(fault, tmp_path):
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


def test_a_second_daemon_is_refused_and_told_who_has_the_rig(tmp_path):
    with rig_served() as (_, where), daemon(tmp_path / "a", rig_table("drum", where)) as it:
        it.until_mode("holding")
        with (
            pytest.raises(JournalError, match="written by another process"),
            daemon(tmp_path / "a", rig_table("drum", where)),
        ):
            pass
        with daemon(tmp_path / "b", rig_table("drum", where)) as other:
            other.thread.join(WITHIN_S)
            assert len(other.failed) == 1
            assert "held by estune daemon" in str(other.failed[0])
        assert it.client.status("drum").mode == "holding"


def test_a_rig_that_hangs_does_not_keep_another_waiting(tmp_path):
    with served("unhurried", "hung") as hung, rig_served() as (_, where):
        tables = rig_table("hung", hung.endpoint, trials=400), rig_table("drum", where)
        with daemon(tmp_path, *tables) as it:
            it.until(lambda s: s.trials > 5, "hung")
            hung.process.send_signal(signal.SIGSTOP)
            try:
                it.until_mode("holding")
                it.say("accept")
                it.until(lambda s: s.checks > 20)
                it.until(lambda s: bool(s.trouble), "hung")
            finally:
                hung.process.send_signal(signal.SIGCONT)
            seen = it.client.status("hung").trials
            it.until(lambda s: s.mode == "tuning" and s.trials > seen, "hung")


def test_a_disk_that_is_full_does_not_make_a_candidate_live(tmp_path):
    with rig_served() as (rig, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
        store = it.service._supervised["drum"].store
        with store._lock:
            pages = store._connection.execute("PRAGMA page_count").fetchone()[0]
            store._connection.execute(f"PRAGMA max_page_count={pages}")
        # Commands that are refused are kept, too, until there is no room for another.
        while True:
            try:
                it.say("resume")
            except InvalidInput as error:
                if "the disk is full" in str(error):
                    break
        with pytest.raises(InvalidInput, match="the disk is full"):
            it.client.command("drum", "accept", "x" * 128, "y" * 128)
        assert it.client.status("drum").mode == "holding"
        it.service.stop()
        it.thread.join(WITHIN_S)
        assert rig.describe().gains == ORIGINAL


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["tuning", "confirming", "holding", "watching"])
def test_a_daemon_that_is_killed_goes_on_where_it_was(moment, tmp_path):
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
                it.say("accept")
            killed = it.until(at)
            process.kill()
            process.wait()
        # A trial is a guest, also of who was killed; a candidate is live in trials only.
        home = killed.gains["accepted"] if moment == "watching" else ORIGINAL
        assert live_gains(server.endpoint) == home
        with daemon_process(tmp_path, table) as (process, it):
            mode = "watching" if moment == "watching" else "holding"
            status = it.until_mode(mode)
            assert status.run == killed.run
            assert status.live == ("accepted" if moment == "watching" else "original")
            process.terminate()
            assert process.wait(WITHIN_S) == 0
        assert live_gains(server.endpoint) == home
    with Journal.open(tmp_path / "estune-state" / "drum" / RUNS / killed.run) as book:
        entries = [entry for entry in book.entries() if not entry.outcome.is_void]
        plan = plan_from_json(book.fact("plan"))
    alone = ScriptedRig(name="drum")
    whole = loop.start(plan, alone.describe(), None)
    loop.run(whole, alone)
    assert [(e.gains, e.cost) for e in entries] == [(e.gains, e.cost) for e in whole.entries]
    assert {"started", "stopped"} <= {line.get("event") for line in log_lines(tmp_path)}


@pytest.mark.slow
def test_signals_put_the_gains_back_and_a_lost_rig_gets_them_at_the_next_start(
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
            server.process.send_signal(signal.SIGSTOP)
            process.terminate()
            assert process.wait(WITHIN_S) == RigError.exit_code
            server.process.send_signal(signal.SIGCONT)
        assert "could not be confirmed" in (tmp_path / "log").read_text()
        with daemon_process(tmp_path, table) as (process, it):
            it.until_mode("holding")
            it.say("stop")
            assert process.wait(WITHIN_S) == 0
        assert live_gains(server.endpoint) == ORIGINAL


def test_a_store_of_another_rig_is_left_alone(tmp_path):
    DaemonStore.open(tmp_path, "drum").close()
    before = (tmp_path / "daemon.sqlite").read_bytes()
    with pytest.raises(JournalError, match="that of rig 'drum', not of 'reel'"):
        DaemonStore.open(tmp_path, "reel")
    assert (tmp_path / "daemon.sqlite").read_bytes() == before


def test_another_rig_under_the_same_name_is_left_alone(tmp_path):
    with rig_served() as (_, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
    with (
        rig_served(newtons_per_ampere=7.0, gains=STRANGE) as (rig, where),
        daemon(tmp_path, rig_table("drum", where)) as it,
    ):
        assert "7 N/A" in it.until_mode("paused").paused
        assert rig.describe().gains == STRANGE
