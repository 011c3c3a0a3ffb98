"""What a rig does with an event in a mode: the cells of the table in `estune.remote.state_machine.rig`."""

from estune.errors import ProtocolError
from estune.remote.state_machine.events import (
    Acquire,
    Begin,
    CancelEvent,
    ClearEvent,
    Close,
    End,
    EstopEvent,
    Event,
    Expire,
    Noted,
    Release,
    Renew,
    SetGainsEvent,
    SubmitEvent,
    VoidEvent,
)
from estune.remote.state_machine.reply_codes import OF_TRIAL, ReplyCode
from estune.remote.state_machine.state import (
    LEASE_S,
    AcceptedTrial,
    Lease,
    RigAction,
    RigState,
    Transition,
)
from estune.remote.state_machine.trials import TrialState


def stay(state: RigState, event: Event, now_s: float) -> Transition:  # noqa: ARG001  as all in the table
    """Nothing changes."""
    return Transition(state)


def lease(state: RigState, event: Acquire, now_s: float) -> Transition:
    """Granted, unless another client holds it."""
    lease = state.lease
    if lease is not None and lease.token != event.token:
        return Transition(state, ReplyCode.HELD, _held(lease))
    if state.closed:
        return closed(state, event, now_s)
    return Transition(state._replace(lease=Lease(event.token, event.holder, now_s + LEASE_S)))


def renew(state: RigState, event: Renew, now_s: float) -> Transition:
    """Renewed, if it is the rig's lease."""
    lease = state.lease
    if lease is None or lease.token != event.token:
        return _without_lease(state)
    return Transition(state._replace(lease=lease._replace(expires_at_s=now_s + LEASE_S)))


def release(state: RigState, event: Release, now_s: float) -> Transition:  # noqa: ARG001  as above
    """Ended, if it is the rig's lease."""
    if not _owns(state, event.token):
        return _without_lease(state)
    return Transition(state._replace(lease=None))


def release_and_stop(state: RigState, event: Release, now_s: float) -> Transition:  # noqa: ARG001
    """Ended, and the trial stopped, if it is the rig's lease."""
    if not _owns(state, event.token):
        return _without_lease(state)
    return _stopping(state._replace(lease=None), "its client let go of the rig")


def expire(state: RigState, event: Expire, now_s: float) -> Transition:  # noqa: ARG001  as above
    """A lease that has run out ends."""
    return Transition(state if _lives(state, now_s) else state._replace(lease=None))


def expire_and_stop(state: RigState, event: Expire, now_s: float) -> Transition:  # noqa: ARG001
    """A lease that has run out ends, and the trial is stopped: the dead-man's switch."""
    lease = state.lease
    if lease is None or _lives(state, now_s):
        return Transition(state)
    why = f"{lease.holder} has not been heard of for {LEASE_S:g} s, so the lease ran out"
    return _stopping(state._replace(lease=None), why)


def take_in(state: RigState, event: SubmitEvent, now_s: float) -> Transition:  # noqa: ARG001  as above
    """Taken in, if the lease is right, the ledger does not know it and the rig may run it."""
    if event.known is not TrialState.UNKNOWN:
        return Transition(state, OF_TRIAL[event.known])
    if not _owns(state, event.token):
        return _without_lease(state)
    if event.objection:
        return Transition(state, ReplyCode.REFUSED, event.objection)
    taken = AcceptedTrial(event.trial_id)
    return Transition(state._replace(trial=taken), orders=(RigAction.TAKE_IN,))


def while_busy(state: RigState, event: SubmitEvent, now_s: float) -> Transition:  # noqa: ARG001  as above
    """What the ledger knows of it; busy, if nothing."""
    if event.known is not TrialState.UNKNOWN:
        return Transition(state, OF_TRIAL[event.known])
    if not _owns(state, event.token):
        return _without_lease(state)
    return _busy(state)


def while_safe(state: RigState, event: SubmitEvent, now_s: float) -> Transition:  # noqa: ARG001  as above
    """What the ledger knows of it; refused until cleared, if nothing."""
    if event.known is not TrialState.UNKNOWN:
        return Transition(state, OF_TRIAL[event.known])
    return _safe(state)


def while_closed(state: RigState, event: SubmitEvent, now_s: float) -> Transition:
    """What the ledger knows of it; refused, if nothing."""
    if event.known is not TrialState.UNKNOWN:
        return Transition(state, OF_TRIAL[event.known])
    return closed(state, event, now_s)


def cancel_nothing(state: RigState, event: CancelEvent, now_s: float) -> Transition:  # noqa: ARG001
    """Nothing is under way: accepted."""
    return Transition(state)


def cancel(state: RigState, event: CancelEvent, now_s: float) -> Transition:  # noqa: ARG001  as above
    """The trial is stopped, if the lease is right and it is the one meant."""
    if not _owns(state, event.token):
        return _without_lease(state)
    if not _meant(state, event):
        return Transition(state)
    return _stopping(state, "stopped by its client")


def cancel_again(state: RigState, event: CancelEvent, now_s: float) -> Transition:  # noqa: ARG001  as above
    """As before: it is being stopped already."""
    return Transition(state) if _owns(state, event.token) else _without_lease(state)


def void(state: RigState, event: VoidEvent, now_s: float) -> Transition:  # noqa: ARG001  as above
    """A trial the ledger does not know is noted as one that must never run."""
    if event.known is not TrialState.UNKNOWN:
        return Transition(state, OF_TRIAL[event.known])
    if not _owns(state, event.token):
        return _without_lease(state)
    return Transition(state, ReplyCode.VOID, orders=(RigAction.TOMBSTONE,))


def void_while_taking(state: RigState, event: VoidEvent, now_s: float) -> Transition:
    """Busy, if it is the very trial being taken in; else as in any other mode."""
    if state.trial is not None and state.trial.trial_id == event.trial_id:
        return _busy(state)
    return void(state, event, now_s)


def apply(state: RigState, event: SetGainsEvent, now_s: float) -> Transition:  # noqa: ARG001  as above
    """Applied, if the lease is right."""
    if not _owns(state, event.token):
        return _without_lease(state)
    return Transition(state, orders=(RigAction.APPLY,))


def apply_later(state: RigState, event: SetGainsEvent, now_s: float) -> Transition:  # noqa: ARG001
    """Refused: a trial is under way."""
    return _busy(state) if _owns(state, event.token) else _without_lease(state)


def apply_never(state: RigState, event: SetGainsEvent, now_s: float) -> Transition:  # noqa: ARG001
    """Refused until cleared."""
    return _safe(state)


def estop(state: RigState, event: EstopEvent, now_s: float) -> Transition:  # noqa: ARG001  as above
    """To the safe state, and held there."""
    return Transition(
        state._replace(latched=state.latched or event.reason), orders=(RigAction.ESTOP,)
    )


def estop_trial(state: RigState, event: EstopEvent, now_s: float) -> Transition:  # noqa: ARG001  as above
    """The trial is stopped, the rig brought to its safe state and held there."""
    move = _stopping(state, f"emergency stop: {event.reason}")
    latched = move.state._replace(latched=state.latched or event.reason)
    return move._replace(state=latched, orders=(RigAction.ESTOP, *move.orders))


def clear(state: RigState, event: ClearEvent, now_s: float) -> Transition:  # noqa: ARG001  as above
    """The rig may be used again."""
    return Transition(state._replace(latched=""), orders=(RigAction.CLEAR,))


def clear_later(state: RigState, event: ClearEvent, now_s: float) -> Transition:  # noqa: ARG001  as above
    """Refused while a trial is under way."""
    return _busy(state)


def noted(state: RigState, event: Noted, now_s: float) -> Transition:  # noqa: ARG001  as above
    """The trial is in the ledger."""
    return Transition(_marked(state, begun=False))


def begin(state: RigState, event: Begin, now_s: float) -> Transition:  # noqa: ARG001  as above
    """The trial moves."""
    return Transition(_marked(state, begun=True))


def not_begun(state: RigState, event: Begin, now_s: float) -> Transition:  # noqa: ARG001  as above
    """The trial must not begin: it is being stopped."""
    why = "" if state.trial is None else state.trial.stopping
    return Transition(state, ReplyCode.REFUSED, why)


def end(state: RigState, event: End, now_s: float) -> Transition:  # noqa: ARG001  as above
    """The trial is over."""
    return Transition(state._replace(trial=None, ended=state.ended + 1))


def close(state: RigState, event: Close, now_s: float) -> Transition:  # noqa: ARG001  as above
    """Nothing is taken in any more."""
    return Transition(state._replace(closed=True, lease=None))


def close_trial(state: RigState, event: Close, now_s: float) -> Transition:  # noqa: ARG001  as above
    """The trial is stopped, and nothing is taken in any more."""
    return _stopping(state._replace(closed=True, lease=None), "the rig is being shut down")


def closed(state: RigState, event: Event, now_s: float) -> Transition:  # noqa: ARG001  as above
    """Refused: the rig is shutting down."""
    return Transition(state, ReplyCode.REFUSED, "the rig is being shut down")


def never(state: RigState, event: Event, now_s: float) -> Transition:  # noqa: ARG001  as above
    """Cannot be: an error."""
    raise ProtocolError(
        f"a rig that is {state.mode} cannot {type(event).__name__.lower()}; nothing was done"
    )


def _owns(state: RigState, token: str) -> bool:
    return state.lease is not None and state.lease.token == token


def _lives(state: RigState, now_s: float) -> bool:
    return state.lease is not None and now_s < state.lease.expires_at_s


def _meant(state: RigState, event: CancelEvent) -> bool:
    return state.trial is not None and event.trial_id in ("", state.trial.trial_id)


def _marked(state: RigState, *, begun: bool) -> RigState:
    """The trial in hand is in the ledger, and has begun or not."""
    trial = state.trial
    if trial is None:
        return state
    return state._replace(trial=trial._replace(noted=True, begun=begun))


def _stopping(state: RigState, why: str) -> Transition:
    """The trial in hand is told to stop; told again, the first reason stands."""
    trial = state.trial
    if trial is None or trial.stopping:
        return Transition(state)
    return Transition(state._replace(trial=trial._replace(stopping=why)), orders=(RigAction.STOP,))


def _held(lease: Lease) -> str:
    return f"the rig is held by {lease.holder}; wait until they let go of it, or ask them to"


def _without_lease(state: RigState) -> Transition:
    if state.lease is not None:
        return Transition(state, ReplyCode.HELD, _held(state.lease))
    return Transition(state, ReplyCode.NO_LEASE, "the lease has run out; ask for another")


def _busy(state: RigState) -> Transition:
    trial_id = "" if state.trial is None else state.trial.trial_id
    return Transition(
        state,
        ReplyCode.BUSY,
        f"the rig is busy with trial {trial_id}; wait until it has ended, or stop it",
    )


def _safe(state: RigState) -> Transition:
    return Transition(
        state,
        ReplyCode.SAFE,
        f"the rig is held in its safe state after an emergency stop ({state.latched}); "
        "see to the rig, then clear the stop",
    )
