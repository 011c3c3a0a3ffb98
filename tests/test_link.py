"""The state machines of the link: every state by every event, and both ends over a bad network."""

from dataclasses import dataclass, field
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
from estune.remote.state_machine.reply_codes import OF_TRIAL, ReplyCode
from estune.remote.state_machine.state import LEASE_S, Mode, RigAction, RigState, Transition
from estune.remote.state_machine.trials import TrialEvent, TrialState

# --- one trial id ---


@pytest.mark.parametrize(("state", "event"), list(product(TrialState, TrialEvent)))
def test_a_trial_id_moves_forward_only_and_what_cannot_be_is_an_error(state, event):
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
    assert following.may_have_moved >= state.may_have_moved
    if event is TrialEvent.BOOT:
        assert following.is_final or following is TrialState.UNKNOWN


def test_a_trial_begins_from_accepted_alone():
    assert [s for s in TrialState if TrialEvent.START in trials.TABLE[s]] == [TrialState.ACCEPTED]


# --- the rig ---

TOKENS, IDS = ("a", "b"), ("t0", "t1")
KNOWN = (TrialState.UNKNOWN, TrialState.ENDED, TrialState.VOID)
EVENTS = (
    *(events.Acquire(token, f"holder {token}") for token in TOKENS),
    *(events.Renew(token) for token in TOKENS),
    *(events.Release(token) for token in TOKENS),
    events.Expire(),
    *(
        events.SubmitEvent(token, trial_id, known, objection)
        for token, trial_id, known in product(TOKENS, IDS, KNOWN)
        for objection in ("", "too far")
    ),
    *(events.CancelEvent(token, trial_id) for token, trial_id in product(TOKENS, ("", *IDS))),
    *(
        events.VoidEvent(token, trial_id, known)
        for token, trial_id, known in product(TOKENS, IDS, KNOWN)
    ),
    *(events.SetGainsEvent(token) for token in TOKENS),
    *(
        events.EstopEvent("smoke"),
        events.ClearEvent(),
        events.Noted(),
        events.Begin(),
        events.End(),
        events.Close(),
    ),
)
INTERNAL = (events.Noted, events.Begin, events.End)
STEP_S = LEASE_S / 2


def normal(state: RigState, now_s: float) -> RigState:
    """The same state seen from time zero, so that there are finitely many."""
    lease = state.lease and state.lease._replace(expires_at_s=state.lease.expires_at_s - now_s)
    return state._replace(lease=lease, ended=0)


def reachable() -> list[tuple[RigState, float, events.Event, Transition | None]]:
    """Every move from every state that can be reached, each event at three times."""
    found, queue, moves = {RigState()}, [RigState()], []
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
            if following not in found:
                found.add(following)
                queue.append(following)
    return moves


@pytest.fixture(scope="module")
def moves():
    return reachable()


def lives(state: RigState, now_s: float) -> bool:
    return state.lease is not None and now_s < state.lease.expires_at_s


def test_every_mode_meets_every_event_and_only_the_impossible_is_an_error(moves):
    met = {(state.mode, type(event)) for state, _, event, _ in moves}
    assert met == set(product(Mode, rig.TABLE))
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


def test_a_command_that_is_refused_changes_nothing_and_orders_nothing(moves):
    for state, now_s, event, move in moves:
        if move is None or move.verdict in (ReplyCode.ACCEPTED, ReplyCode.VOID):
            continue
        passed = rig.step(state, events.Expire(), now_s)
        assert (move.state, move.orders) == (passed.state, passed.orders), event


def test_a_trial_is_taken_in_by_its_owner_alone_once_and_into_a_rig_at_rest(moves):
    taken = 0
    for state, now_s, event, move in moves:
        if move is None or RigAction.TAKE_IN not in move.orders:
            continue
        taken += 1
        assert lives(state, now_s)
        assert event.token == state.lease.token
        assert (event.known, event.objection) == (TrialState.UNKNOWN, "")
        assert (state.trial, state.latched, state.closed) == (None, "", False)
    assert taken


def test_nothing_moves_but_by_the_holder_of_a_lease_that_lives(moves):
    for state, now_s, event, move in moves:
        if move is None:
            continue
        if {RigAction.TAKE_IN, RigAction.APPLY, RigAction.TOMBSTONE} & set(move.orders):
            assert lives(state, now_s)
            assert event.token == state.lease.token


def test_a_trial_whose_lease_ends_is_stopped(moves):
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


def test_a_lease_passes_to_another_only_once_it_has_ended(moves):
    for state, now_s, _, move in moves:
        if move is not None and lives(state, now_s) and move.state.lease is not None:
            assert move.state.lease.token == state.lease.token


def test_an_emergency_stop_is_obeyed_in_every_state_and_holds_until_cleared(moves):
    for state, _, event, move in moves:
        if isinstance(event, events.EstopEvent):
            assert move.verdict is ReplyCode.ACCEPTED
            assert RigAction.ESTOP in move.orders
            assert move.state.latched
            assert move.state.trial is None or move.state.trial.stopping
        elif state.latched and move is not None and not isinstance(event, events.ClearEvent):
            assert move.state.latched
            assert not {RigAction.TAKE_IN, RigAction.APPLY, RigAction.CLEAR} & set(move.orders)


def test_a_trial_begins_once_and_never_when_it_is_being_stopped(moves):
    for state, now_s, event, move in moves:
        if not isinstance(event, events.Begin) or move is None:
            continue
        stopping = state.trial.stopping or not lives(state, now_s)
        assert (move.verdict is ReplyCode.ACCEPTED) == (not stopping)
        if move.verdict is ReplyCode.ACCEPTED:
            assert move.state.mode is Mode.RUNNING
            with pytest.raises(ProtocolError, match="running cannot begin"):
                rig.step(move.state, events.Begin(), now_s)


def test_who_is_refused_is_told_who_holds_the_rig(moves):
    for _, _, _, move in moves:
        if move is not None and move.verdict is ReplyCode.HELD:
            assert move.state.lease.holder in move.sentence


def test_a_rig_that_closes_takes_nothing_in_any_more(moves):
    for state, _, _, move in moves:
        if state.closed and move is not None:
            assert move.state.closed
            assert move.state.lease is None
            assert not {RigAction.TAKE_IN, RigAction.APPLY} & set(move.orders)


# --- the client ---


@pytest.mark.parametrize(
    ("stage", "heard"), list(product(ClientStage, [*ReplyCode, *ClientInput]))
)
def test_a_client_never_sends_a_trial_again_that_may_have_been_taken_in(stage, heard):
    try:
        step = client.next_transition(stage, heard)
    except ProtocolError:
        assert stage in (ClientStage.OVER, ClientStage.FRESH)
        return
    if step.action in (Action.SUBMIT, Action.LEASE) and heard is not ClientInput.EMPTIED:
        assert stage is not ClientStage.IN_HAND
        harmless = (
            ReplyCode.UNKNOWN,
            ReplyCode.NO_LEASE,
            ClientInput.LEASED,
            ClientInput.RESTARTED,
        )
        assert heard in harmless
        assert heard is not ClientInput.RESTARTED or stage is ClientStage.FRESH
    if step.action is Action.GONE:
        assert stage is ClientStage.FRESH
    if step.action is Action.NOTHING_RAN:
        assert heard in (ReplyCode.NEVER_STARTED, ReplyCode.VOID)
    if step.action is Action.INTERRUPTED:
        assert heard is ReplyCode.INTERRUPTED
    assert (step.stage is ClientStage.OVER) == (step.action in OVER)


OVER = {
    *(Action.RECORD, Action.INTERRUPTED, Action.NOTHING_RAN),
    *(Action.FAIL, Action.GONE, Action.AMBIGUOUS),
}


def test_a_trial_that_may_have_been_sent_is_not_fresh():
    assert client.sent(client.START).stage is ClientStage.SENT
    waiting = client.next_transition(ClientStage.SENT, ReplyCode.ACCEPTED)
    assert client.sent(waiting) == waiting


def test_busy_with_anothers_trial_is_a_refusal():
    assert (
        client.next_transition(ClientStage.SENT, ReplyCode.BUSY, own=False).action is Action.FAIL
    )
    assert client.next_transition(ClientStage.SENT, ReplyCode.BUSY).action is Action.WAIT


# --- both, over a network that loses, repeats and reorders ---


@dataclass
class Life:
    """A client's view of one trial; a new one after each kill of the client."""

    trial_id: str
    step: client.ClientTransition = field(default_factory=lambda: client.START)
    token: str = ""
    result: Action | None = None


class Exchange(RuleBasedStateMachine):
    """One rig with a durable ledger, one client after another, one network in between.

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
        self.client = Life("t0")

    # the client

    @rule()
    def client_acts(self):
        """Sends what its machine says is next; waiting is inquiring."""
        life = self.client
        if life.result is not None:
            self.number += 1
            self.client = Life(f"t{self.number}", token=life.token)
            return
        if life.step.action is Action.LEASE:
            self.tokens += 1
            life.token = f"k{self.tokens}"
            verb = "lease"
        else:
            life.step = client.sent(life.step)
            verb = "submit" if life.step.action is Action.SUBMIT else "inquire"
        self.queries.append((self.boots, verb, life.token, life.trial_id))

    @rule(at=st.integers(0, 99), twice=st.integers(0, 9).map(lambda n: n == 0))
    def answer_arrives(self, at, twice):
        """Answers of an earlier start of the rig are recognised by their instance."""
        if not self.answers:
            return
        index = at % len(self.answers)
        boot, verb, trial_id, token, heard, record = self.answers[index]
        if not twice:
            del self.answers[index]
        life = self.client
        if boot != self.boots or trial_id != life.trial_id or life.result is not None:
            return
        leasing = life.step.action is Action.LEASE
        if verb == "lease" and leasing and token == life.token:
            self._hear(ClientInput.LEASED if heard is ReplyCode.ACCEPTED else heard)
        elif verb != "lease" and not leasing and life.step.stage is not ClientStage.FRESH:
            # A late answer to an earlier question is heard as if it were to the latest.
            self._hear(heard, record)

    def _hear(self, heard, record=None):
        life = self.client
        life.step = client.next_transition(life.step.stage, heard)
        action = life.step.action
        moved = self.moved.get(life.trial_id, 0)
        if action is Action.RECORD:
            assert record == self.records[life.trial_id]
            assert self.ledger[life.trial_id] is TrialState.ENDED
        elif action is Action.NOTHING_RAN:
            assert moved == 0
            assert self.ledger[life.trial_id] in (TrialState.NEVER_STARTED, TrialState.VOID)
        elif action is Action.INTERRUPTED:
            assert moved == 1
        elif action is Action.FAIL:
            life.token = ""
        if life.step.stage is ClientStage.OVER:
            life.result = action
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
            return  # addressed to an instance that is no more
        known = self.ledger.get(trial_id, TrialState.UNKNOWN)
        mine = self.rig.trial is not None and self.rig.trial.trial_id == trial_id
        if verb == "lease":
            verdict = self._rig(events.Acquire(token, "client")).verdict
        elif verb == "submit":
            move = self._rig(events.SubmitEvent(token, trial_id, known))
            if RigAction.TAKE_IN in move.orders:
                return  # answered once it is in the ledger
            verdict = move.verdict
        elif known is TrialState.UNKNOWN and mine:
            verdict = ReplyCode.BUSY
        else:
            verdict = OF_TRIAL[known]
        if verdict is ReplyCode.BUSY and not mine:
            return  # the client under test wants one trial at a time
        record = self.records.get(trial_id)
        heard = ClientInput.RECORD if verdict is ReplyCode.ENDED else verdict
        self.answers.append((self.boots, verb, trial_id, token, heard, record))

    @rule()
    def rig_goes_on(self):
        """Writes its ledger, begins the trial, ends it: one of these at a time."""
        mode, trial = self.rig.mode, self.rig.trial
        if trial is None:
            return
        if not trial.noted:
            self._note(trial.trial_id, TrialEvent.SUBMIT)
            self._rig(events.Noted())
            answer = (self.boots, "submit", trial.trial_id, "", ReplyCode.ACCEPTED, None)
            self.answers.append(answer)
        elif mode is Mode.ACCEPTED:
            if self._rig(events.Begin()).verdict is ReplyCode.ACCEPTED:
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
        """Without it, few examples would come as far as a trial that runs."""
        for _ in range(turns):
            self.client_acts()
            self.query_arrives(-1, twice=False)
            self.rig_goes_on()
            self.answer_arrives(-1, twice=False)

    # what goes wrong

    @rule(at=st.integers(0, 99), of_queries=st.booleans())
    def message_is_lost(self, at, of_queries):
        bag = self.queries if of_queries else self.answers
        if bag:
            del bag[at % len(bag)]
        life = self.client
        leasing = life.step.action is Action.LEASE  # it will ask again, for another lease
        if life.step.stage is not ClientStage.FRESH and life.result is None and not leasing:
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
        self.client = Life(self.client.trial_id)

    @rule(passed=st.sampled_from([0.3, 0.6, 2.0]), renews=st.booleans())
    def time_passes(self, passed, renews):
        self.now_s += passed * LEASE_S
        self._rig(events.Renew(self.client.token) if renews else events.Expire())

    @rule(event=st.sampled_from([events.EstopEvent("smoke"), events.ClearEvent()]))
    def somebody_stops_or_clears(self, event):
        self._rig(event)

    @rule()
    def client_voids(self):
        """As after Ctrl-C: what was not taken in must never run."""
        known = self.ledger.get(self.client.trial_id, TrialState.UNKNOWN)
        self._rig(events.VoidEvent(self.client.token, self.client.trial_id, known))

    @invariant()
    def no_trial_runs_twice(self):
        assert all(times == 1 for times in self.moved.values())

    @invariant()
    def no_trial_runs_that_was_voided(self):
        for trial_id, state in self.ledger.items():
            if state in (TrialState.VOID, TrialState.NEVER_STARTED):
                assert trial_id not in self.moved


reached: set[Action] = set()
"""What the clients of all the exchanges came to."""


def test_no_trial_runs_twice_over_a_network_that_loses_repeats_and_reorders():
    reached.clear()
    settled = settings(max_examples=200, stateful_step_count=100)
    run_state_machine_as_test(Exchange, settings=settled)
    assert reached >= {Action.RECORD, Action.INTERRUPTED, Action.NOTHING_RAN}
