"""How events of the supervision are told, and which take effect without the disk."""

from estune.daemon.events import EventKind
from estune.daemon.supervisor_state import SupervisorEvent

KINDS = {
    SupervisorEvent.FOUND: EventKind.FOUND,
    SupervisorEvent.INHERITED: EventKind.GAINS,
    SupervisorEvent.CHANGED: EventKind.GAINS,
    SupervisorEvent.LOST: EventKind.LOST,
    SupervisorEvent.FAILED: EventKind.FAILED,
    SupervisorEvent.TROUBLE: EventKind.TROUBLE,
    SupervisorEvent.UNSAFE: EventKind.UNSAFE,
    SupervisorEvent.SEARCHED: EventKind.CONFIRMING,
    SupervisorEvent.PROPOSED: EventKind.BETTER,
    SupervisorEvent.ADOPTED: EventKind.BETTER,
    SupervisorEvent.KEPT: EventKind.KEPT,
    SupervisorEvent.DRIFTED: EventKind.DRIFTED,
    SupervisorEvent.ENDED: EventKind.STOPPED,
    SupervisorEvent.ACCEPT: EventKind.COMMAND,
    SupervisorEvent.REJECT: EventKind.COMMAND,
    SupervisorEvent.REVERT: EventKind.COMMAND,
    SupervisorEvent.PAUSE: EventKind.PAUSED,
    SupervisorEvent.RESUME: EventKind.RESUMED,
    SupervisorEvent.STOP: EventKind.STOPPING,
}
"""Kinds of the events that change the state, as others see them; those not here are not logged."""

REPEATED = (SupervisorEvent.LOST, SupervisorEvent.FAILED, SupervisorEvent.TROUBLE)
"""Events that are logged once while their message stays the same."""

WITHOUT_DISK = frozenset(
    {
        SupervisorEvent.FOUND,
        SupervisorEvent.READIED,
        *REPEATED,
        SupervisorEvent.UNSAFE,
        SupervisorEvent.REJECT,
        SupervisorEvent.REVERT,
        SupervisorEvent.PAUSE,
        SupervisorEvent.STOP,
        SupervisorEvent.ENDED,
    }
)
"""Events that take effect even if they cannot be written: none makes other gains than stored ones
live, or claims that any were accepted."""
