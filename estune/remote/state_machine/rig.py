"""What a rig does with each command: one lease, one trial at a time, a stop that latches.

A state is a value, and so is the time: `step(state, event, now_s)` gives the next state, the
answer, and the orders that whoever drives the rig must carry out. Each row of `TABLE` is an event,
each column a mode. A command that has no place in a mode is refused by its answer and changes
nothing; an event from within the rig that cannot be is an error and changes nothing.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from estune.remote.state_machine import transitions as do
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
from estune.remote.state_machine.state import Mode, RigState, Transition


def step(state: RigState, event: Event, now_s: float) -> Transition:
    """What a rig does with an event.

    A lease that has run out by then is ended first, whether or not anybody said that time passed.

    Args:
        state: Where the rig stands.
        event: What happens.
        now_s: When it happened, on a clock that never goes back, s.

    Raises:
        ProtocolError: the event comes from within the rig and cannot be now; nothing changes.
    """
    if state.lease is None or now_s < state.lease.expires_at_s:
        return TABLE[type(event)][state.mode](state, event, now_s)
    expired = TABLE[Expire][state.mode](state, Expire(), now_s)
    if isinstance(event, Expire):
        return expired
    after = expired.state
    move = TABLE[type(event)][after.mode](after, event, now_s)
    return move._replace(orders=expired.orders + move.orders)


Handler = Callable[[RigState, Event, float], Transition]


def _row(*handlers: Callable[..., Transition]) -> Mapping[Mode, Handler]:
    return MappingProxyType(dict(zip(Mode, handlers, strict=True)))


TABLE: Mapping[type[Event], Mapping[Mode, Handler]] = MappingProxyType(
    {
        # idle, leased, taking, accepted, running, aborting, safe, closed
        Acquire: _row(
            *(do.lease, do.lease, do.lease, do.lease, do.lease, do.lease, do.lease, do.closed),
        ),
        Renew: _row(
            *(do.renew, do.renew, do.renew, do.renew, do.renew, do.renew, do.renew, do.closed),
        ),
        Release: _row(
            *(
                do.release,
                do.release,
                do.release_and_stop,
                do.release_and_stop,
                do.release_and_stop,
            ),
            *(do.release, do.release, do.stay),
        ),
        Expire: _row(
            *(do.stay, do.expire, do.expire_and_stop, do.expire_and_stop, do.expire_and_stop),
            *(do.expire, do.expire, do.stay),
        ),
        SubmitEvent: _row(
            *(do.take_in, do.take_in, do.while_busy, do.while_busy, do.while_busy, do.while_busy),
            *(do.while_safe, do.while_closed),
        ),
        CancelEvent: _row(
            *(
                do.cancel_nothing,
                do.cancel_nothing,
                do.cancel,
                do.cancel,
                do.cancel,
                do.cancel_again,
            ),
            *(do.cancel_nothing, do.cancel_nothing),
        ),
        VoidEvent: _row(
            *(
                do.void,
                do.void,
                do.void_while_taking,
                do.void,
                do.void,
                do.void,
                do.void,
                do.closed,
            ),
        ),
        SetGainsEvent: _row(
            *(do.apply, do.apply, do.apply_later, do.apply_later, do.apply_later, do.apply_later),
            *(do.apply_never, do.closed),
        ),
        EstopEvent: _row(
            *(do.estop, do.estop, do.estop_trial, do.estop_trial, do.estop_trial, do.estop_trial),
            *(do.estop, do.estop),
        ),
        ClearEvent: _row(
            *(do.clear, do.clear, do.clear_later, do.clear_later, do.clear_later, do.clear_later),
            *(do.clear, do.closed),
        ),
        Noted: _row(
            *(do.never, do.never, do.noted, do.never, do.never, do.noted, do.never, do.never),
        ),
        Begin: _row(
            *(do.never, do.never, do.begin, do.begin, do.never, do.not_begun, do.never, do.never),
        ),
        End: _row(
            *(do.never, do.never, do.end, do.end, do.end, do.end, do.never, do.never),
        ),
        Close: _row(
            *(do.close, do.close, do.close_trial, do.close_trial, do.close_trial, do.close_trial),
            *(do.close, do.stay),
        ),
    }
)
"""Event by mode."""
