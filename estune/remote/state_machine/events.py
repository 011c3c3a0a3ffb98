"""Events that change the state of a rig, and the actions that its server must then execute."""

from dataclasses import dataclass
from enum import StrEnum

from estune.remote.state_machine.trials import TrialState


@dataclass(frozen=True, slots=True)
class Acquire:
    """A client requests or extends the lease."""

    token: str
    holder: str


@dataclass(frozen=True, slots=True)
class Renew:
    """A client renews its lease."""

    token: str


@dataclass(frozen=True, slots=True)
class Release:
    """A client returns its lease."""

    token: str


@dataclass(frozen=True, slots=True)
class Expire:
    """Time has passed."""


@dataclass(frozen=True, slots=True)
class SubmitEvent:
    """A client submits a trial.

    Attributes:
        objection: Reason why the rig must not run it; empty if it may.
    """

    token: str
    trial_id: str
    known: TrialState
    objection: str = ""


@dataclass(frozen=True, slots=True)
class CancelEvent:
    """A client cancels the active trial: the one named, or any where no id is given."""

    token: str
    trial_id: str = ""


@dataclass(frozen=True, slots=True)
class VoidEvent:
    """A client voids a trial: it must never run, even if its submit still arrives."""

    token: str
    trial_id: str
    known: TrialState


@dataclass(frozen=True, slots=True)
class SetGainsEvent:
    """A client sets the live gains."""

    token: str


@dataclass(frozen=True, slots=True)
class SwitchOffEvent:
    """A client switches compensations off."""

    token: str


@dataclass(frozen=True, slots=True)
class FollowEvent:
    """A client sends a setpoint.

    Attributes:
        objection: Reason why the reel must not follow it; empty if it may.
    """

    token: str
    objection: str = ""


@dataclass(frozen=True, slots=True)
class EstopEvent:
    """Emergency stop, by any client at any time."""

    reason: str


@dataclass(frozen=True, slots=True)
class ClearEvent:
    """A client resets the emergency stop."""


@dataclass(frozen=True, slots=True)
class Noted:
    """The ledger holds the accepted trial."""


@dataclass(frozen=True, slots=True)
class Begin:
    """The active trial is about to move the rig; it must not unless this is accepted."""


@dataclass(frozen=True, slots=True)
class End:
    """The active trial is over, the live gains are restored, and the ledger holds its end."""


@dataclass(frozen=True, slots=True)
class Close:
    """The rig's program shuts down."""


Event = (
    Acquire
    | Renew
    | Release
    | Expire
    | SubmitEvent
    | CancelEvent
    | VoidEvent
    | SetGainsEvent
    | SwitchOffEvent
    | FollowEvent
    | EstopEvent
    | ClearEvent
    | Noted
    | Begin
    | End
    | Close
)


class RigAction(StrEnum):
    """Action that the server must execute after a transition."""

    TAKE_IN = "take in"
    STOP = "stop"
    ESTOP = "estop"
    CLEAR = "clear"
    APPLY = "apply"
    SWITCH_OFF = "switch off"
    FOLLOW = "follow"
    TOMBSTONE = "tombstone"
