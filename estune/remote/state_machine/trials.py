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

from collections.abc import Callable
from enum import StrEnum

from estune.errors import ProtocolError
from estune.support.state_table import IMPOSSIBLE, StateTable, TableRow, described


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


Transition = Callable[[TrialState], TrialState]


def stay(state: TrialState) -> TrialState:
    """Change nothing."""
    return state


def _become(following: TrialState) -> Transition:
    @described(f"It is {following}.")
    def become(_: TrialState) -> TrialState:
        return following

    return become


_UNKNOWN, _ACCEPTED, _RUNNING = (
    (TrialState.UNKNOWN,),
    (TrialState.ACCEPTED,),
    (TrialState.RUNNING,),
)

TABLE: StateTable[TrialEvent, TrialState, Transition] = StateTable(
    TrialState,
    {
        TrialEvent.SUBMIT: TableRow(stay, (_become(TrialState.ACCEPTED), _UNKNOWN)),
        TrialEvent.START: TableRow(IMPOSSIBLE, (_become(TrialState.RUNNING), _ACCEPTED)),
        TrialEvent.END: TableRow(IMPOSSIBLE, (_become(TrialState.ENDED), _ACCEPTED + _RUNNING)),
        TrialEvent.FAIL: TableRow(IMPOSSIBLE, (_become(TrialState.FAILED), _ACCEPTED + _RUNNING)),
        TrialEvent.VOID: TableRow(stay, (_become(TrialState.VOID), _UNKNOWN)),
        TrialEvent.BOOT: TableRow(
            stay,
            (_become(TrialState.NEVER_STARTED), _ACCEPTED),
            (_become(TrialState.INTERRUPTED), _RUNNING),
        ),
    },
)


def after(state: TrialState, event: TrialEvent) -> TrialState:
    """State of a trial id after an event.

    Raises:
        ProtocolError: the event is impossible in that state.
    """
    cell = TABLE.cell(event, state)
    if isinstance(cell, str):
        raise ProtocolError(f"a trial that is {state} cannot {event}; nothing was done")
    return cell(state)
