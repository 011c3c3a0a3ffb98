"""Tuning over the link: it goes on where it can, and asks somebody where it must."""

from dataclasses import replace

import pytest

import estune
from estune.errors import Interrupted, InvalidInput, RigError
from estune.run import loop
from estune.trial import Outcome, empty_record
from estune.tuners.search_space import SearchSpace
from tests.serve_rig import served
from tests.support_runs import START, ArithmeticRig, Seer
from tests.test_journal import begin, go_on, trace


class FailingRig(ArithmeticRig):
    """Some of its trials come to nothing."""

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


def test_a_trial_cut_off_on_a_rig_that_moves_ends_the_run_until_somebody_resumes_it(tmp_path):
    rig = FailingRig({5: Outcome.INTERRUPTED})
    run = begin(tmp_path / "run", "otis", rig)
    with pytest.raises(Interrupted, match=rf"see to the rig, then .* resume {tmp_path / 'run'}"):
        loop.run(run, rig)
    assert rig.turn == 5
    run.journal.close()
    resumed = go_on(tmp_path / "run", rig)
    whole = begin(tmp_path / "whole", "otis", ArithmeticRig())
    loop.run(whole, ArithmeticRig())
    whole.journal.close()
    assert trace(e for e in resumed.entries if not e.outcome.is_void) == trace(whole.entries)
    assert [e.outcome for e in resumed.entries if e.outcome.is_void] == [Outcome.INTERRUPTED]


@pytest.mark.parametrize("outcome", [Outcome.INTERRUPTED, Outcome.CANCELLED])
def test_a_trial_cut_off_on_a_simulated_rig_is_asked_for_again(outcome, tmp_path):
    rig = FailingRig({5: outcome, 6: outcome, 9: outcome}, simulated=True)
    run = begin(tmp_path / "run", "otis", rig)
    loop.run(run, rig)
    run.journal.close()
    whole = begin(tmp_path / "whole", "otis", ArithmeticRig(simulated=True))
    loop.run(whole, ArithmeticRig(simulated=True))
    whole.journal.close()
    assert trace(e for e in run.entries if not e.outcome.is_void) == trace(whole.entries)


def test_a_run_whose_trials_all_come_to_nothing_ends(tmp_path):
    rig = FailingRig(dict.fromkeys(range(100), Outcome.CANCELLED))
    run = begin(tmp_path / "run", "otis", rig)
    with pytest.raises(RigError, match="came to nothing, as did 9 before it"):
        loop.run(run, rig)
    assert rig.turn == loop.VOID_IN_A_ROW - 1
    run.journal.close()


def test_a_run_goes_on_when_its_rig_is_killed_and_started_again(tmp_path):
    kills, servers = {3, 11}, []

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
    same = [replace(e, trial_id=e.trial_id.replace("cut", "whole")) for e in cut.entries]
    assert same == list(whole.entries)


def answers(number: int) -> str:
    return "no" if number % 3 else "yes"


def asked_run(folder, rig, ask):
    """A run in which all is asked that has a larger P than the start."""
    tuner = Seer(SearchSpace.around(START))
    options = {"tolerance": 0.0, "run": "run", "watch": None}
    tuned = estune.tune(rig, tuner=tuner, trials=15, folder=folder, ask=ask, **options)
    return tuned, [request.number for request in rig.asked]


def test_gains_beyond_what_is_known_to_be_safe_are_run_only_where_somebody_agrees(tmp_path):
    questions = []

    def ask(question):
        assert not question.expected.explored
        questions.append(question.request.number)
        return answers(question.request.number)

    found, ran = asked_run(tmp_path, ArithmeticRig(), ask)
    assert {answers(number) for number in questions} == {"yes", "no"}
    refused = {number for number in questions if answers(number) == "no"}
    assert not refused & set(ran)
    assert {e.number for e in found.entries if e.outcome is Outcome.DECLINED} == refused
    assert found.verdict.declined == len(refused)
    assert found.unsafe == 0
    assert "declined" in repr(found)


def test_a_run_that_was_cut_off_keeps_what_was_declined(tmp_path):
    class Gone(ArithmeticRig):
        def run(self, request):
            if request.number >= 10:
                raise KeyboardInterrupt
            return super().run(request)

    def ask(question):
        return answers(question.request.number)

    whole, _ = asked_run(tmp_path / "whole", ArithmeticRig(), ask)
    with pytest.raises(loop.Stopped):
        asked_run(tmp_path, Gone(), ask)
    with pytest.raises(InvalidInput, match="nobody to ask"):
        estune.resume(tmp_path / "run", ArithmeticRig(), watch=None)
    again = estune.resume(tmp_path / "run", ArithmeticRig(), watch=None, ask=ask)
    assert str(trace(again.entries)) == str(trace(whole.entries))  # nan is not itself
    assert again.verdict.declined > 1


def test_always_is_asked_once(tmp_path):
    questions = []

    def ask(question):
        questions.append(question)
        return "always"

    found, ran = asked_run(tmp_path, ArithmeticRig(), ask)
    assert len(questions) == 1
    assert len(ran) == len(found.entries)
