"""Pure state machine of one rig's supervision, without clock, rig or disk.

`SupervisorState.mode` says what the supervisor does now. `TABLE` has a row for each event and a
column for each mode. A command that a mode does not allow is refused with the reason and changes
nothing; any other event that it does not allow is an error of the program.

Only the nominal gains (field `home`) are ever made live. A candidate is measured in trials, after
which the rig restores its live gains even if the daemon dies. It becomes the nominal gains when it
is accepted. So at every instant the rig runs gains that the operator or the file has approved.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Self

from estune.core.sentence_enum import SentenceEnum
from estune.daemon.events import EventKind
from estune.errors import EstuneError, InvalidInput
from estune.remote.messages.daemon import DAEMON_VERBS
from estune.support.state_table import IMPOSSIBLE, StateTable, TableRow, described


class GainSet(StrEnum):
    """Name of a set of gains that the daemon stores for a rig."""

    ORIGINAL = "original"
    CANDIDATE = "candidate"
    ACCEPTED = "accepted"


class Goal(StrEnum):
    """Activity while the rig is ready and the supervision is not paused."""

    TUNE = "tune"
    CONFIRM = "confirm"
    HOLD = "hold"
    WATCH = "watch"


class RigLink(StrEnum):
    """State of the connection to the rig; ready once its live gains are the nominal ones."""

    AWAY = "away"
    FAILED = "failed"
    FOUND = "found"
    READY = "ready"


class Shutdown(StrEnum):
    """Whether the supervision is to end, or has ended."""

    NO = "no"
    STOPPING = "stopping"
    STOPPED = "stopped"


class SupervisorMode(SentenceEnum):
    """The supervisor's activities: the columns of the table, in this order."""

    WAITING = "waiting", "waiting for the rig"
    RETRYING = "retrying", "an operation failed; trying again after a while"
    READYING = "readying", "checking the rig's gains and applying the nominal ones"
    TUNING = "tuning", "searching for better gains by trials"
    CONFIRMING = "confirming", "repeating the initial and the best gains, interleaved"
    HOLDING = "holding", "better gains were found, and are not live: accept or reject them"
    WATCHING = "watching", "repeating check trials at intervals"
    PAUSED = "paused", "nothing is done until resume"
    STOPPING = "stopping", "restoring the nominal gains, then ending"
    STOPPED = "stopped", "ended"


_MODE_OF_GOAL = {
    Goal.TUNE: SupervisorMode.TUNING,
    Goal.CONFIRM: SupervisorMode.CONFIRMING,
    Goal.HOLD: SupervisorMode.HOLDING,
    Goal.WATCH: SupervisorMode.WATCHING,
}


@dataclass(frozen=True, slots=True)
class SupervisorState:
    """State of the supervision of one rig.

    Attributes:
        goal: Activity while the rig is ready.
        home: The nominal gains: live between trials and after the end.
        why: Why these.
        failures: Consecutive failures to reach or use the rig.
        trouble: Message of the last failure; empty once it is over.
        paused: Why the supervision is paused; empty if it is not.
    """

    goal: Goal = Goal.TUNE
    home: GainSet = GainSet.ORIGINAL
    why: str = "no others accepted yet"
    link: RigLink = RigLink.AWAY
    failures: int = 0
    trouble: str = ""
    paused: str = ""
    ending: Shutdown = Shutdown.NO

    @property
    def mode(self) -> SupervisorMode:
        """The supervisor's present activity: a column of the table."""
        if self.ending is Shutdown.STOPPED:
            return SupervisorMode.STOPPED
        if self.ending is Shutdown.STOPPING:
            return SupervisorMode.STOPPING
        if self.link is RigLink.AWAY:
            return SupervisorMode.WAITING
        if self.link is RigLink.FAILED:
            return SupervisorMode.RETRYING
        if self.link is RigLink.FOUND:
            return SupervisorMode.READYING
        return SupervisorMode.PAUSED if self.paused else _MODE_OF_GOAL[self.goal]


# A full disk must not keep a rig from being found lost, made safe or stopped. None of these events
# makes other gains than stored ones live, or claims that any were accepted.
_WITHOUT_DISK = "takes effect even if it cannot be written"


class SupervisorEvent(StrEnum):
    """Input of the state machine: the rows of the table.

    Attributes:
        kind: Its kind in the log, on the link and for hooks; None of one that is not told.
        needs_disk: Whether it takes effect only once it is written.
    """

    kind: EventKind | None
    needs_disk: bool

    def __new__(cls, value: str, kind: EventKind | None = None, disk: str = "") -> Self:
        """An event by its value, that of a command by its verb."""
        member = str.__new__(cls, value)
        member._value_ = value
        member.kind, member.needs_disk = kind, disk != _WITHOUT_DISK
        return member

    BOOT = "boot"
    FOUND = "found", EventKind.FOUND, _WITHOUT_DISK
    INHERITED = "inherited", EventKind.GAINS
    READIED = "readied", None, _WITHOUT_DISK
    CHANGED = "changed", EventKind.GAINS
    LOST = "lost", EventKind.LOST, _WITHOUT_DISK
    FAILED = "failed", EventKind.FAILED, _WITHOUT_DISK
    TROUBLE = "trouble", EventKind.TROUBLE, _WITHOUT_DISK
    UNSAFE = "unsafe", EventKind.UNSAFE, _WITHOUT_DISK
    SEARCHED = "searched", EventKind.CONFIRMING
    PROPOSED = "proposed", EventKind.BETTER
    ADOPTED = "adopted", EventKind.BETTER
    KEPT = "kept", EventKind.KEPT
    DRIFTED = "drifted", EventKind.DRIFTED
    ENDED = "ended", EventKind.STOPPED, _WITHOUT_DISK
    ACCEPT = "accept", EventKind.COMMAND
    REJECT = "reject", EventKind.COMMAND, _WITHOUT_DISK
    REVERT = "revert", EventKind.COMMAND, _WITHOUT_DISK
    PAUSE = "pause", EventKind.PAUSED, _WITHOUT_DISK
    RESUME = "resume", EventKind.RESUMED
    STOP = "stop", EventKind.STOPPING, _WITHOUT_DISK


COMMANDS = tuple(map(SupervisorEvent, DAEMON_VERBS))
"""Events that are verbs of the operator."""


class InvalidTransition(EstuneError):
    """Event that cannot occur in this mode: an error of the program."""


def next_state(
    state: SupervisorState, event: SupervisorEvent, reason: str = ""
) -> SupervisorState:
    """State after an event.

    Raises:
        InvalidInput: the command is not allowed in this state; nothing is changed.
        InvalidTransition: the event cannot occur in this state.
    """
    cell = TABLE.cell(event, state.mode)
    if isinstance(cell, str):
        if event in COMMANDS:
            raise InvalidInput(f"cannot {event}: {cell}")
        raise InvalidTransition(f"{event} while {state.mode}: {cell}")
    return cell(state, reason)


_Transition = Callable[[SupervisorState, str], SupervisorState]
_Row = TableRow[SupervisorMode, _Transition]


def _set(sentence: str, **changes: Any) -> _Transition:
    @described(sentence)
    def change(state: SupervisorState, _: str) -> SupervisorState:
        return replace(state, **changes)

    return change


def _boot(state: SupervisorState, _: str) -> SupervisorState:
    """Wait for the rig; a tuning under way continues from its journal."""
    # The result of a confirmation is not stored: its run is continued, and decided again.
    started = replace(_back_to_tuning(state), ending=Shutdown.NO)
    return replace(started, link=RigLink.AWAY, failures=0, trouble="")


def _failure(link: RigLink) -> _Transition:
    @described("Wait for the rig." if link is RigLink.AWAY else "Try again after a while.")
    def fail(state: SupervisorState, reason: str) -> SupervisorState:
        failures = state.failures + 1
        return replace(_back_to_tuning(state), link=link, failures=failures, trouble=reason)

    return fail


def _back_to_tuning(state: SupervisorState) -> SupervisorState:
    """An interrupted confirmation is continued from the run's own journal, by way of tuning."""
    return replace(state, goal=Goal.TUNE) if state.goal is Goal.CONFIRM else state


def _check_gains(state: SupervisorState, _: str = "") -> SupervisorState:
    """The live gains must be read, and replaced where they are not the nominal ones."""
    return replace(state, link=RigLink.FOUND) if state.link is RigLink.READY else state


def _pause(state: SupervisorState, reason: str) -> SupervisorState:
    """Pause, with the reason."""
    return replace(_back_to_tuning(state), paused=reason)


def _revert(state: SupervisorState, reason: str) -> SupervisorState:
    """Make the original gains the nominal ones, and pause."""
    original = replace(state, goal=Goal.TUNE, home=GainSet.ORIGINAL, why=reason, paused=reason)
    return _check_gains(original)


def _adopt(state: SupervisorState, reason: str) -> SupervisorState:
    """Make the candidate the nominal gains, and watch them."""
    return _check_gains(replace(state, goal=Goal.WATCH, home=GainSet.ACCEPTED, why=reason))


def _inherit(state: SupervisorState, reason: str) -> SupervisorState:
    """Watch the gains that another daemon had accepted."""
    return replace(state, goal=Goal.WATCH, home=GainSet.ACCEPTED, why=reason)


def _accept(state: SupervisorState, reason: str) -> SupervisorState:
    """Make the candidate the nominal gains, if there is one."""
    if state.goal is not Goal.HOLD:
        raise InvalidInput(f"cannot accept: {_NO_CANDIDATE}")
    return _adopt(state, reason)


def _reject(state: SupervisorState, _: str) -> SupervisorState:
    """Drop the candidate, if there is one, and watch the nominal gains."""
    if state.goal is not Goal.HOLD:
        raise InvalidInput(f"cannot reject: {_NO_CANDIDATE}")
    return replace(state, goal=Goal.WATCH)


def _pause_once(state: SupervisorState, reason: str) -> SupervisorState:
    """Pause, if it is not paused."""
    if state.paused:
        raise InvalidInput(f"cannot pause: it is paused already ({state.paused})")
    return _pause(state, reason)


def _resume(state: SupervisorState, _: str) -> SupervisorState:
    """Continue, after a check of the rig's gains."""
    # Others may have changed the rig's gains meanwhile.
    return _check_gains(replace(state, paused="", failures=0))


def _resume_if_paused(state: SupervisorState, reason: str) -> SupervisorState:
    """Continue, if it is paused."""
    if not state.paused:
        raise InvalidInput(f"cannot resume: {_NOT_PAUSED}")
    return _resume(state, reason)


def _stop(state: SupervisorState, reason: str) -> SupervisorState:
    """Restore the nominal gains, then end."""
    stays = state.home is GainSet.ACCEPTED
    gains = "the accepted gains stay" if stays else "the rig's own gains are restored"
    return replace(_back_to_tuning(state), ending=Shutdown.STOPPING, why=f"{reason}; {gains}")


def _end(state: SupervisorState, reason: str) -> SupervisorState:
    """End."""
    return replace(state, ending=Shutdown.STOPPED, trouble=reason)


_STAY = _set("Change nothing.")
_NO_CANDIDATE = "there are no candidate gains to decide on"
_NOT_PAUSED = "it is not paused"
_BEING_STOPPED = "it is being stopped"
_HAS_ENDED = "it has ended; start the daemon again"

_STOPPING, _STOPPED = (SupervisorMode.STOPPING,), (SupervisorMode.STOPPED,)
_TUNING, _CONFIRMING = (SupervisorMode.TUNING,), (SupervisorMode.CONFIRMING,)
_READYING, _WATCHING = (SupervisorMode.READYING,), (SupervisorMode.WATCHING,)
_ABSENT = (SupervisorMode.WAITING, SupervisorMode.RETRYING)
_ACTIVE = tuple(_MODE_OF_GOAL.values())
_RUNNING = (*_ABSENT, *_READYING, *_ACTIVE, SupervisorMode.PAUSED)


def _command(running: _Transition, stopping: _Transition | str = _BEING_STOPPED) -> _Row:
    return TableRow(_HAS_ENDED, (running, _RUNNING), (stopping, _STOPPING))


TABLE: StateTable[SupervisorEvent, SupervisorMode, _Transition] = StateTable(
    SupervisorMode,
    {
        SupervisorEvent.BOOT: TableRow(_boot),
        SupervisorEvent.FOUND: TableRow(
            IMPOSSIBLE,
            (_set("Check the rig's gains.", link=RigLink.FOUND), (*_ABSENT, *_STOPPING)),
        ),
        # Another daemon had the rig before, and left it other gains.
        SupervisorEvent.INHERITED: TableRow(IMPOSSIBLE, (_inherit, _READYING)),
        SupervisorEvent.READIED: TableRow(
            IMPOSSIBLE,
            (
                _set("Go on with the goal.", link=RigLink.READY, failures=0, trouble=""),
                _READYING,
            ),
        ),
        # The rig runs other gains than the nominal ones: restarted, or changed by others.
        SupervisorEvent.CHANGED: TableRow(IMPOSSIBLE, (_check_gains, _ACTIVE)),
        SupervisorEvent.LOST: TableRow(_failure(RigLink.AWAY), (IMPOSSIBLE, _STOPPED)),
        SupervisorEvent.FAILED: TableRow(_failure(RigLink.FAILED), (IMPOSSIBLE, _STOPPED)),
        # Operator action is required. The rig keeps the nominal gains.
        SupervisorEvent.TROUBLE: TableRow(IMPOSSIBLE, (_pause, _RUNNING), (_STAY, _STOPPING)),
        # The nominal gains are no longer safe: the original ones are the best alternative.
        SupervisorEvent.UNSAFE: TableRow(
            IMPOSSIBLE, (_revert, (*_TUNING, *_CONFIRMING, *_WATCHING))
        ),
        SupervisorEvent.SEARCHED: TableRow(
            IMPOSSIBLE,
            (_set("Confirm the best gains.", goal=Goal.CONFIRM), _TUNING),
            (_STAY, _CONFIRMING),
        ),
        SupervisorEvent.PROPOSED: TableRow(
            IMPOSSIBLE,
            (
                _set("Hold the candidate until it is accepted or rejected.", goal=Goal.HOLD),
                _CONFIRMING,
            ),
        ),
        SupervisorEvent.ADOPTED: TableRow(IMPOSSIBLE, (_adopt, _CONFIRMING)),
        SupervisorEvent.KEPT: TableRow(
            IMPOSSIBLE,
            (_set("Keep the nominal gains, and watch them.", goal=Goal.WATCH), _CONFIRMING),
        ),
        SupervisorEvent.DRIFTED: TableRow(
            IMPOSSIBLE, (_set("Tune again.", goal=Goal.TUNE), _WATCHING)
        ),
        SupervisorEvent.ENDED: TableRow(IMPOSSIBLE, (_end, _STOPPING)),
        SupervisorEvent.ACCEPT: _command(_accept),
        SupervisorEvent.REJECT: _command(_reject),
        SupervisorEvent.REVERT: _command(_revert),
        SupervisorEvent.PAUSE: _command(_pause_once),
        SupervisorEvent.RESUME: TableRow(
            _HAS_ENDED,
            (_resume, _ABSENT),
            (_resume_if_paused, (*_READYING, SupervisorMode.PAUSED)),
            (_NOT_PAUSED, _ACTIVE),
            (_BEING_STOPPED, _STOPPING),
        ),
        SupervisorEvent.STOP: _command(_stop, stopping=_STAY),
    },
)
