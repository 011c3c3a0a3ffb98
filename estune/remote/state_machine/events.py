"""What can happen to a rig: commands, the passing of time, and the course of its trial."""

from dataclasses import dataclass

from estune.remote.state_machine.trials import TrialState


@dataclass(frozen=True, slots=True)
class Acquire:
    """A client asks for the lease, or for more of it."""

    token: str
    holder: str


@dataclass(frozen=True, slots=True)
class Renew:
    """A client keeps its lease alive."""

    token: str


@dataclass(frozen=True, slots=True)
class Release:
    """A client gives its lease back."""

    token: str


@dataclass(frozen=True, slots=True)
class Expire:
    """Time has passed."""


@dataclass(frozen=True, slots=True)
class SubmitEvent:
    """A trial is asked for.

    Attributes:
        token: The client's lease.
        trial_id: Its id.
        known: What the ledger knows of it.
        objection: Why the rig must not run it; empty if it may.
    """

    token: str
    trial_id: str
    known: TrialState
    objection: str = ""


@dataclass(frozen=True, slots=True)
class CancelEvent:
    """The trial in hand is to be stopped: the one named, or any where none is."""

    token: str
    trial_id: str = ""


@dataclass(frozen=True, slots=True)
class VoidEvent:
    """A trial is never to run, should its submit still arrive."""

    token: str
    trial_id: str
    known: TrialState


@dataclass(frozen=True, slots=True)
class SetGainsEvent:
    """Gains are to be made the live ones."""

    token: str


@dataclass(frozen=True, slots=True)
class EstopEvent:
    """Emergency stop: from anybody, at any time."""

    reason: str


@dataclass(frozen=True, slots=True)
class ClearEvent:
    """The emergency stop is over."""


@dataclass(frozen=True, slots=True)
class Noted:
    """The ledger holds the trial taken in."""


@dataclass(frozen=True, slots=True)
class Begin:
    """The trial in hand is about to move the rig; it must not unless the answer is yes."""


@dataclass(frozen=True, slots=True)
class End:
    """The trial in hand is over, the live gains are back, and the ledger says how it ended."""


@dataclass(frozen=True, slots=True)
class Close:
    """The rig's program is to end."""


Event = (
    Acquire
    | Renew
    | Release
    | Expire
    | SubmitEvent
    | CancelEvent
    | VoidEvent
    | SetGainsEvent
    | EstopEvent
    | ClearEvent
    | Noted
    | Begin
    | End
    | Close
)
