"""What the supervision of one rig does at each event: a table, without clock, rig or disk.

The state is a value. `mode` follows from it: what the keeper has to do now. Each row of `TABLE` is
an event, each column a mode. A command without a place in a mode is refused in words and changes
nothing; an event from within that has none is an error.

Only the home gains are ever put on the rig. A candidate is measured in trials, which put them back
whatever becomes of the daemon, and stays off the rig until it is accepted, which makes it the home
set. So whenever the daemon is killed, the rig runs gains that somebody or the file agreed to.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from types import MappingProxyType

from estune.errors import EstuneError, InvalidInput


class GainSet(StrEnum):
    """The gains a daemon knows for a rig."""

    ORIGINAL = "original"
    CANDIDATE = "candidate"
    ACCEPTED = "accepted"


class Goal(StrEnum):
    """What is to be done with the rig when nothing stands in the way."""

    TUNE = "tune"
    CONFIRM = "confirm"
    HOLD = "hold"
    WATCH = "watch"


class Link(StrEnum):
    """How it stands with the rig."""

    AWAY = "away"
    FAILED = "failed"
    FOUND = "found"
    READY = "ready"


class Shutdown(StrEnum):
    """Whether the supervision is to end."""

    NO = "no"
    STOPPING = "stopping"
    STOPPED = "stopped"


class SupervisorMode(StrEnum):
    """What is done now. The columns of the table, in this order."""

    WAITING = "waiting"
    RETRYING = "retrying"
    READYING = "readying"
    TUNING = "tuning"
    CONFIRMING = "confirming"
    HOLDING = "holding"
    WATCHING = "watching"
    PAUSED = "paused"
    STOPPING = "stopping"
    STOPPED = "stopped"

    @property
    def sentence(self) -> str:
        """The mode in words."""
        return _MODES[self]


_MODES = {
    SupervisorMode.WAITING: "waiting for the rig",
    SupervisorMode.RETRYING: "something has failed; trying again after a while",
    SupervisorMode.READYING: "looking which gains the rig runs, and putting the right ones on it",
    SupervisorMode.TUNING: "looking for better gains by trials",
    SupervisorMode.CONFIRMING: "repeating the start and the best gains found in turn",
    SupervisorMode.HOLDING: "better gains were found, and are not live: accept or reject them",
    SupervisorMode.WATCHING: "repeating check trials from time to time",
    SupervisorMode.PAUSED: "nothing is done until it is resumed",
    SupervisorMode.STOPPING: "putting the rig's gains back, then ending",
    SupervisorMode.STOPPED: "ended",
}
_OF_GOAL = {
    Goal.TUNE: SupervisorMode.TUNING,
    Goal.CONFIRM: SupervisorMode.CONFIRMING,
    Goal.HOLD: SupervisorMode.HOLDING,
    Goal.WATCH: SupervisorMode.WATCHING,
}


@dataclass(frozen=True, slots=True)
class SupervisorState:
    """Where the supervision of a rig stands.

    Attributes:
        goal: What is to be done.
        home: The gains that are to be live between trials, and after the end.
        why: Why these.
        link: How it stands with the rig.
        failures: How often in a row the rig was not reached, or something failed.
        trouble: What the last of them was; empty once it is over.
        paused: Why nothing is done; empty if it is not paused.
        ending: Whether it is to end.
    """

    goal: Goal = Goal.TUNE
    home: GainSet = GainSet.ORIGINAL
    why: str = "nothing else was accepted yet"
    link: Link = Link.AWAY
    failures: int = 0
    trouble: str = ""
    paused: str = ""
    ending: Shutdown = Shutdown.NO

    @property
    def mode(self) -> SupervisorMode:
        """What is done now: a column of the table."""
        if self.ending is not Shutdown.NO:
            return (
                SupervisorMode.STOPPED
                if self.ending is Shutdown.STOPPED
                else SupervisorMode.STOPPING
            )
        if self.link is Link.AWAY:
            return SupervisorMode.WAITING
        if self.link is Link.FAILED:
            return SupervisorMode.RETRYING
        if self.link is Link.FOUND:
            return SupervisorMode.READYING
        return SupervisorMode.PAUSED if self.paused else _OF_GOAL[self.goal]


class SupervisorEvent(StrEnum):
    """What can happen. The rows of the table."""

    BOOT = "boot"
    FOUND = "found"
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
"""The verbs."""


class InvalidTransition(EstuneError):
    """An event that cannot be in this mode: a fault in the program."""


def next_state(
    life: SupervisorState, happening: SupervisorEvent, words: str = ""
) -> SupervisorState:
    """The state after an event.

    Args:
        life: Where it stood.
        happening: What has happened.
        words: Why, or who says so.

    Raises:
        InvalidInput: a command has no place here; nothing is changed.
        Impossible: an event cannot be here.
    """
    cell = TABLE[happening][life.mode]
    if isinstance(cell, str):
        if happening in COMMANDS:
            raise InvalidInput(f"cannot {happening}: {cell}")
        raise InvalidTransition(f"{happening} while {life.mode}: {cell}")
    return cell(life, words)


_Cell = Callable[[SupervisorState, str], SupervisorState] | str


def _boot(life: SupervisorState, _: str) -> SupervisorState:
    """The process has been started: whatever it was doing, it goes on with that."""
    return replace(
        life,
        link=Link.AWAY,
        failures=0,
        trouble="",
        ending=Shutdown.NO,
        # What was found is not taken over by a start: a search that was confirmed is decided anew.
        goal=Goal.TUNE if life.goal is Goal.CONFIRM else life.goal,
    )


def _found(life: SupervisorState, _: str) -> SupervisorState:
    return replace(life, link=Link.FOUND)


def _readied(life: SupervisorState, _: str) -> SupervisorState:
    return replace(life, link=Link.READY, failures=0, trouble="")


def _lost(life: SupervisorState, words: str) -> SupervisorState:
    return replace(_back(life), link=Link.AWAY, failures=life.failures + 1, trouble=words)


def _failed(life: SupervisorState, words: str) -> SupervisorState:
    return replace(_back(life), link=Link.FAILED, failures=life.failures + 1, trouble=words)


def _back(life: SupervisorState) -> SupervisorState:
    """A confirmation that is cut off is taken up from the run's own journal, by way of tuning."""
    return replace(life, goal=Goal.TUNE) if life.goal is Goal.CONFIRM else life


def _trouble(life: SupervisorState, words: str) -> SupervisorState:
    """Somebody must see to it. The rig keeps the home gains."""
    return replace(_back(life), paused=words)


def _unsafe(life: SupervisorState, words: str) -> SupervisorState:
    """The home gains are no longer safe: the original ones are the best that is known."""
    return replace(_reverted(life, words), paused=words)


def _reverted(life: SupervisorState, words: str) -> SupervisorState:
    return _unsettled(replace(life, goal=Goal.TUNE, home=GainSet.ORIGINAL, why=words))


def _unsettled(life: SupervisorState) -> SupervisorState:
    """What is live must be looked at, and changed where it is not the home gains."""
    return replace(life, link=Link.FOUND) if life.link is Link.READY else life


def _changed(life: SupervisorState, _: str) -> SupervisorState:
    return _unsettled(life)


def _searched(life: SupervisorState, _: str) -> SupervisorState:
    return replace(life, goal=Goal.CONFIRM)


def _proposed(life: SupervisorState, _: str) -> SupervisorState:
    return replace(life, goal=Goal.HOLD)


def _adopted(life: SupervisorState, words: str) -> SupervisorState:
    return _unsettled(replace(life, goal=Goal.WATCH, home=GainSet.ACCEPTED, why=words))


def _kept(life: SupervisorState, _: str) -> SupervisorState:
    return replace(life, goal=Goal.WATCH)


def _drifted(life: SupervisorState, _: str) -> SupervisorState:
    return replace(life, goal=Goal.TUNE)


def _accept(life: SupervisorState, words: str) -> SupervisorState:
    if life.goal is not Goal.HOLD:
        raise InvalidInput(f"cannot accept: {_NO_CANDIDATE}")
    return _adopted(life, words)


def _reject(life: SupervisorState, _: str) -> SupervisorState:
    if life.goal is not Goal.HOLD:
        raise InvalidInput(f"cannot reject: {_NO_CANDIDATE}")
    return replace(life, goal=Goal.WATCH)


def _revert(life: SupervisorState, words: str) -> SupervisorState:
    return replace(_reverted(life, words), paused=words)


def _pause(life: SupervisorState, words: str) -> SupervisorState:
    if life.paused:
        raise InvalidInput(f"cannot pause: {_PAUSED} ({life.paused})")
    return replace(_back(life), paused=words)


def _resume(life: SupervisorState, _: str) -> SupervisorState:
    """Goes on at once; the rig may have been used by hand meanwhile."""
    return _unsettled(replace(life, paused="", failures=0))


def _resume_if_paused(life: SupervisorState, words: str) -> SupervisorState:
    if not life.paused:
        raise InvalidInput(f"cannot resume: {_NOT_PAUSED}")
    return _resume(life, words)


def _stop(life: SupervisorState, words: str) -> SupervisorState:
    return replace(_back(life), ending=Shutdown.STOPPING, why=f"{words}; {_HOME[life.home]}")


def _ended(life: SupervisorState, words: str) -> SupervisorState:
    return replace(life, ending=Shutdown.STOPPED, trouble=words)


def _same(life: SupervisorState, _: str) -> SupervisorState:
    return life


_NO_CANDIDATE = "there are no candidate gains to decide on"
_PAUSED = "it is paused already"
_NOT_PAUSED = "it is not paused"
_ENDING = "it is being stopped"
_ENDED = "it has ended; start the daemon again"
_HOME = {
    GainSet.ORIGINAL: "the rig's own gains are put back",
    GainSet.ACCEPTED: "the accepted gains stay",
}

_ABSENT = (SupervisorMode.WAITING, SupervisorMode.RETRYING)
_DOING = (
    SupervisorMode.TUNING,
    SupervisorMode.CONFIRMING,
    SupervisorMode.HOLDING,
    SupervisorMode.WATCHING,
)
_THERE = (SupervisorMode.READYING, *_DOING, SupervisorMode.PAUSED)
_ALIVE = (*_ABSENT, *_THERE)


def _row(
    *cells: tuple[tuple[SupervisorMode, ...], _Cell], otherwise: str = "cannot be"
) -> Mapping[SupervisorMode, _Cell]:
    row: dict[SupervisorMode, _Cell] = dict.fromkeys(SupervisorMode, otherwise)
    for modes, cell in cells:
        row |= dict.fromkeys(modes, cell)
    return MappingProxyType(row)


_COMMAND_ENDS: tuple[tuple[tuple[SupervisorMode, ...], _Cell], ...] = (
    ((SupervisorMode.STOPPING,), _ENDING),
    ((SupervisorMode.STOPPED,), _ENDED),
)

TABLE: Mapping[SupervisorEvent, Mapping[SupervisorMode, _Cell]] = MappingProxyType(
    {
        SupervisorEvent.BOOT: _row((tuple(SupervisorMode), _boot)),
        SupervisorEvent.FOUND: _row((_ABSENT, _found), ((SupervisorMode.STOPPING,), _found)),
        SupervisorEvent.READIED: _row(((SupervisorMode.READYING,), _readied)),
        # The rig runs other gains than it should: it was restarted, or somebody changed them.
        SupervisorEvent.CHANGED: _row((_DOING, _changed)),
        SupervisorEvent.LOST: _row((_ALIVE, _lost), ((SupervisorMode.STOPPING,), _lost)),
        SupervisorEvent.FAILED: _row((_ALIVE, _failed), ((SupervisorMode.STOPPING,), _failed)),
        SupervisorEvent.TROUBLE: _row((_ALIVE, _trouble), ((SupervisorMode.STOPPING,), _same)),
        SupervisorEvent.UNSAFE: _row(
            ((SupervisorMode.TUNING, SupervisorMode.CONFIRMING, SupervisorMode.WATCHING), _unsafe),
        ),
        SupervisorEvent.SEARCHED: _row(
            ((SupervisorMode.TUNING,), _searched), ((SupervisorMode.CONFIRMING,), _same)
        ),
        SupervisorEvent.PROPOSED: _row(((SupervisorMode.CONFIRMING,), _proposed)),
        SupervisorEvent.ADOPTED: _row(((SupervisorMode.CONFIRMING,), _adopted)),
        SupervisorEvent.KEPT: _row(((SupervisorMode.CONFIRMING,), _kept)),
        SupervisorEvent.DRIFTED: _row(((SupervisorMode.WATCHING,), _drifted)),
        SupervisorEvent.ENDED: _row(((SupervisorMode.STOPPING,), _ended)),
        SupervisorEvent.ACCEPT: _row((_ALIVE, _accept), *_COMMAND_ENDS),
        SupervisorEvent.REJECT: _row((_ALIVE, _reject), *_COMMAND_ENDS),
        SupervisorEvent.REVERT: _row((_ALIVE, _revert), *_COMMAND_ENDS),
        SupervisorEvent.PAUSE: _row((_ALIVE, _pause), *_COMMAND_ENDS),
        SupervisorEvent.RESUME: _row(
            (_ABSENT, _resume),
            ((SupervisorMode.READYING, SupervisorMode.PAUSED), _resume_if_paused),
            (_DOING, _NOT_PAUSED),
            *_COMMAND_ENDS,
        ),
        SupervisorEvent.STOP: _row(
            (_ALIVE, _stop),
            ((SupervisorMode.STOPPING,), _same),
            ((SupervisorMode.STOPPED,), _ENDED),
        ),
    }
)
