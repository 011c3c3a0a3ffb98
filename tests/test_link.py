"""State machines of the protocol: every event in every state; both ends over a bad network."""

from dataclasses import MISSING, dataclass, field, fields
from itertools import product

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    rule,
    run_state_machine_as_test,
)

from estune.errors import ProtocolError
from estune.remote.state_machine import client, events, rig, trials
from estune.remote.state_machine.client import Action, ClientInput, ClientStage
from estune.remote.state_machine.events import RigAction
from estune.remote.state_machine.reply_codes import OF_TRIAL, ReplyCode
from estune.remote.state_machine.state import LEASE_S, Mode, RigState, Transition
from estune.remote.state_machine.trials import TrialEvent, TrialState

# --- one trial id ---

MAY_HAVE_MOVED = (
    *(TrialState.RUNNING, TrialState.ENDED, TrialState.FAILED, TrialState.INTERRUPTED),
)


@pytest.mark.parametrize(("state", "event"), list(product(TrialState, TrialEvent)))
def test_trial_state_only_advances_and_impossible_events_raise(state, event):
    begins = {TrialState.UNKNOWN: 0, TrialState.VOID: 1, TrialState.ACCEPTED: 1}
    rank = {**dict.fromkeys(TrialState, 3), TrialState.RUNNING: 2, **begins}
    try:
        following = trials.after(state, event)
    except ProtocolError:
        assert event in (TrialEvent.START, TrialEvent.END, TrialEvent.FAIL)
        assert state not in (TrialState.ACCEPTED, TrialState.RUNNING) or (
            (state, event) == (TrialState.RUNNING, TrialEvent.START)
        )
        return
    assert following == state or rank[following] > rank[state]
    assert (following is TrialState.RUNNING) <= (
        state is TrialState.RUNNING or event is TrialEvent.START
    )
    assert (following in MAY_HAVE_MOVED) >= (state in MAY_HAVE_MOVED)
    if event is TrialEvent.BOOT:
        assert following.is_final or following is TrialState.UNKNOWN


def test_trial_starts_from_accepted_only():
    row = trials.TABLE.rows[TrialEvent.START]
    assert [s for s in TrialState if not isinstance(row[s], str)] == [TrialState.ACCEPTED]


# --- the rig ---

TOKENS, IDS = ("a", "b"), ("t0", "t1")
KNOWN = (TrialState.UNKNOWN, TrialState.ENDED, TrialState.VOID)
VALUES = {
    "token": TOKENS,
    "trial_id": IDS,
    "known": KNOWN,
    "objection": ("", "too far"),
    "reason": ("smoke",),
}


def examples(kind: type[events.Event]) -> list[events.Event]:
    """Events of a class with all combinations of values, defaults included."""
    if kind is events.Acquire:
        return [events.Acquire(token, f"holder {token}") for token in TOKENS]
    values = [dict.fromkeys((f.default, *VALUES[f.name])) for f in fields(kind)]
    return [kind(*chosen) for chosen in product(*values) if MISSING not in chosen]


EVENTS = tuple(event for kind in rig.TABLE.rows for event in examples(kind))
INTERNAL = (events.Noted, events.Begin, events.End)
STEP_S = LEASE_S / 2


def normal(state: RigState, now_s: float) -> RigState:
    """State relative to time zero, which makes the number of states finite."""
    lease = state.lease and state.lease._replace(expires_at_s=state.lease.expires_at_s - now_s)
    return state._replace(lease=lease, ended=0)


def reachable() -> list[tuple[RigState, float, events.Event, Transition | None]]:
    """Every transition from every reachable state, each event at three times."""
    states, queue, moves = {RigState()}, [RigState()], []
    while queue:
        state = queue.pop()
        for event, now_s in product(EVENTS, (0.0, STEP_S, LEASE_S)):
            try:
                move = rig.step(state, event, now_s)
            except ProtocolError:
                moves.append((state, now_s, event, None))
                continue
            moves.append((state, now_s, event, move))
            following = normal(move.state, now_s)
            if following not in states:
                states.add(following)
                queue.append(following)
    return moves


@pytest.fixture(scope="module")
def moves():
    return reachable()


def lives(state: RigState, now_s: float) -> bool:
    return state.lease is not None and now_s < state.lease.expires_at_s


def test_step_handles_every_event_in_every_mode(moves):
    met = {(state.mode, type(event)) for state, _, event, _ in moves}
    assert met == set(product(Mode, rig.TABLE.rows))
    for state, now_s, event, move in moves:
        if move is None:
            at = rig.step(state, events.Expire(), now_s).state.mode
            assert isinstance(event, INTERNAL)
            possible = {
                events.Noted: (Mode.TAKING, Mode.ABORTING),
                events.Begin: (Mode.TAKING, Mode.ACCEPTED, Mode.ABORTING),
                events.End: (Mode.TAKING, Mode.ACCEPTED, Mode.RUNNING, Mode.ABORTING),
            }
            assert at not in possible[type(event)]


def test_step_with_a_refused_command_changes_nothing(moves):
    for state, now_s, event, move in moves:
        if move is None or move.reply_code in (ReplyCode.ACCEPTED, ReplyCode.VOID):
            continue
        passed = rig.step(state, events.Expire(), now_s)
        assert (move.state, move.orders) == (passed.state, passed.orders), event


def test_submit_is_accepted_once_from_the_holder_when_idle(moves):
    accepted = 0
    for state, now_s, event, move in moves:
        if move is None or RigAction.TAKE_IN not in move.orders:
            continue
        accepted += 1
        assert lives(state, now_s)
        assert event.token == state.lease.token
        assert (event.known, event.objection) == (TrialState.UNKNOWN, "")
        assert (state.trial, state.latched, state.closed) == (None, "", False)
    assert accepted


def test_motion_is_ordered_only_by_the_lease_holder(moves):
    for state, now_s, event, move in moves:
        if move is None:
            continue
        if {RigAction.TAKE_IN, RigAction.APPLY, RigAction.TOMBSTONE} & set(move.orders):
            assert lives(state, now_s)
            assert event.token == state.lease.token


def test_end_of_the_lease_stops_the_trial(moves):
    ends = 0
    for state, now_s, _, move in moves:
        if move is None or move.state.trial is None or move.state.lease is not None:
            continue
        assert move.state.trial.stopping
        if state.trial is not None and not state.trial.stopping:
            assert RigAction.STOP in move.orders
            ends += 1
        assert now_s < LEASE_S or not lives(state, now_s)
    assert ends


def test_lease_changes_hands_only_after_its_end(moves):
    for state, now_s, _, move in moves:
        if move is not None and lives(state, now_s) and move.state.lease is not None:
            assert move.state.lease.token == state.lease.token


def test_estop_is_obeyed_in_every_state_and_holds_until_clear(moves):
    for state, _, event, move in moves:
        if isinstance(event, events.EstopEvent):
            assert move.reply_code is ReplyCode.ACCEPTED
            assert RigAction.ESTOP in move.orders
            assert move.state.latched
            assert move.state.trial is None or move.state.trial.stopping
        elif state.latched and move is not None and not isinstance(event, events.ClearEvent):
            assert move.state.latched
            assert not {RigAction.TAKE_IN, RigAction.APPLY, RigAction.CLEAR} & set(move.orders)


def test_begin_is_accepted_once_and_never_while_stopping(moves):
    for state, now_s, event, move in moves:
        if not isinstance(event, events.Begin) or move is None:
            continue
        stopping = state.trial.stopping or not lives(state, now_s)
        assert (move.reply_code is ReplyCode.ACCEPTED) == (not stopping)
        if move.reply_code is ReplyCode.ACCEPTED:
            assert move.state.mode is Mode.RUNNING
            with pytest.raises(ProtocolError, match="running cannot begin"):
                rig.step(move.state, events.Begin(), now_s)


def test_held_reply_names_the_holder(moves):
    for _, _, _, move in moves:
        if move is not None and move.reply_code is ReplyCode.HELD:
            assert move.state.lease.holder in move.sentence


def test_closed_rig_accepts_no_commands(moves):
    for state, _, _, move in moves:
        if state.closed and move is not None:
            assert move.state.closed
            assert move.state.lease is None
            assert not {RigAction.TAKE_IN, RigAction.APPLY} & set(move.orders)


# --- the client ---


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
    settled = settings(max_examples=200, stateful_step_count=100)
    run_state_machine_as_test(Exchange, settings=settled)
    assert reached >= {Action.RECORD, Action.INTERRUPTED, Action.NOTHING_RAN}
