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
from typing import Any

from estune.core.sentence_enum import SentenceEnum
from estune.errors import EstuneError, InvalidInput
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


class SupervisorEvent(StrEnum):
    """Input of the state machine: the rows of the table."""

    BOOT = "boot"
    FOUND = "found"
    INHERITED = "inherited"
    READIED = "readied"
    CHANGED = "changed"
    LOST = "lost"
    FAILED = "failed"
    TROUBLE = "trouble"
    UNSAFE = "unsafe"
    SEARCHED = "searched"
    PROPOSED = "proposed"
    ADOPTED = "adopted"
    KEPT = "kept"
    DRIFTED = "drifted"
    ENDED = "ended"
    ACCEPT = "accept"
    REJECT = "reject"
    REVERT = "revert"
    PAUSE = "pause"
    RESUME = "resume"
    STOP = "stop"


COMMANDS = (
    SupervisorEvent.ACCEPT,
    SupervisorEvent.REJECT,
    SupervisorEvent.REVERT,
    SupervisorEvent.PAUSE,
    SupervisorEvent.RESUME,
    SupervisorEvent.STOP,
)
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


def _set(sentence: str, **changes: Any) -> _Transition:
    """Transition that replaces these fields."""

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
_HOLD = _set("Hold the candidate until it is accepted or rejected.", goal=Goal.HOLD)
_WATCH = _set("Keep the nominal gains, and watch them.", goal=Goal.WATCH)
_TUNE = _set("Tune again.", goal=Goal.TUNE)
_NO_CANDIDATE = "there are no candidate gains to decide on"
_NOT_PAUSED = "it is not paused"

_STOPPING = (SupervisorMode.STOPPING,)
_ABSENT = (SupervisorMode.WAITING, SupervisorMode.RETRYING)
_ACTIVE = tuple(_MODE_OF_GOAL.values())
_RUNNING = (*_ABSENT, SupervisorMode.READYING, *_ACTIVE, SupervisorMode.PAUSED)


_RowOf = TableRow[SupervisorMode, _Transition]


def _row(*cells: tuple[tuple[SupervisorMode, ...], _Transition]) -> _RowOf:
    return TableRow(IMPOSSIBLE, *((cell, modes) for modes, cell in cells))


def _command(
    *cells: tuple[tuple[SupervisorMode, ...], _Transition | str],
    stopping: _Transition | str = "it is being stopped",
) -> _RowOf:
    others = ((cell, modes) for modes, cell in (*cells, (_STOPPING, stopping)))
    return TableRow("it has ended; start the daemon again", *others)


TABLE: StateTable[SupervisorEvent, SupervisorMode, _Transition] = StateTable(
    SupervisorMode,
    {
        SupervisorEvent.BOOT: _row((tuple(SupervisorMode), _boot)),
        SupervisorEvent.FOUND: _row(
            ((*_ABSENT, *_STOPPING), _set("Check the rig's gains.", link=RigLink.FOUND))
        ),
        # Another daemon had the rig before, and left it other gains.
        SupervisorEvent.INHERITED: _row(((SupervisorMode.READYING,), _inherit)),
        SupervisorEvent.READIED: _row(
            (
                (SupervisorMode.READYING,),
                _set("Go on with the goal.", link=RigLink.READY, failures=0, trouble=""),
            )
        ),
        # The rig runs other gains than the nominal ones: restarted, or changed by others.
        SupervisorEvent.CHANGED: _row((_ACTIVE, _check_gains)),
        SupervisorEvent.LOST: _row(((*_RUNNING, *_STOPPING), _failure(RigLink.AWAY))),
        SupervisorEvent.FAILED: _row(((*_RUNNING, *_STOPPING), _failure(RigLink.FAILED))),
        # Operator action is required. The rig keeps the nominal gains.
        SupervisorEvent.TROUBLE: _row((_RUNNING, _pause), (_STOPPING, _STAY)),
        # The nominal gains are no longer safe: the original ones are the best alternative.
        SupervisorEvent.UNSAFE: _row(
            ((SupervisorMode.TUNING, SupervisorMode.CONFIRMING, SupervisorMode.WATCHING), _revert),
        ),
        SupervisorEvent.SEARCHED: _row(
            ((SupervisorMode.TUNING,), _set("Confirm the best gains.", goal=Goal.CONFIRM)),
            ((SupervisorMode.CONFIRMING,), _STAY),
        ),
        SupervisorEvent.PROPOSED: _row(
            (
                (SupervisorMode.CONFIRMING,),
                _HOLD,
            )
        ),
        SupervisorEvent.ADOPTED: _row(((SupervisorMode.CONFIRMING,), _adopt)),
        SupervisorEvent.KEPT: _row(
            (
                (SupervisorMode.CONFIRMING,),
                _WATCH,
            )
        ),
        SupervisorEvent.DRIFTED: _row(((SupervisorMode.WATCHING,), _TUNE)),
        SupervisorEvent.ENDED: _row((_STOPPING, _end)),
        SupervisorEvent.ACCEPT: _command((_RUNNING, _accept)),
        SupervisorEvent.REJECT: _command((_RUNNING, _reject)),
        SupervisorEvent.REVERT: _command((_RUNNING, _revert)),
        SupervisorEvent.PAUSE: _command((_RUNNING, _pause_once)),
        SupervisorEvent.RESUME: _command(
            (_ABSENT, _resume),
            ((SupervisorMode.READYING, SupervisorMode.PAUSED), _resume_if_paused),
            (_ACTIVE, _NOT_PAUSED),
        ),
        SupervisorEvent.STOP: _command((_RUNNING, _stop), stopping=_STAY),
    },
)
