"""The client of the link; its exchange with a rig over a network that loses and repeats."""

import threading
from dataclasses import dataclass, field
from itertools import product
from types import SimpleNamespace

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    rule,
    run_state_machine_as_test,
)

from estune.core.gains import Gains
from estune.errors import Interrupted, ProtocolError, RigError
from estune.remote.messages import Answer, encode
from estune.remote.state_machine import client, events, rig, trials
from estune.remote.state_machine.client import Action, ClientInput, ClientStage
from estune.remote.state_machine.events import RigAction
from estune.remote.state_machine.reply_codes import OF_TRIAL, ReplyCode
from estune.remote.state_machine.state import LEASE_S, Mode, RigState
from estune.remote.state_machine.trials import TrialEvent, TrialState
from estune.remote.zenoh.rig_connection import LinkStatus
from estune.remote.zenoh.trial_exchange import TrialExchange
from estune.trial import TrialRequest
from estune.trial.profiles import StepProfile


@pytest.mark.parametrize(
    ("stage", "received"), list(product(ClientStage, [*ReplyCode, *ClientInput]))
)
def test_client_never_resubmits_a_trial_that_may_be_accepted(stage, received):
    try:
        step = client.next_transition(stage, received)
    except ProtocolError:
        assert stage in (ClientStage.OVER, ClientStage.FRESH)
        return
    if step.action in (Action.SUBMIT, Action.LEASE) and received is not ClientInput.EMPTIED:
        assert stage is not ClientStage.IN_HAND
        harmless = (
            ReplyCode.UNKNOWN,
            ReplyCode.NO_LEASE,
            ClientInput.LEASED,
            ClientInput.RESTARTED,
        )
        assert received in harmless
        assert received is not ClientInput.RESTARTED or stage is ClientStage.FRESH
    if step.action is Action.GONE:
        assert stage is ClientStage.FRESH
    if step.action is Action.NOTHING_RAN:
        assert received in (ReplyCode.NEVER_STARTED, ReplyCode.VOID)
    if step.action is Action.INTERRUPTED:
        assert received is ReplyCode.INTERRUPTED
    assert (step.stage is ClientStage.OVER) == (step.action in OVER)


OVER = {
    *(Action.RECORD, Action.INTERRUPTED, Action.NOTHING_RAN),
    *(Action.FAIL, Action.GONE, Action.AMBIGUOUS),
}


def test_sent_trial_is_not_fresh():
    assert client.sent(client.START).stage is ClientStage.SENT
    waiting = client.next_transition(ClientStage.SENT, ReplyCode.ACCEPTED)
    assert client.sent(waiting) == waiting


def test_busy_with_another_trial_is_a_refusal():
    assert (
        client.next_transition(ClientStage.SENT, ReplyCode.BUSY, own=False).action is Action.FAIL
    )
    assert client.next_transition(ClientStage.SENT, ReplyCode.BUSY).action is Action.WAIT


class Silent:
    """A connection to a rig that accepts a trial, and then no longer answers for it."""

    name = "reel"

    def __init__(self, after: LinkStatus | bytes, *, simulated: bool) -> None:
        self.after = after
        self.about = SimpleNamespace(rig=SimpleNamespace(simulated=simulated))
        self.keys = SimpleNamespace(result=lambda _: "result")
        self.replies = iter([encode(Answer(ReplyCode.ACCEPTED))])

    def command_key(self, _command):
        return "submit"

    def ask(self, _key, _payload):
        return next(self.replies, None if isinstance(self.after, LinkStatus) else self.after)

    def check_liveliness(self, _silent_since_s):
        return self.after


@pytest.mark.parametrize(
    ("after", "simulated", "kind", "words"),
    [
        (
            LinkStatus(ClientInput.GONE, "it is gone"),
            False,
            RigError,
            "ledger says whether it has",
        ),
        (
            LinkStatus(ClientInput.REPLACED, "another"),
            False,
            Interrupted,
            "may have run: .*; check the rig",
        ),
        (encode(Answer(ReplyCode.UNKNOWN)), False, Interrupted, "may have run: .*; check the rig"),
        (encode(Answer(ReplyCode.UNKNOWN)), True, RigError, "ledger says whether it has"),
    ],
)
def test_operator_is_called_only_where_no_ledger_can_tell_whether_a_real_trial_ran(
    after, simulated, kind, words
):
    lease = SimpleNamespace(hold=lambda: "0" * 16, release=lambda: None)
    request = TrialRequest("run", 0, Gains(1.0, 1.0, 0.1, 0.1), StepProfile(15.0, 1.0, 0.1, 1.0))
    silent = Silent(after, simulated=simulated)
    with pytest.raises(RigError, match=words) as raised:
        TrialExchange(silent, lease, request, threading.Event(), 0.0).run()
    assert raised.type is kind


# --- both, over a network that loses, repeats and reorders ---


@dataclass
class ClientTrial:
    """One trial at a client; each kill of the client begins a new exchange."""

    trial_id: str
    step: client.ClientTransition = field(default_factory=lambda: client.START)
    token: str = ""
    result: Action | None = None


class Exchange(RuleBasedStateMachine):
    """One rig with a durable ledger, one client after another, and a network between them.

    Messages wait in a bag: any of them may be delivered next, be delivered twice, or be lost.
    """

    def __init__(self) -> None:
        super().__init__()
        self.rig = RigState()
        self.ledger: dict[str, TrialState] = {}
        self.records: dict[str, str] = {}
        self.moved: dict[str, int] = {}
        self.queries: list[tuple] = []
        self.answers: list[tuple] = []
        self.now_s = 0.0
        self.tokens = 0
        self.boots = 0
        self.number = 0
        self.client = ClientTrial("t0")

    # the client

    @rule()
    def client_acts(self):
        """Sends the next message of its state machine; waiting is inquiring."""
        view = self.client
        if view.result is not None:
            self.number += 1
            self.client = ClientTrial(f"t{self.number}", token=view.token)
            return
        if view.step.action is Action.LEASE:
            self.tokens += 1
            view.token = f"k{self.tokens}"
            verb = "lease"
        else:
            view.step = client.sent(view.step)
            verb = "submit" if view.step.action is Action.SUBMIT else "inquire"
        self.queries.append((self.boots, verb, view.token, view.trial_id))

    @rule(at=st.integers(0, 99), twice=st.integers(0, 9).map(lambda n: n == 0))
    def answer_arrives(self, at, twice):
        """Answers of an earlier start of the rig are recognised by their instance."""
        if not self.answers:
            return
        index = at % len(self.answers)
        boot, verb, trial_id, token, received, record = self.answers[index]
        if not twice:
            del self.answers[index]
        view = self.client
        if boot != self.boots or trial_id != view.trial_id or view.result is not None:
            return
        leasing = view.step.action is Action.LEASE
        if verb == "lease" and leasing and token == view.token:
            self._hear(ClientInput.LEASED if received is ReplyCode.ACCEPTED else received)
        elif verb != "lease" and not leasing and view.step.stage is not ClientStage.FRESH:
            # A late reply to an earlier query is taken for one to the latest.
            self._hear(received, record)

    def _hear(self, received, record=None):
        view = self.client
        view.step = client.next_transition(view.step.stage, received)
        action = view.step.action
        moved = self.moved.get(view.trial_id, 0)
        if action is Action.RECORD:
            assert record == self.records[view.trial_id]
            assert self.ledger[view.trial_id] is TrialState.ENDED
        elif action is Action.NOTHING_RAN:
            assert moved == 0
            assert self.ledger[view.trial_id] in (TrialState.NEVER_STARTED, TrialState.VOID)
        elif action is Action.INTERRUPTED:
            assert moved == 1
        elif action is Action.FAIL:
            view.token = ""
        if view.step.stage is ClientStage.OVER:
            view.result = action
            reached.add(action)

    # the rig

    @rule(at=st.integers(0, 99), twice=st.integers(0, 4).map(lambda n: n == 0))
    def query_arrives(self, at, twice):
        if not self.queries:
            return
        index = at % len(self.queries)
        boot, verb, token, trial_id = self.queries[index]
        if not twice:
            del self.queries[index]
        if boot != self.boots:
            return  # addressed to an earlier instance
        stored = self.ledger.get(trial_id, TrialState.UNKNOWN)
        mine = self.rig.trial is not None and self.rig.trial.trial_id == trial_id
        if verb == "lease":
            verdict = self._rig(events.Acquire(token, "client")).reply_code
        elif verb == "submit":
            move = self._rig(events.SubmitEvent(token, trial_id, stored))
            if RigAction.TAKE_IN in move.orders:
                return  # the reply follows once it is in the ledger
            verdict = move.reply_code
        elif stored is TrialState.UNKNOWN and mine:
            verdict = ReplyCode.BUSY
        else:
            verdict = OF_TRIAL[stored]
        if verdict is ReplyCode.BUSY and not mine:
            return  # the client under test submits one trial at a time
        record = self.records.get(trial_id)
        received = ClientInput.RECORD if verdict is ReplyCode.ENDED else verdict
        self.answers.append((self.boots, verb, trial_id, token, received, record))

    @rule()
    def rig_goes_on(self):
        """Executes the next action: writes the ledger, begins the trial, or ends it."""
        mode, trial = self.rig.mode, self.rig.trial
        if trial is None:
            return
        if not trial.noted:
            self._note(trial.trial_id, TrialEvent.SUBMIT)
            self._rig(events.Noted())
            answer = (self.boots, "submit", trial.trial_id, "", ReplyCode.ACCEPTED, None)
            self.answers.append(answer)
        elif mode is Mode.ACCEPTED:
            if self._rig(events.Begin()).reply_code is ReplyCode.ACCEPTED:
                self._note(trial.trial_id, TrialEvent.START)
                self.moved[trial.trial_id] = self.moved.get(trial.trial_id, 0) + 1
        else:
            self.records[trial.trial_id] = f"record of {trial.trial_id}"
            self._note(trial.trial_id, TrialEvent.END)
            self._rig(events.End())

    def _rig(self, event):
        move = rig.step(self.rig, event, self.now_s)
        self.rig = move.state
        if RigAction.TOMBSTONE in move.orders:
            self._note(event.trial_id, TrialEvent.VOID)
        return move

    def _note(self, trial_id, event):
        self.ledger[trial_id] = trials.after(self.ledger.get(trial_id, TrialState.UNKNOWN), event)

    @rule(turns=st.integers(1, 12))
    def all_goes_well_for_a_while(self, turns):
        """Starts a trial, which few random examples would reach."""
        for _ in range(turns):
            self.client_acts()
            self.query_arrives(-1, twice=False)
            self.rig_goes_on()
            self.answer_arrives(-1, twice=False)

    # faults

    @rule(at=st.integers(0, 99), of_queries=st.booleans())
    def message_is_lost(self, at, of_queries):
        bag = self.queries if of_queries else self.answers
        if bag:
            del bag[at % len(bag)]
        view = self.client
        leasing = view.step.action is Action.LEASE  # it will ask again, for another lease
        if view.step.stage is not ClientStage.FRESH and view.result is None and not leasing:
            self._hear(ClientInput.SILENCE)

    @rule()
    def rig_dies_and_boots(self):
        self.boots += 1
        self.rig = RigState()
        for trial_id in self.ledger:
            self._note(trial_id, TrialEvent.BOOT)
        if self.client.result is None:
            self._hear(ClientInput.RESTARTED)

    @rule()
    def client_dies_and_another_goes_on_with_its_trial(self):
        self.client = ClientTrial(self.client.trial_id)

    @rule(passed=st.sampled_from([0.3, 0.6, 2.0]), renews=st.booleans())
    def time_passes(self, passed, renews):
        self.now_s += passed * LEASE_S
        self._rig(events.Renew(self.client.token) if renews else events.Expire())

    @rule(event=st.sampled_from([events.EstopEvent("smoke"), events.ClearEvent()]))
    def somebody_stops_or_clears(self, event):
        self._rig(event)

    @rule()
    def client_voids(self):
        """As after Ctrl-C: a trial not accepted by now must never run."""
        stored = self.ledger.get(self.client.trial_id, TrialState.UNKNOWN)
        self._rig(events.VoidEvent(self.client.token, self.client.trial_id, stored))

    @invariant()
    def no_trial_runs_twice(self):
        assert all(times == 1 for times in self.moved.values())

    @invariant()
    def no_trial_runs_that_was_voided(self):
        for trial_id, state in self.ledger.items():
            if state in (TrialState.VOID, TrialState.NEVER_STARTED):
                assert trial_id not in self.moved


reached: set[Action] = set()
"""Final actions of the clients of all exchanges."""


def test_exchange_over_a_bad_network_runs_no_trial_twice():
    reached.clear()
    settled = settings(max_examples=60, stateful_step_count=100)
    run_state_machine_as_test(Exchange, settings=settled)
    assert reached >= {Action.RECORD, Action.INTERRUPTED, Action.NOTHING_RAN}
