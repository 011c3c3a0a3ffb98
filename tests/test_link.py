"""State machines of the protocol: every event in every state."""

from dataclasses import MISSING, fields
from itertools import product

import pytest

from estune.errors import ProtocolError
from estune.remote.state_machine import events, rig, trials
from estune.remote.state_machine.events import RigAction
from estune.remote.state_machine.reply_codes import ReplyCode
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
            # Else a lease that grows has no end of states.
            assert following.lease is None or following.lease.expires_at_s <= LEASE_S
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


def test_trial_that_the_ledger_knows_is_answered_from_it_and_changes_nothing(moves):
    answered = set()
    for state, now_s, event, move in moves:
        if getattr(event, "known", TrialState.UNKNOWN) is TrialState.UNKNOWN or move is None:
            continue
        if state.closed:
            continue
        if isinstance(event, events.VoidEvent) and event.trial_id == state.trial_id:
            continue  # whether its entry can still be kept from running is open
        passed = rig.step(state, events.Expire(), now_s)
        assert (move.reply_code, move.state) == (rig.OF_TRIAL[event.known], passed.state)
        assert move.orders == passed.orders
        answered.add((type(event), event.known))
    assert len(answered) == 4


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


def test_lease_ends_a_fixed_time_after_the_last_renewal_however_many_there_were():
    state = rig.step(RigState(), events.Acquire("a", "holder a"), 0.0).state
    for last_s in (0.1, 0.2, 0.3):
        state = rig.step(state, events.Renew("a"), last_s).state
    assert rig.step(state, events.Expire(), last_s + 0.99 * LEASE_S).state.lease is not None
    assert rig.step(state, events.Expire(), last_s + LEASE_S).state.lease is None


@pytest.mark.parametrize("busy", [False, True], ids=["idle", "in a trial"])
def test_first_reason_of_an_emergency_stop_stands(busy):
    state = RigState()
    if busy:
        state = rig.step(state, events.Acquire("a", "holder a"), 0.0).state
        state = rig.step(state, events.SubmitEvent("a", "t0", TrialState.UNKNOWN, ""), 0.0).state
    for reason in ("smoke", "a second button"):
        state = rig.step(state, events.EstopEvent(reason), 0.1).state
    told = rig.step(state, events.SubmitEvent("a", "t1", TrialState.UNKNOWN, ""), 0.2)
    assert (state.latched, state.trial is not None) == ("smoke", busy)
    assert busy or "smoke" in told.sentence


def test_begin_is_accepted_once_and_never_while_stopping(moves):
    for state, now_s, event, move in moves:
        if not isinstance(event, events.Begin) or move is None:
            continue
        stopping = state.trial.stopping or not lives(state, now_s)
        assert (move.reply_code is ReplyCode.ACCEPTED) == (not stopping)
        assert move.sentence == move.state.trial.stopping  # why not
        if move.reply_code is ReplyCode.ACCEPTED:
            assert move.state.mode is Mode.RUNNING
            with pytest.raises(ProtocolError, match="running cannot begin"):
                rig.step(move.state, events.Begin(), now_s)


def test_command_without_the_lease_is_refused_for_that_alone_while_the_rig_takes_commands(moves):
    commands = (events.SetGainsEvent, events.SwitchOffEvent, events.FollowEvent)
    for state, now_s, event, move in moves:
        if not isinstance(event, commands) or state.latched or state.closed:
            continue
        if not (lives(state, now_s) and event.token == state.lease.token):
            assert move.reply_code in (ReplyCode.HELD, ReplyCode.NO_LEASE)


def test_cancel_that_names_another_trial_stops_nothing(moves):
    """A cancel that was delayed arrives while the next trial runs."""
    stopped = 0
    for state, now_s, event, move in moves:
        if not isinstance(event, events.CancelEvent) or state.trial is None:
            continue
        if not lives(state, now_s) or event.token != state.lease.token or state.trial.stopping:
            continue
        names_it = event.trial_id in ("", state.trial.trial_id)
        assert move.reply_code is ReplyCode.ACCEPTED
        assert (RigAction.STOP in move.orders) is names_it
        assert bool(move.state.trial.stopping) is names_it
        stopped += names_it
    assert stopped


def test_busy_reply_names_the_trial_and_orders_nothing(moves):
    asked = (events.SetGainsEvent, events.SwitchOffEvent, events.FollowEvent, events.SubmitEvent)
    for state, now_s, event, move in moves:
        if state.trial is None or state.closed or not lives(state, now_s):
            continue
        is_new = getattr(event, "known", TrialState.UNKNOWN) is TrialState.UNKNOWN
        if isinstance(event, asked) and event.token == state.lease.token and is_new:
            assert move.reply_code is ReplyCode.BUSY
            assert f"busy with trial {state.trial.trial_id};" in move.sentence
            assert (move.state, move.orders) == (state, ())


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
