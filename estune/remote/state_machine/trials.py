"""The life of one trial id, as a rig's ledger knows it.

::

                submit             start            end
      unknown ----------> accepted -------> running ------> ended
         |                   |  |              |  |
    void |              boot |  | fail    boot |  | fail
         v                   v  v              v  v
       void      never_started  failed  interrupted  failed

`end` straight from `accepted` is a trial that was stopped before it began. What is not drawn
changes nothing (`submit`, `void` and `boot` of a trial that is known) or cannot be (`start` of a
trial that has begun). So no id begins twice, however often a message comes, and in what order.
"""

from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType

from estune.errors import ProtocolError


class TrialState(StrEnum):
    """What a ledger knows of a trial id."""

    UNKNOWN = "unknown"
    ACCEPTED = "accepted"
    RUNNING = "running"
    ENDED = "ended"
    FAILED = "failed"
    NEVER_STARTED = "never_started"
    INTERRUPTED = "interrupted"
    VOID = "void"

    @property
    def is_final(self) -> bool:
        """Whether nothing will change it any more."""
        return self not in (TrialState.UNKNOWN, TrialState.ACCEPTED, TrialState.RUNNING)

    @property
    def may_have_moved(self) -> bool:
        """Whether the trial may have moved the rig."""
        return self in (
            *(TrialState.RUNNING, TrialState.ENDED),
            *(TrialState.FAILED, TrialState.INTERRUPTED),
        )


class TrialEvent(StrEnum):
    """What happens to a trial id."""

    SUBMIT = "submit"
    START = "start"
    END = "end"
    FAIL = "fail"
    VOID = "void"
    BOOT = "boot"


def _stays(state: TrialState) -> Mapping[TrialEvent, TrialState]:
    return dict.fromkeys((TrialEvent.SUBMIT, TrialEvent.VOID, TrialEvent.BOOT), state)


TABLE: Mapping[TrialState, Mapping[TrialEvent, TrialState]] = MappingProxyType(
    {
        TrialState.UNKNOWN: {
            TrialEvent.SUBMIT: TrialState.ACCEPTED,
            TrialEvent.VOID: TrialState.VOID,
            TrialEvent.BOOT: TrialState.UNKNOWN,
        },
        TrialState.ACCEPTED: {
            TrialEvent.SUBMIT: TrialState.ACCEPTED,
            TrialEvent.START: TrialState.RUNNING,
            TrialEvent.END: TrialState.ENDED,
            TrialEvent.FAIL: TrialState.FAILED,
            TrialEvent.VOID: TrialState.ACCEPTED,
            TrialEvent.BOOT: TrialState.NEVER_STARTED,
        },
        TrialState.RUNNING: {
            TrialEvent.SUBMIT: TrialState.RUNNING,
            TrialEvent.END: TrialState.ENDED,
            TrialEvent.FAIL: TrialState.FAILED,
            TrialEvent.VOID: TrialState.RUNNING,
            TrialEvent.BOOT: TrialState.INTERRUPTED,
        },
        **{state: _stays(state) for state in TrialState if state.is_final},
    }
)
"""State by event; an event that is missing cannot happen in that state."""


def after(state: TrialState, event: TrialEvent) -> TrialState:
    """The state of a trial id after an event.

    Raises:
        ProtocolError: the event cannot happen in that state.
    """
    try:
        return TABLE[state][event]
    except KeyError:
        raise ProtocolError(f"a trial that is {state} cannot {event}; nothing was done") from None
