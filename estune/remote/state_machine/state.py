"""State of a rig in the protocol, and the result of an event."""

from typing import NamedTuple

from estune.core.sentence_enum import SentenceEnum
from estune.remote.state_machine.events import RigAction
from estune.remote.state_machine.reply_codes import ReplyCode

LEASE_S = 1.0
"""Time a lease lasts without renewal, s; the active trial is stopped when it expires."""

RENEW_S = 0.2
"""Renewal interval of a lease, s."""


class Mode(SentenceEnum):
    """Activity of a rig: the columns of the transition table, in this order."""

    IDLE = "idle", "no client holds the lease, nothing moves"
    LEASED = "leased", "a client holds the lease; nothing moves, unless it sends setpoints"
    TAKING = "taking", "a trial is being written to the ledger; its sender has no reply yet"
    ACCEPTED = "accepted", "a trial is in the ledger and has not started"
    RUNNING = "running", "a trial is running"
    ABORTING = "aborting", "a trial is being stopped and the live gains are being restored"
    SAFE = "safe", "held in the safe state after an emergency stop, until cleared"
    CLOSED = "closed", "shutting down"


class GrantedLease(NamedTuple):
    """Right of one client to command the rig.

    Attributes:
        token: Random token drawn by the client, part of each of its commands.
        holder: The client, in words for people.
        expires_at_s: Time of expiry on the rig's own monotonic clock.
    """

    token: str
    holder: str
    expires_at_s: float


class AcceptedTrial(NamedTuple):
    """The active trial; `stopping` is the reason why it is being stopped, or empty."""

    trial_id: str
    noted: bool = False
    begun: bool = False
    stopping: str = ""


class RigState(NamedTuple):
    """Protocol state of a rig.

    Attributes:
        latched: Reason of the emergency stop; empty once cleared.
        ended: Number of trials ended since the start.
    """

    lease: GrantedLease | None = None
    trial: AcceptedTrial | None = None
    latched: str = ""
    closed: bool = False
    ended: int = 0

    @property
    def trial_id(self) -> str:
        """Id of the active trial; empty without one."""
        return "" if self.trial is None else self.trial.trial_id

    @property
    def mode(self) -> Mode:
        """Mode that follows from the state: a column of the table."""
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


class Transition(NamedTuple):
    """Result of an event.

    Attributes:
        sentence: Reason of a refusal; may be empty.
    """

    state: RigState
    reply_code: ReplyCode = ReplyCode.ACCEPTED
    sentence: str = ""
    orders: tuple[RigAction, ...] = ()
