"""Where a rig stands (lease, trial in hand, emergency stop), and what can be ordered of it."""

from enum import StrEnum
from typing import NamedTuple

from estune.remote.state_machine.reply_codes import ReplyCode

LEASE_S = 1.0
"""How long a lease lives without being renewed, s. What it protects is stopped when it ends."""

RENEW_S = 0.2
"""How often its holder renews it, s."""


class Mode(StrEnum):
    """What a rig does now. The columns of the table, in this order."""

    IDLE = "idle"
    LEASED = "leased"
    TAKING = "taking"
    ACCEPTED = "accepted"
    RUNNING = "running"
    ABORTING = "aborting"
    SAFE = "safe"
    CLOSED = "closed"

    @property
    def sentence(self) -> str:
        """The mode in words."""
        return _MODES[self]


_MODES = {
    Mode.IDLE: "nobody holds the lease, nothing moves",
    Mode.LEASED: "a client holds the lease, nothing moves",
    Mode.TAKING: "a trial is being written to the ledger; its sender has no answer yet",
    Mode.ACCEPTED: "a trial is in the ledger and has not begun",
    Mode.RUNNING: "a trial is under way",
    Mode.ABORTING: "a trial is being stopped and the live gains are being put back",
    Mode.SAFE: "held in the safe state after an emergency stop, until cleared",
    Mode.CLOSED: "shutting down",
}


class Lease(NamedTuple):
    """Who commands the rig, and how long without another word.

    Attributes:
        token: What its commands must name; made by the client, new each time.
        holder: Who holds it, in words for people.
        expires_at_s: When it ends, on the rig's own clock.
    """

    token: str
    holder: str
    expires_at_s: float


class AcceptedTrial(NamedTuple):
    """The trial in hand.

    Attributes:
        trial_id: Its id.
        noted: Whether it is in the ledger.
        begun: Whether it has begun to move the rig.
        stopping: Why it is being stopped, in words; empty while it is not.
    """

    trial_id: str
    noted: bool = False
    begun: bool = False
    stopping: str = ""


class RigState(NamedTuple):
    """Where a rig stands.

    Attributes:
        lease: The lease that lives, if any.
        trial: The trial in hand, if any.
        latched: Why the emergency stop was called; empty once cleared.
        closed: Whether the rig is shutting down.
        ended: How many trials have ended since the start.
    """

    lease: Lease | None = None
    trial: AcceptedTrial | None = None
    latched: str = ""
    closed: bool = False
    ended: int = 0

    @property
    def mode(self) -> Mode:
        """The mode: a column of the table."""
        trial = self.trial
        if trial is not None:
            if trial.stopping:
                return Mode.ABORTING
            if trial.begun:
                return Mode.RUNNING
            return Mode.ACCEPTED if trial.noted else Mode.TAKING
        if self.closed:
            return Mode.CLOSED
        if self.latched:
            return Mode.SAFE
        return Mode.IDLE if self.lease is None else Mode.LEASED


class RigAction(StrEnum):
    """What whoever drives the rig must do now."""

    TAKE_IN = "take in"
    STOP = "stop"
    ESTOP = "estop"
    CLEAR = "clear"
    APPLY = "apply"
    TOMBSTONE = "tombstone"


class Transition(NamedTuple):
    """What comes of an event.

    Attributes:
        state: The next state.
        verdict: The answer.
        sentence: Why not, where the answer is no; may be empty.
        orders: What must be done now, in this order.
    """

    state: RigState
    verdict: ReplyCode = ReplyCode.ACCEPTED
    sentence: str = ""
    orders: tuple[RigAction, ...] = ()
