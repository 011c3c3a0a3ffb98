"""A rig that moves and comes back without its ledger: the trial under way is not run again."""

import threading
from contextlib import closing
from dataclasses import replace

import pytest

import estune
from estune.daemon.store import DaemonStore
from estune.errors import Interrupted, RigError
from estune.remote import zenoh
from estune.run.failed_trials import run_trial
from estune.run.journal import Journal
from estune.trial import Outcome, TrialRequest
from tests.serve_rig import served
from tests.support_daemon import daemon, rig_table
from tests.support_improve import GAINS, REEL, runner
from tests.support_rigs import ScriptedRig
from tests.test_bus import states, until


class Kept(ScriptedRig):
    """A rig with a ledger, that may be gone in a trial."""

    ledger, gone = "first", False

    def run(self, request):
        if self.gone:
            raise RigError("it is gone; the trial may have run")
        return super().run(request)


NOTES = {
    "journal": lambda folder: Journal.create(folder, {}),
    "store": lambda folder: DaemonStore.open(folder, "drum"),
}


@pytest.mark.parametrize("notes", NOTES)
@pytest.mark.parametrize("ended", [False, True])
def test_no_trial_runs_until_the_operator_was_called(notes, ended, tmp_path):
    with closing(NOTES[notes](tmp_path)) as opened:
        check_lost(opened, ended=ended)


def check_lost(notes, *, ended):
    """A trial is under way, or its record not yet stored, when the rig gets another ledger."""
    rig = Kept(simulated=False)
    about = rig.describe()
    first = TrialRequest("run", 0, about.gains, about.step)
    second = replace(first, number=1)
    run_trial(rig, first, about, notes=notes)
    rig.gone = not ended
    if ended:  # and its record was not stored: it is asked for again
        run_trial(rig, second, about, notes=notes)
    else:
        with pytest.raises(RigError, match="gone"):
            run_trial(rig, second, about, notes=notes)
    rig.gone, rig.ledger, before = False, "second", len(rig.requests)
    # The first of a pair is asked for again, too; and either, until its record is stored.
    again = [second] if ended else [first, first]
    for request in again:
        record = run_trial(rig, request, about, notes=notes)
        assert record.outcome is Outcome.INTERRUPTED
        assert "second instead of first" in record.reason
    assert len(rig.requests) == before
    attempt = replace(again[-1], attempt=1)
    assert run_trial(rig, attempt, about, notes=notes).outcome is Outcome.DONE


def test_simulated_trial_is_run_again(tmp_path):
    rig = Kept(simulated=True)
    about = rig.describe()
    request = TrialRequest("run", 0, about.gains, about.step)
    with Journal.create(tmp_path, {}) as journal:
        for rig.ledger in ("first", "second"):
            assert run_trial(rig, request, about, notes=journal).outcome is Outcome.DONE


def test_improvement_does_not_repeat_the_trial_under_way(tmp_path):
    rig = REEL.rig()
    run, rig.ledger = rig.run, "first"
    rig.run = lambda _: (_ for _ in ()).throw(RigError("gone"))
    with pytest.raises(RigError, match="gone"):
        runner(rig, tmp_path).trial("step", GAINS, REEL.profile)
    rig.run, rig.ledger = run, "second"
    with pytest.raises(Interrupted, match="second instead of first"):
        runner(rig, tmp_path).trial("step", GAINS, REEL.profile)
    assert runner(rig, tmp_path).trial("step", GAINS, REEL.profile).trial_id.endswith(".1")


def identity(endpoint: str) -> str:
    """Identity of the ledger of the rig at an endpoint."""
    with zenoh.connect(endpoint) as rig:
        return rig.ledger


@pytest.mark.slow
def test_resumed_run_calls_the_operator_once(tmp_path):
    ledger, failed = tmp_path / "ledger", []

    def tune() -> None:
        with pytest.raises(RigError, match="may have run") as error:
            estune.tune(at, run="run", folder=tmp_path, trials=6, patience_s=1.0, watch=None)
        failed.append(error)

    with served("moving scripted", ledger=ledger) as server:
        at, before = server.endpoint, identity(server.endpoint)
        tuning = threading.Thread(target=tune)
        tuning.start()
        until(lambda: ledger.exists() and states(ledger) == ["running"])
        server.process.kill()
        tuning.join()
    assert failed
    ledger.unlink()
    rig = ScriptedRig(name="reel", simulated=False)
    with zenoh.serve(rig, at, ledger=ledger):
        now = identity(at)
        with pytest.raises(Interrupted, match=f"{now} instead of {before}.*check.*resume"):
            estune.resume(tmp_path / "run", watch=None)
        assert not rig.requests
        result = estune.resume(tmp_path / "run", watch=None)
    assert result.entries[0].outcome is Outcome.INTERRUPTED
    assert [entry.attempt for entry in result.entries if entry.number == 0] == [0, 1]
    assert "run-00000" not in {request.trial_id for request in rig.requests}


@pytest.mark.slow
def test_daemon_that_connects_anew_pauses(tmp_path):
    ledger = tmp_path / "ledger"
    with served("moving scripted", "drum", ledger=ledger) as server:
        at, before = server.endpoint, identity(server.endpoint)
        with daemon(tmp_path, rig_table("drum", at)) as it:
            until(lambda: states(ledger) == ["running"])
            server.process.kill()
            it.until_mode("waiting")
            ledger.unlink()
            rig = ScriptedRig(name="drum", simulated=False)
            with zenoh.serve(rig, at, ledger=ledger):
                paused = it.until_mode("paused").paused
                assert before in paused
                assert identity(at) in paused
                assert not rig.requests
                it.command("resume")
                it.until_mode("holding")
