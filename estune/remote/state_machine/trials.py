"""States of one trial id in a rig's ledger.

::

                submit             start            end
      unknown ----------> accepted -------> running ------> ended
         |                   |  |              |  |
    void |              boot |  | fail    boot |  | fail
         v                   v  v              v  v
       void      never_started  failed  interrupted  failed

`end` straight from `accepted` is a trial that was stopped before it began. What is not drawn
changes nothing (`submit`, `void` and `boot` of a trial in the ledger) or is impossible (`start` of
a trial that has begun). So no id starts twice, however often and in whatever order messages come.
"""

from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType

from estune.errors import ProtocolError


class TrialState(StrEnum):
    """State of a trial id in a ledger."""

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
        """Whether no event changes it any more."""
        return self not in (TrialState.UNKNOWN, TrialState.ACCEPTED, TrialState.RUNNING)


class TrialEvent(StrEnum):
    """Event in the life of a trial id."""

    SUBMIT = "submit"
    START = "start"
    END = "end"
    FAIL = "fail"
    VOID = "void"
    BOOT = "boot"


_UNCHANGING = (TrialEvent.SUBMIT, TrialEvent.VOID, TrialEvent.BOOT)

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
        **{s: dict.fromkeys(_UNCHANGING, s) for s in TrialState if s.is_final},
    }
)
"""Next state by state and event; a missing event is impossible in that state."""


def after(state: TrialState, event: TrialEvent) -> TrialState:
    """State of a trial id after an event.

    Raises:
        ProtocolError: the event is impossible in that state.
    """
    try:
        return TABLE[state][event]
    except KeyError:
        raise ProtocolError(f"a trial that is {state} cannot {event}; nothing was done") from None
