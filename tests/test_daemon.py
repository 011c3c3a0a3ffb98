"""Daemons with rigs over Zenoh: modes, live gains, commands."""

import threading
import time
from dataclasses import replace

import pytest

import plants
from estune.core.gains import Gains
from estune.errors import InvalidInput, RigError
from estune.remote import zenoh
from estune.trial.profiles import MultisineProfile
from tests.support_daemon import (
    ORIGINAL,
    WITHIN_S,
    Plant,
    daemon,
    rig_served,
    rig_table,
)
from tests.support_rigs import ScriptedRig, response

FOREIGN = Gains(0.123, 4.5, 0.006, 0.03)


def test_daemon_tunes_watches_and_tunes_again_after_a_drift(tmp_path):
    plant = Plant()
    with rig_served(plant=plant) as (rig, where):
        with daemon(tmp_path, rig_table("drum", where)) as it:
            status = it.until_mode("holding")
            assert status.live == "original"
            assert rig.describe().gains == ORIGINAL != status.gains["candidate"]
            it.command("accept")
            watching = it.until(lambda s: s.mode == "watching" and s.checks >= 14)
            assert watching.live == "accepted"
            assert watching.gains == {"original": ORIGINAL, "accepted": status.gains["candidate"]}
            assert "drifted" not in it.kinds()
            plant.slower = 3.0
            again = it.until(lambda s: s.run.endswith("-002") and s.mode == "holding")
            assert "drifted" in it.kinds()
            assert again.gains["candidate"] != status.gains["candidate"]
        # Stopped while a second candidate waits: the gains accepted before are live.
        assert rig.describe().gains == status.gains["candidate"]


def test_significant_improvement_is_accepted_automatically_if_configured(tmp_path):
    with rig_served() as (rig, where):
        with daemon(tmp_path, rig_table("drum", where, accept="auto")) as it:
            status = it.until_mode("watching")
            assert status.live == "accepted"
            assert "95% interval" in status.why
        assert rig.describe().gains == status.gains["accepted"]


def test_gains_without_improvement_are_not_accepted(tmp_path):
    # All responses are equal except for the noise.
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
def test_candidate_is_not_live_unless_accepted(verb, tmp_path):
    offered = []
    with rig_served() as (rig, where), daemon(tmp_path, rig_table("drum", where)) as it:
        apply = rig.apply
        rig.apply = lambda gains: (offered.append(gains), apply(gains))[1]
        it.until_mode("holding")
        it.command(verb)
        if verb == "stop":
            it.thread.join(WITHIN_S)
        else:
            it.until_mode({"reject": "watching", "revert": "paused"}[verb])
        assert rig.describe().gains == ORIGINAL
        assert set(offered) <= {ORIGINAL}


def test_revert_brings_the_original_gains_back_after_others_were_accepted(tmp_path):
    with rig_served() as (rig, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
        it.command("accept")
        it.until(lambda s: s.live == "accepted")
        it.command("revert")
        status = it.until(lambda s: s.mode == "paused" and s.live == "original")
        assert rig.describe().gains == ORIGINAL
        assert status.gains == {"original": ORIGINAL}
        it.command("resume")
        it.until(lambda s: s.run.endswith("-002"))
        commands = [(row["verb"], row["done"]) for row in it.client.history("drum").commands]
        assert commands == [("accept", 1), ("revert", 1), ("resume", 1)]


def test_stop_in_a_trial_does_not_wait_for_its_end(tmp_path):
    with (
        rig_served(duration_s=1000.0) as (rig, where),
        daemon(tmp_path, rig_table("drum", where)) as it,
    ):
        it.until_mode("tuning")
        while not rig.requests:
            time.sleep(0.01)
        it.command("stop")
        it.thread.join(WITHIN_S)
        assert not it.thread.is_alive()
        assert rig.describe().gains == ORIGINAL
        assert not it.failed


def test_commands_not_allowed_in_a_mode_are_refused(tmp_path):
    with rig_served() as (_, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
        with pytest.raises(InvalidInput, match="not paused"):
            it.command("resume")
        it.command("pause")
        with pytest.raises(InvalidInput, match="paused already"):
            it.command("pause")
        with pytest.raises(RigError, match="there is: drum"):
            it.command("pause", rig="other")


def test_paused_rig_accepts_other_clients_and_keeps_their_gains(tmp_path):
    with rig_served() as (rig, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
        it.command("reject")
        it.until_mode("watching")
        it.command("pause")
        it.until_mode("paused")
        with zenoh.connect(where) as other:
            other.apply(FOREIGN)
        it.until(lambda s: s.live == "")
        assert (
            "set by others; resume applies the original" in it.client.events("drum")[-1].sentence
        )
        # After a reconnection the daemon waits for the operator's command to resume.
        it.service._supervisors[0]._disconnect()
        status = it.until(lambda s: "not set through this daemon" in s.paused)
        assert "revert the original" in status.paused
        assert rig.describe().gains == FOREIGN
        it.command("revert")
        it.until(lambda s: s.live == "original")
        assert rig.describe().gains == ORIGINAL


def test_nominal_gains_are_restored_on_a_restarted_rig(tmp_path):
    table = rig_table("drum", "{}")
    with rig_served() as (_, where):
        pass  # a port that is free again
    with daemon(tmp_path, table.replace("{}", where)) as it:
        it.until(lambda s: "nothing that speaks Zenoh" in s.trouble)
        with zenoh.serve(ScriptedRig(Plant(), name="drum"), where):
            it.until_mode("holding")
            it.command("accept")
            accepted_status = it.until(lambda s: s.live == "accepted")
        it.until_mode("waiting")
        again = ScriptedRig(Plant(), name="drum")
        with zenoh.serve(again, where):
            it.until_mode("watching")
            assert again.describe().gains == accepted_status.gains["accepted"] != ORIGINAL
            it.service.stop()  # while its rig is there: it waits for one that is gone
            it.thread.join(WITHIN_S)


def test_search_continued_at_its_exciting_trial_is_not_called_a_confirmation(tmp_path):
    rig = plants.reference_reel(cable_length_m=0.8).rig(name="drum")
    run, requests = rig.run, []
    begun, paused = threading.Event(), threading.Event()

    def held(request):
        requests.append(request)
        begun.set()
        assert paused.wait(WITHIN_S)
        return run(request)

    rig.run = held
    with (
        zenoh.serve(rig) as server,
        daemon(tmp_path, rig_table("drum", server.endpoint, trials=30)) as it,
    ):
        assert begun.wait(WITHIN_S)
        it.command("pause")  # after the initial gains' trial, which is under way
        paused.set()
        it.until(lambda s: s.mode == "paused")
        it.command("resume")
        it.until_mode("holding")
        events = [e.sentence for e in it.client.events("drum") if e.kind == "confirming"]
    assert isinstance(requests[1].profile, MultisineProfile)
    assert len(events) == 1
    assert "the search ended" in events[0]


def test_single_outlying_check_is_repeated_and_starts_no_tuning(tmp_path):
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
        it.command("accept")
        it.until(lambda s: s.checks >= 18)
        assert bad == [13]
        kinds = it.kinds()
        assert kinds.count("suspect") == kinds.count("outlier") == 1
        assert "drifted" not in kinds


def test_accepted_gains_that_become_unsafe_are_reverted(tmp_path):
    plant = Plant()
    with rig_served(plant=plant) as (rig, where), daemon(tmp_path, rig_table("drum", where)) as it:
        it.until_mode("holding")
        it.command("accept")
        it.until(lambda s: s.checks >= 14)
        plant.slower = 100.0
        status = it.until(lambda s: s.mode == "paused" and s.live == "original")
        assert "unsafe" in status.paused
        assert rig.describe().gains == ORIGINAL
