"""The loop of a run: void trials, interruptions, approval by the operator."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import estune
from estune.errors import Interrupted, InvalidInput, RigError
from estune.run import loop
from estune.run.failed_trials import run_trial
from estune.run.loop import Stopped
from estune.trial import GUARD, LATE, Outcome, TrialRequest, empty_record
from estune.tuners.search_space import SearchSpace
from tests.serve_rig import served
from tests.support_runs import START, ArithmeticRig, Seer, description
from tests.test_journal import begin, resume, trace


class FailingRig(ArithmeticRig):
    """Rig with void trials."""

    def __init__(self, outcomes: dict[int, Outcome], **changes) -> None:
        super().__init__(**changes)
        self.outcomes = outcomes
        self.turn = -1

    def run(self, request):
        self.turn += 1
        outcome = self.outcomes.get(self.turn)
        if outcome is None:
            return super().run(request)
        at = "2009-05-04T12:00:00+00:00"
        return empty_record(request, self.description, outcome, "the rig was restarted", at)


def test_interrupted_trial_on_moving_rig_ends_run_until_resumed(tmp_path):
    rig = FailingRig({5: Outcome.INTERRUPTED})
    run = begin(tmp_path / "run", "otis", rig)
    with pytest.raises(Interrupted, match=rf"check the rig, then .* resume {tmp_path / 'run'}"):
        loop.run(run, rig)
    assert rig.turn == 5
    run.journal.close()
    resumed = resume(tmp_path / "run", rig)
    whole = begin(tmp_path / "whole", "otis", ArithmeticRig())
    loop.run(whole, ArithmeticRig())
    whole.journal.close()
    assert trace(e for e in resumed.entries if not e.outcome.is_void) == trace(whole.entries)
    assert [e.outcome for e in resumed.entries if e.outcome.is_void] == [Outcome.INTERRUPTED]


@pytest.mark.parametrize("asked", ["may have run: another has the name", "the drive failed"])
def test_interruption_says_trial_reason_and_remedy_once(asked, tmp_path, caplog):
    class LosingRig(ArithmeticRig):
        def run(self, request):
            if "may" in asked:
                raise Interrupted(f"trial {request.trial_id} {asked}")
            raise RigError(asked)

        def has_failed(self, _request):
            return True

    run = begin(tmp_path / "run", "otis", LosingRig())
    with pytest.raises(Interrupted) as raised:
        loop.run(run, LosingRig())
    run.journal.close()
    said = str(raised.value) + caplog.text
    assert [said.count(part) for part in ("trial run-", asked, "check the rig")] == [1, 1, 1]


def test_trial_that_a_late_sample_ended_is_repeated_on_a_moving_rig(tmp_path):
    class LateRig(ArithmeticRig):
        def run(self, request):
            record = super().run(request)
            if request.number != 5 or request.attempt:
                return record
            flags = record.flags.copy()
            flags[-1] |= LATE | GUARD
            return replace(record, outcome=Outcome.INTERRUPTED, flags=flags)

    rig = LateRig()
    assert not rig.describe().simulated
    run = begin(tmp_path / "run", "otis", rig)
    loop.run(run, rig)
    assert [e.attempt for e in run.entries if e.number == 5] == [0, 1]
    run.journal.close()


def test_trial_that_failed_on_the_rig_is_repeated_under_a_new_id_when_resumed(tmp_path):
    class ForgetfulRig(ArithmeticRig):
        def run(self, request):
            if request.number == 5 and not request.attempt:
                raise RigError("it stopped before the trial began")
            return super().run(request)

        def has_failed(self, request):
            return request.number == 5 and not request.attempt

    rig = ForgetfulRig()
    run = begin(tmp_path / "run", "otis", rig)
    with pytest.raises(Interrupted, match="before the trial began"):
        loop.run(run, rig)
    run.journal.close()
    resumed = resume(tmp_path / "run", rig)
    assert [e.attempt for e in resumed.entries if e.number == 5] == [0, 1]


@pytest.mark.parametrize("outcome", [Outcome.INTERRUPTED, Outcome.CANCELLED])
def test_void_trial_on_simulated_rig_is_repeated(outcome, tmp_path):
    rig = FailingRig({5: outcome, 6: outcome, 9: outcome}, simulated=True)
    run = begin(tmp_path / "run", "otis", rig)
    loop.run(run, rig)
    run.journal.close()
    whole = begin(tmp_path / "whole", "otis", ArithmeticRig(simulated=True))
    loop.run(whole, ArithmeticRig(simulated=True))
    whole.journal.close()
    assert trace(e for e in run.entries if not e.outcome.is_void) == trace(whole.entries)


def test_stopped_run_says_how_to_go_on_where_it_has_a_folder():
    assert Stopped(description(), None).again == ""
    assert Stopped(description(), Path("my runs")).again == "estune resume 'my runs'"


def test_run_ends_after_consecutive_void_trials(tmp_path):
    rig = FailingRig(dict.fromkeys(range(100), Outcome.CANCELLED))
    run = begin(tmp_path / "run", "otis", rig)
    with pytest.raises(RigError, match="10 consecutive void trials"):
        loop.run(run, rig)
    assert rig.turn == loop.CONSECUTIVE_VOID_MAX - 1
    run.journal.close()


@pytest.mark.slow
def test_run_continues_when_its_rig_is_killed_and_restarted(tmp_path):
    kills, servers = {1, 4}, []

    def start(endpoint: str = "tcp/127.0.0.1:0") -> str:
        server = served("simulated", "reel", endpoint, ledger=tmp_path / "ledger")
        servers.append(server)
        return server.__enter__().endpoint

    def watch(progress) -> None:
        if progress.entry.number in kills:
            servers[-1].__exit__(None, None, None)
            start(endpoint)

    options = {"trials": 15, "folder": tmp_path, "journal": True}
    endpoint = start()
    cut = estune.tune(endpoint, run="cut", watch=watch, **options)
    whole = estune.tune(endpoint, run="whole", watch=None, **options)
    servers[-1].__exit__(None, None, None)
    assert len(servers) == 1 + len(kills)
    same = [e._replace(trial_id=e.trial_id.replace("cut", "whole")) for e in cut.entries]
    assert same == list(whole.entries)


def answers(number: int) -> str:
    return "no" if number % 3 else "yes"


def run_with_approval(folder, rig, ask):
    """Run in which all gains with P above the initial value need approval."""
    tuner = Seer(SearchSpace.around(START))
    options = {"tolerance": 0.0, "run": "run", "watch": None}
    tuned = estune.tune(rig, tuner=tuner, trials=15, folder=folder, ask=ask, **options)
    return tuned, [request.number for request in rig.requests]


def test_gains_outside_safe_region_run_only_when_approved(tmp_path):
    questions = []

    def ask(question):
        assert not question.prediction.explored
        questions.append(question.request.number)
        return answers(question.request.number)

    result, numbers = run_with_approval(tmp_path, ArithmeticRig(), ask)
    assert {answers(number) for number in questions} == {"yes", "no"}
    refused = {number for number in questions if answers(number) == "no"}
    assert not refused & set(numbers)
    assert {e.number for e in result.entries if e.outcome is Outcome.DECLINED} == refused
    assert result.verdict.declined == len(refused)
    assert result.unsafe == 0
    assert "declined" in repr(result)


def test_trial_that_may_be_refused_is_declined_where_the_rig_refuses_it_and_raises_otherwise():
    about = description()
    request = TrialRequest("r", 0, START, about.step)

    class Refusing:
        def run(self, _):
            raise self.error

    rig = Refusing()
    rig.error = InvalidInput("steps only")
    record = run_trial(rig, request, about, may_be_refused=True)
    assert (record.outcome, record.reason) == (Outcome.DECLINED, "the rig refused it: steps only")
    for error, may_be_refused in ((rig.error, False), (RigError("no reply"), True)):
        rig.error = error
        with pytest.raises(type(error)):
            run_trial(rig, request, about, may_be_refused=may_be_refused)


def test_resumed_run_keeps_declined_trials(tmp_path):
    class Gone(ArithmeticRig):
        def run(self, request):
            if request.number >= 10:
                raise KeyboardInterrupt
            return super().run(request)

    def ask(question):
        return answers(question.request.number)

    whole, _ = run_with_approval(tmp_path / "whole", ArithmeticRig(), ask)
    with pytest.raises(loop.Stopped):
        run_with_approval(tmp_path, Gone(), ask)
    with pytest.raises(InvalidInput, match="approval callback"):
        estune.resume(tmp_path / "run", ArithmeticRig(), watch=None)
    again = estune.resume(tmp_path / "run", ArithmeticRig(), watch=None, ask=ask)
    assert str(trace(again.entries)) == str(trace(whole.entries))  # nan does not equal itself
    assert again.verdict.declined > 1


def test_approval_always_prompts_once(tmp_path):
    questions = []

    def ask(question):
        questions.append(question)
        return "always"

    result, numbers = run_with_approval(tmp_path, ArithmeticRig(), ask)
    assert len(questions) == 1
    assert len(numbers) == len(result.entries)


def test_record_with_other_gains_than_requested_ends_the_run(tmp_path):
    class Stubborn(ArithmeticRig):
        def run(self, request):
            return super().run(replace(request, gains=START))

    rig = Stubborn()
    run = begin(tmp_path / "run", "otis", rig)
    with pytest.raises(RigError, match=r"it was run with .*; check the rig's limits"):
        loop.run(run, rig)
    committed = len(run.entries)
    run.journal.close()
    assert committed == run.plan.repeats  # the baseline, at the gains the rig insists on


def test_search_is_refused_where_the_first_trial_is_mostly_noise_by_its_own_cost():
    class Noisier(ArithmeticRig):
        """Its second trial costs sixteen times as much as its first."""

        def run(self, request):
            record = super().run(request)
            noise_N = np.random.default_rng(9).normal(0.0, 2.0, record.time_s.size)
            noise_N *= 4.0 if request.number else 1.0
            current_A = record.current_A + noise_N / self.description.newtons_per_ampere
            return replace(record, tension_N=record.tension_N + noise_N, current_A=current_A)

    with pytest.raises(InvalidInput, match="noise makes up"):
        estune.tune(
            Noisier(),
            tuner="least_squares_gradient",
            repeats=2,
            eta_max=1e9,
            journal=False,
            watch=None,
        )
