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


class Ending(StrEnum):
    """Whether the supervision is to end."""

    NO = "no"
    STOPPING = "stopping"
    STOPPED = "stopped"


class Mode(StrEnum):
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
    Mode.WAITING: "waiting for the rig",
    Mode.RETRYING: "something has failed; trying again after a while",
    Mode.READYING: "looking which gains the rig runs, and putting the right ones on it",
    Mode.TUNING: "looking for better gains by trials",
    Mode.CONFIRMING: "repeating the start and the best gains found in turn",
    Mode.HOLDING: "better gains were found, and are not live: accept or reject them",
    Mode.WATCHING: "repeating check trials from time to time",
    Mode.PAUSED: "nothing is done until it is resumed",
    Mode.STOPPING: "putting the rig's gains back, then ending",
    Mode.STOPPED: "ended",
}
_OF_GOAL = {
    Goal.TUNE: Mode.TUNING,
    Goal.CONFIRM: Mode.CONFIRMING,
    Goal.HOLD: Mode.HOLDING,
    Goal.WATCH: Mode.WATCHING,
}


@dataclass(frozen=True, slots=True)
class Life:
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
    ending: Ending = Ending.NO

    @property
    def mode(self) -> Mode:
        """What is done now: a column of the table."""
        if self.ending is not Ending.NO:
            return Mode.STOPPED if self.ending is Ending.STOPPED else Mode.STOPPING
        if self.link is Link.AWAY:
            return Mode.WAITING
        if self.link is Link.FAILED:
            return Mode.RETRYING
        if self.link is Link.FOUND:
            return Mode.READYING
        return Mode.PAUSED if self.paused else _OF_GOAL[self.goal]


class Happening(StrEnum):
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
    Happening.ACCEPT,
    Happening.REJECT,
    Happening.REVERT,
    Happening.PAUSE,
    Happening.RESUME,
    Happening.STOP,
)
"""The verbs."""


class Impossible(EstuneError):
    """An event that cannot be in this mode: a fault in the program."""


def step(life: Life, happening: Happening, words: str = "") -> Life:
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
        raise Impossible(f"{happening} while {life.mode}: {cell}")
    return cell(life, words)


_Cell = Callable[[Life, str], Life] | str


def _boot(life: Life, _: str) -> Life:
    """The process has been started: whatever it was doing, it goes on with that."""
    return replace(
        life,
        link=Link.AWAY,
        failures=0,
        trouble="",
        ending=Ending.NO,
        # What was found is not taken over by a start: a search that was confirmed is decided anew.
        goal=Goal.TUNE if life.goal is Goal.CONFIRM else life.goal,
    )


def _found(life: Life, _: str) -> Life:
    return replace(life, link=Link.FOUND)


def _readied(life: Life, _: str) -> Life:
    return replace(life, link=Link.READY, failures=0, trouble="")


def _lost(life: Life, words: str) -> Life:
    return replace(_back(life), link=Link.AWAY, failures=life.failures + 1, trouble=words)


def _failed(life: Life, words: str) -> Life:
    return replace(_back(life), link=Link.FAILED, failures=life.failures + 1, trouble=words)


def _back(life: Life) -> Life:
    """A confirmation that is cut off is taken up from the run's own journal, by way of tuning."""
    return replace(life, goal=Goal.TUNE) if life.goal is Goal.CONFIRM else life


def _trouble(life: Life, words: str) -> Life:
    """Somebody must see to it. The rig keeps the home gains."""
    return replace(_back(life), paused=words)


def _unsafe(life: Life, words: str) -> Life:
    """The home gains are no longer safe: the original ones are the best that is known."""
    return replace(_reverted(life, words), paused=words)


def _reverted(life: Life, words: str) -> Life:
    return _unsettled(replace(life, goal=Goal.TUNE, home=GainSet.ORIGINAL, why=words))


def _unsettled(life: Life) -> Life:
    """What is live must be looked at, and changed where it is not the home gains."""
    return replace(life, link=Link.FOUND) if life.link is Link.READY else life


def _changed(life: Life, _: str) -> Life:
    return _unsettled(life)


def _searched(life: Life, _: str) -> Life:
    return replace(life, goal=Goal.CONFIRM)


def _proposed(life: Life, _: str) -> Life:
    return replace(life, goal=Goal.HOLD)


def _adopted(life: Life, words: str) -> Life:
    return _unsettled(replace(life, goal=Goal.WATCH, home=GainSet.ACCEPTED, why=words))


def _kept(life: Life, _: str) -> Life:
    return replace(life, goal=Goal.WATCH)


def _drifted(life: Life, _: str) -> Life:
    return replace(life, goal=Goal.TUNE)


def _accept(life: Life, words: str) -> Life:
    if life.goal is not Goal.HOLD:
        raise InvalidInput(f"cannot accept: {_NO_CANDIDATE}")
    return _adopted(life, words)


def _reject(life: Life, _: str) -> Life:
    if life.goal is not Goal.HOLD:
        raise InvalidInput(f"cannot reject: {_NO_CANDIDATE}")
    return replace(life, goal=Goal.WATCH)


def _revert(life: Life, words: str) -> Life:
    return replace(_reverted(life, words), paused=words)


def _pause(life: Life, words: str) -> Life:
    if life.paused:
        raise InvalidInput(f"cannot pause: {_PAUSED} ({life.paused})")
    return replace(_back(life), paused=words)


def _resume(life: Life, _: str) -> Life:
    """Goes on at once; the rig may have been used by hand meanwhile."""
    return _unsettled(replace(life, paused="", failures=0))


def _resume_if_paused(life: Life, words: str) -> Life:
    if not life.paused:
        raise InvalidInput(f"cannot resume: {_NOT_PAUSED}")
    return _resume(life, words)


def _stop(life: Life, words: str) -> Life:
    return replace(_back(life), ending=Ending.STOPPING, why=f"{words}; {_HOME[life.home]}")


def _ended(life: Life, words: str) -> Life:
    return replace(life, ending=Ending.STOPPED, trouble=words)


def _same(life: Life, _: str) -> Life:
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

_ABSENT = (Mode.WAITING, Mode.RETRYING)
_DOING = (Mode.TUNING, Mode.CONFIRMING, Mode.HOLDING, Mode.WATCHING)
_THERE = (Mode.READYING, *_DOING, Mode.PAUSED)
_ALIVE = (*_ABSENT, *_THERE)


def _row(
    *cells: tuple[tuple[Mode, ...], _Cell], otherwise: str = "cannot be"
) -> Mapping[Mode, _Cell]:
    row: dict[Mode, _Cell] = dict.fromkeys(Mode, otherwise)
    for modes, cell in cells:
        row |= dict.fromkeys(modes, cell)
    return MappingProxyType(row)


_COMMAND_ENDS: tuple[tuple[tuple[Mode, ...], _Cell], ...] = (
    ((Mode.STOPPING,), _ENDING),
    ((Mode.STOPPED,), _ENDED),
)

TABLE: Mapping[Happening, Mapping[Mode, _Cell]] = MappingProxyType(
    {
        Happening.BOOT: _row((tuple(Mode), _boot)),
        Happening.FOUND: _row((_ABSENT, _found), ((Mode.STOPPING,), _found)),
        Happening.READIED: _row(((Mode.READYING,), _readied)),
        # The rig runs other gains than it should: it was restarted, or somebody changed them.
        Happening.CHANGED: _row((_DOING, _changed)),
        Happening.LOST: _row((_ALIVE, _lost), ((Mode.STOPPING,), _lost)),
        Happening.FAILED: _row((_ALIVE, _failed), ((Mode.STOPPING,), _failed)),
        Happening.TROUBLE: _row((_ALIVE, _trouble), ((Mode.STOPPING,), _same)),
        Happening.UNSAFE: _row(
            ((Mode.TUNING, Mode.CONFIRMING, Mode.WATCHING), _unsafe),
        ),
        Happening.SEARCHED: _row(((Mode.TUNING,), _searched), ((Mode.CONFIRMING,), _same)),
        Happening.PROPOSED: _row(((Mode.CONFIRMING,), _proposed)),
        Happening.ADOPTED: _row(((Mode.CONFIRMING,), _adopted)),
        Happening.KEPT: _row(((Mode.CONFIRMING,), _kept)),
        Happening.DRIFTED: _row(((Mode.WATCHING,), _drifted)),
        Happening.ENDED: _row(((Mode.STOPPING,), _ended)),
        Happening.ACCEPT: _row((_ALIVE, _accept), *_COMMAND_ENDS),
        Happening.REJECT: _row((_ALIVE, _reject), *_COMMAND_ENDS),
        Happening.REVERT: _row((_ALIVE, _revert), *_COMMAND_ENDS),
        Happening.PAUSE: _row((_ALIVE, _pause), *_COMMAND_ENDS),
        Happening.RESUME: _row(
            (_ABSENT, _resume),
            ((Mode.READYING, Mode.PAUSED), _resume_if_paused),
            (_DOING, _NOT_PAUSED),
            *_COMMAND_ENDS,
        ),
        Happening.STOP: _row(
            (_ALIVE, _stop), ((Mode.STOPPING,), _same), ((Mode.STOPPED,), _ENDED)
        ),
    }
)
