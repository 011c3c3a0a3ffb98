"""Reaction of a rig to each event: one lease, one trial at a time, an emergency stop that latches.

State and time are values: `step(state, event, now_s)` returns the next state, the reply and the
actions that the server must execute. `TABLE` has a row for each event and a column for each mode;
its cells are the functions of this module. A refused command changes nothing; an event from inside
the rig that is impossible in a mode raises an error and changes nothing.
"""

from collections.abc import Callable
from typing import Any

from estune.errors import ProtocolError
from estune.remote.state_machine import events
from estune.remote.state_machine.events import RigAction
from estune.remote.state_machine.reply_codes import OF_TRIAL, ReplyCode
from estune.remote.state_machine.state import (
    LEASE_S,
    AcceptedTrial,
    GrantedLease,
    Mode,
    RigState,
    Transition,
)
from estune.remote.state_machine.trials import TrialState
from estune.support.state_table import IMPOSSIBLE, StateTable, TableRow


def step(state: RigState, event: events.Event, now_s: float) -> Transition:
    """Transition of a rig on an event at a monotonic time; an expired lease is ended first.

    Raises:
        ProtocolError: the event comes from inside the rig and is impossible; nothing changes.
    """
    # First, or a client whose lease has run out would still be obeyed.
    expired = _move(state, events.Expire(), now_s)
    if isinstance(event, events.Expire):
        return expired
    move = _move(expired.state, event, now_s)
    return move._replace(orders=expired.orders + move.orders)


def _move(state: RigState, event: events.Event, now_s: float) -> Transition:
    cell = TABLE.cell(type(event), state.mode)
    if isinstance(cell, str):
        name = type(event).__name__.lower()
        raise ProtocolError(f"a rig that is {state.mode} cannot {name}; nothing was done")
    return cell(state, event, now_s)


# --- lease ---


def lease(state: RigState, event: events.Acquire, now_s: float) -> Transition:
    """Grant the lease, unless another client holds it."""
    current = state.lease
    # Two commanders would each restore what the other has just set. The own token passes: a client
    # whose reply was lost asks again.
    if current is not None and current.token != event.token:
        return Transition(state, ReplyCode.HELD, _held(current))
    if state.closed:
        return refuse_closed(state, event, now_s)
    return Transition(
        state._replace(lease=GrantedLease(event.token, event.holder, now_s + LEASE_S))
    )


def renew(state: RigState, event: events.Renew, now_s: float) -> Transition:
    """Renew the lease, if it is the rig's."""
    current = state.lease
    if current is None or current.token != event.token:
        return _without_lease(state)
    # From now: added to the old expiry, the lease of a client that renews often would outlive it.
    return Transition(state._replace(lease=current._replace(expires_at_s=now_s + LEASE_S)))


def release(state: RigState, event: events.Release, _now_s: float) -> Transition:
    """End the lease, if it is the rig's."""
    if not _owns(state, event.token):
        return _without_lease(state)
    return Transition(state._replace(lease=None))


def release_and_stop(state: RigState, event: events.Release, _now_s: float) -> Transition:
    """End the lease and stop the trial, if it is the rig's lease."""
    if not _owns(state, event.token):
        return _without_lease(state)
    # No client is left that could stop it.
    return _stopping(state._replace(lease=None), "its client released the lease")


def expire(state: RigState, _event: events.Expire, now_s: float) -> Transition:
    """End an expired lease."""
    return Transition(state if _is_leased(state, now_s) else state._replace(lease=None))


def expire_and_stop(state: RigState, _event: events.Expire, now_s: float) -> Transition:
    """End an expired lease and stop the trial: the dead-man's switch."""
    if state.lease is None or _is_leased(state, now_s):
        return Transition(state)
    reason = f"no renewal by {state.lease.holder} for {LEASE_S:g} s, so the lease expired"
    return _stopping(state._replace(lease=None), reason)


# --- commands ---


def accept(state: RigState, event: events.SubmitEvent, _now_s: float) -> Transition:
    """Accept the trial, if it is new, the lease is right and the limits hold."""
    # Before the lease: a client that has lost it learns what became of its trial.
    if event.known is not TrialState.UNKNOWN:
        return Transition(state, OF_TRIAL[event.known])
    if not _owns(state, event.token):
        return _without_lease(state)
    if event.objection:
        return Transition(state, ReplyCode.REFUSED, event.objection)
    trial = AcceptedTrial(event.trial_id)
    return Transition(state._replace(trial=trial), orders=(RigAction.TAKE_IN,))


def submit_while_busy(state: RigState, event: events.SubmitEvent, _now_s: float) -> Transition:
    """Reply with the state in the ledger; busy without an entry."""
    # Who asks again for a trial that has ended learns so even while another one runs.
    if event.known is not TrialState.UNKNOWN:
        return Transition(state, OF_TRIAL[event.known])
    return _busy(state) if _owns(state, event.token) else _without_lease(state)


def submit_while_safe(state: RigState, event: events.SubmitEvent, _now_s: float) -> Transition:
    """Reply with the state in the ledger; refuse until cleared without an entry."""
    if event.known is not TrialState.UNKNOWN:
        return Transition(state, OF_TRIAL[event.known])
    return _safe(state)


def submit_while_closed(state: RigState, event: events.SubmitEvent, now_s: float) -> Transition:
    """Reply with the state in the ledger; refuse without an entry."""
    if event.known is not TrialState.UNKNOWN:
        return Transition(state, OF_TRIAL[event.known])
    return refuse_closed(state, event, now_s)


def cancel_without_trial(state: RigState, _event: events.CancelEvent, _now_s: float) -> Transition:
    """Accept: no trial is active."""
    return Transition(state)


def cancel(state: RigState, event: events.CancelEvent, _now_s: float) -> Transition:
    """Stop the trial, if the lease is right and the command names it or none; else accept."""
    if not _owns(state, event.token):
        return _without_lease(state)
    # A cancel that was delayed must not stop the trial after the one that it names.
    if event.trial_id not in ("", state.trial_id):
        return Transition(state)
    return _stopping(state, "stopped by its client")


def cancel_again(state: RigState, event: events.CancelEvent, _now_s: float) -> Transition:
    """Accept, if the lease is right; the trial is being stopped."""
    return Transition(state) if _owns(state, event.token) else _without_lease(state)


def void(state: RigState, event: events.VoidEvent, _now_s: float) -> Transition:
    """Note in the ledger that the trial must never run, if it has no entry."""
    # What has run, or may have, cannot be undone: the client learns which.
    if event.known is not TrialState.UNKNOWN:
        return Transition(state, OF_TRIAL[event.known])
    if not _owns(state, event.token):
        return _without_lease(state)
    return Transition(state, ReplyCode.VOID, orders=(RigAction.TOMBSTONE,))


def void_while_taking(state: RigState, event: events.VoidEvent, now_s: float) -> Transition:
    """Reply busy, if this very trial is being accepted; else as in the other modes."""
    # Until its entry is written, it is open whether it can still be kept from running.
    if event.trial_id == state.trial_id:
        return _busy(state)
    return void(state, event, now_s)


def apply(state: RigState, event: events.SetGainsEvent, _now_s: float) -> Transition:
    """Apply the gains, if the lease is right."""
    if not _owns(state, event.token):
        return _without_lease(state)
    return Transition(state, orders=(RigAction.APPLY,))


def switch_off(state: RigState, event: events.SwitchOffEvent, _now_s: float) -> Transition:
    """Switch the compensations off, if the lease is right."""
    if not _owns(state, event.token):
        return _without_lease(state)
    return Transition(state, orders=(RigAction.SWITCH_OFF,))


def busy_with_trial(
    state: RigState,
    event: events.SetGainsEvent | events.SwitchOffEvent | events.FollowEvent,
    _now_s: float,
) -> Transition:
    """Refuse: a trial is active."""
    return _busy(state) if _owns(state, event.token) else _without_lease(state)


def held_safe(state: RigState, _event: events.Event, _now_s: float) -> Transition:
    """Refuse until cleared."""
    return _safe(state)


def follow(state: RigState, event: events.FollowEvent, _now_s: float) -> Transition:
    """Follow the setpoint, if the lease is right and the setpoint is valid."""
    if not _owns(state, event.token):
        return _without_lease(state)
    if event.objection:
        return Transition(state, ReplyCode.REFUSED, event.objection)
    return Transition(state, orders=(RigAction.FOLLOW,))


def estop(state: RigState, event: events.EstopEvent, _now_s: float) -> Transition:
    """Bring the rig to its safe state and hold it there."""
    # The first reason stays: it names the cause that has to be removed before a clear.
    latched = state._replace(latched=state.latched or event.reason)
    return Transition(latched, orders=(RigAction.ESTOP,))


def estop_trial(state: RigState, event: events.EstopEvent, _now_s: float) -> Transition:
    """Stop the trial, bring the rig to its safe state and hold it there."""
    move = _stopping(state, f"emergency stop: {event.reason}")
    latched = move.state._replace(latched=state.latched or event.reason)
    return move._replace(state=latched, orders=(RigAction.ESTOP, *move.orders))


def clear(state: RigState, _event: events.ClearEvent, _now_s: float) -> Transition:
    """End the emergency stop: the rig may be used again."""
    return Transition(state._replace(latched=""), orders=(RigAction.CLEAR,))


def clear_while_busy(state: RigState, _event: events.ClearEvent, _now_s: float) -> Transition:
    """Refuse: a trial is active."""
    # The stop that is ending it would be undone before it has ended.
    return _busy(state)


def refuse_closed(state: RigState, _event: events.Event, _now_s: float) -> Transition:
    """Refuse: the rig is shutting down."""
    return Transition(state, ReplyCode.REFUSED, "the rig is shutting down; restart it")


# --- events from inside the rig ---


def noted(state: RigState, _event: events.Noted, _now_s: float) -> Transition:
    """Note that the trial is in the ledger."""
    return Transition(_noted(state, begun=False))


def begin(state: RigState, _event: events.Begin, _now_s: float) -> Transition:
    """Start the trial."""
    return Transition(_noted(state, begun=True))


def refuse_begin(state: RigState, _event: events.Begin, _now_s: float) -> Transition:
    """Refuse: the trial is being stopped."""
    return Transition(
        state, ReplyCode.REFUSED, "" if state.trial is None else state.trial.stopping
    )


def end(state: RigState, _event: events.End, _now_s: float) -> Transition:
    """End the trial."""
    return Transition(state._replace(trial=None, ended=state.ended + 1))


def close(state: RigState, _event: events.Close, _now_s: float) -> Transition:
    """Accept no more commands."""
    return Transition(state._replace(closed=True, lease=None))


def close_trial(state: RigState, _event: events.Close, _now_s: float) -> Transition:
    """Stop the trial, and accept no more commands."""
    return _stopping(state._replace(closed=True, lease=None), "the rig is shutting down")


def stay(state: RigState, _event: events.Event, _now_s: float) -> Transition:
    """Change nothing."""
    return Transition(state)


# --- shared ---


def _owns(state: RigState, token: str) -> bool:
    return state.lease is not None and state.lease.token == token


def _is_leased(state: RigState, now_s: float) -> bool:
    return state.lease is not None and now_s < state.lease.expires_at_s


def _noted(state: RigState, *, begun: bool) -> RigState:
    trial = state.trial
    return (
        state if trial is None else state._replace(trial=trial._replace(noted=True, begun=begun))
    )


def _stopping(state: RigState, reason: str) -> Transition:
    """Order to stop the active trial; the first reason stands."""
    trial = state.trial
    if trial is None or trial.stopping:
        return Transition(state)
    stopped = state._replace(trial=trial._replace(stopping=reason))
    return Transition(stopped, orders=(RigAction.STOP,))


def _held(current: GrantedLease) -> str:
    return f"the rig is held by {current.holder}; wait until the holder releases it"


def _without_lease(state: RigState) -> Transition:
    if state.lease is not None:
        return Transition(state, ReplyCode.HELD, _held(state.lease))
    return Transition(state, ReplyCode.NO_LEASE, "the lease has expired; acquire a new one")


def _busy(state: RigState) -> Transition:
    remedy = f"the rig is busy with trial {state.trial_id}; wait until it has ended, or stop it"
    return Transition(state, ReplyCode.BUSY, remedy)


def _safe(state: RigState) -> Transition:
    return Transition(
        state,
        ReplyCode.SAFE,
        f"the rig is held in its safe state after an emergency stop ({state.latched}); "
        "remove the cause, then clear the stop",
    )


# --- table ---

Handler = Callable[[RigState, Any, float], Transition]

_UNSTOPPED = (Mode.TAKING, Mode.ACCEPTED, Mode.RUNNING)
_ACTIVE = (*_UNSTOPPED, Mode.ABORTING)
_SAFE, _CLOSED = (Mode.SAFE,), (Mode.CLOSED,)


TABLE: StateTable[type[events.Event], Mode, Handler] = StateTable(
    Mode,
    {
        events.Acquire: TableRow(lease, (refuse_closed, _CLOSED)),
        events.Renew: TableRow(renew, (refuse_closed, _CLOSED)),
        events.Release: TableRow(release, (release_and_stop, _UNSTOPPED), (stay, _CLOSED)),
        events.Expire: TableRow(
            expire, (expire_and_stop, _UNSTOPPED), (stay, (Mode.IDLE, Mode.CLOSED))
        ),
        events.SubmitEvent: TableRow(
            accept,
            (submit_while_busy, _ACTIVE),
            (submit_while_safe, _SAFE),
            (submit_while_closed, _CLOSED),
        ),
        events.CancelEvent: TableRow(
            cancel_without_trial, (cancel, _UNSTOPPED), (cancel_again, (Mode.ABORTING,))
        ),
        events.VoidEvent: TableRow(
            void, (void_while_taking, (Mode.TAKING,)), (refuse_closed, _CLOSED)
        ),
        events.SetGainsEvent: TableRow(
            apply, (busy_with_trial, _ACTIVE), (held_safe, _SAFE), (refuse_closed, _CLOSED)
        ),
        events.SwitchOffEvent: TableRow(
            switch_off, (busy_with_trial, _ACTIVE), (held_safe, _SAFE), (refuse_closed, _CLOSED)
        ),
        events.FollowEvent: TableRow(
            follow, (busy_with_trial, _ACTIVE), (held_safe, _SAFE), (refuse_closed, _CLOSED)
        ),
        events.EstopEvent: TableRow(estop, (estop_trial, _ACTIVE)),
        events.ClearEvent: TableRow(clear, (clear_while_busy, _ACTIVE), (refuse_closed, _CLOSED)),
        events.Noted: TableRow(IMPOSSIBLE, (noted, (Mode.TAKING, Mode.ABORTING))),
        events.Begin: TableRow(
            IMPOSSIBLE, (begin, (Mode.TAKING, Mode.ACCEPTED)), (refuse_begin, (Mode.ABORTING,))
        ),
        events.End: TableRow(IMPOSSIBLE, (end, _ACTIVE)),
        events.Close: TableRow(close, (close_trial, _ACTIVE), (stay, _CLOSED)),
    },
)
