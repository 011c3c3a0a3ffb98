"""What a client does with each answer while it wants one trial run, once, and its record.

::

    fresh      nothing of the trial was ever sent
    sent       a submit was sent; whether it arrived is not known
    in_hand    the rig has said that it has the trial
    over       the trial has come to its end, or the client has to give up

Silence says nothing: after it, the ledger is asked, and only its word that it knows nothing of the
trial has it sent again. A trial that a rig has said it has is never sent again. An interrupted
trial is told to the caller as what it is: whether to run it again is not a client's to say.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType

from estune.errors import ProtocolError
from estune.remote.state_machine.reply_codes import ReplyCode


class ClientStage(StrEnum):
    """How far a trial has come, so far as the client can know."""

    FRESH = "fresh"
    SENT = "sent"
    IN_HAND = "in_hand"
    OVER = "over"


class ClientInput(StrEnum):
    """What a client can hear, besides a verdict."""

    RECORD = "record"
    SILENCE = "silence"
    LEASED = "leased"
    RESTARTED = "restarted"
    EMPTIED = "emptied"
    REPLACED = "replaced"
    GONE = "gone"

    @property
    def sentence(self) -> str:
        """What it means."""
        return _HEARD[self]


_HEARD = {
    ClientInput.RECORD: "the record of the trial",
    ClientInput.SILENCE: "no answer in time",
    ClientInput.LEASED: "the lease was granted",
    ClientInput.RESTARTED: "the rig was restarted, with the ledger it had",
    ClientInput.EMPTIED: "a simulated rig was restarted with an empty ledger: nothing can have moved",
    ClientInput.REPLACED: "another ledger answers under the rig's name",
    ClientInput.GONE: "no answer for so long that the client gives up",
}


class Action(StrEnum):
    """What a client does next."""

    SUBMIT = "submit"
    INQUIRE = "inquire"
    WAIT = "wait, then inquire"
    LEASE = "ask for the lease, then submit"
    RECORD = "return the record"
    INTERRUPTED = "return: interrupted"
    NOTHING_RAN = "return: nothing ran"
    FAIL = "raise what the rig said"
    GONE = "raise: gone, the trial did not run"
    AMBIGUOUS = "raise: the trial may have run"


@dataclass(frozen=True, slots=True)
class ClientTransition:
    """What comes of what was heard."""

    stage: ClientStage
    action: Action


START = ClientTransition(ClientStage.FRESH, Action.SUBMIT)
"""Where each trial begins. The rig asks its ledger before it takes anything in."""

_RESUBMIT = ClientTransition(ClientStage.SENT, Action.SUBMIT)
_ASK_SENT, _ASK_IN_HAND = (
    ClientTransition(stage, Action.INQUIRE) for stage in (ClientStage.SENT, ClientStage.IN_HAND)
)
_WAIT_SENT, _WAIT_IN_HAND = (
    ClientTransition(stage, Action.WAIT) for stage in (ClientStage.SENT, ClientStage.IN_HAND)
)
_LEASE = ClientTransition(ClientStage.SENT, Action.LEASE)
_RECORD, _INTERRUPTED, _NOTHING_RAN, _FAIL, _GONE, _AMBIGUOUS = (
    ClientTransition(ClientStage.OVER, action)
    for action in (
        *(Action.RECORD, Action.INTERRUPTED, Action.NOTHING_RAN),
        *(Action.FAIL, Action.GONE, Action.AMBIGUOUS),
    )
)

TABLE: Mapping[
    ReplyCode | ClientInput,
    tuple[ClientTransition | None, ClientTransition | None, ClientTransition | None],
] = MappingProxyType(
    {
        # heard: fresh, sent, in hand; None cannot be
        ClientInput.RECORD: (None, _RECORD, _RECORD),
        ClientInput.SILENCE: (None, _ASK_SENT, _ASK_IN_HAND),
        ClientInput.LEASED: (START, _RESUBMIT, _ASK_IN_HAND),
        ClientInput.RESTARTED: (START, _ASK_SENT, _ASK_IN_HAND),
        ClientInput.EMPTIED: (START, START, START),
        ClientInput.REPLACED: (_GONE, _AMBIGUOUS, _AMBIGUOUS),
        ClientInput.GONE: (_GONE, _AMBIGUOUS, _AMBIGUOUS),
        ReplyCode.ACCEPTED: (None, _WAIT_IN_HAND, _WAIT_IN_HAND),
        ReplyCode.RUNNING: (None, _WAIT_IN_HAND, _WAIT_IN_HAND),
        ReplyCode.ENDED: (None, _ASK_IN_HAND, _ASK_IN_HAND),
        ReplyCode.NEVER_STARTED: (None, _NOTHING_RAN, _NOTHING_RAN),
        ReplyCode.INTERRUPTED: (None, _INTERRUPTED, _INTERRUPTED),
        ReplyCode.VOID: (None, _NOTHING_RAN, _AMBIGUOUS),
        ReplyCode.UNKNOWN: (None, _RESUBMIT, _AMBIGUOUS),
        # Busy with this very trial while the ledger is being written, else with another's.
        ReplyCode.BUSY: (None, _WAIT_SENT, _WAIT_IN_HAND),
        ReplyCode.HELD: (_FAIL, _FAIL, _ASK_IN_HAND),
        ReplyCode.NO_LEASE: (_LEASE, _LEASE, _ASK_IN_HAND),
        ReplyCode.SAFE: (_FAIL, _FAIL, _ASK_IN_HAND),
        ReplyCode.REFUSED: (_FAIL, _FAIL, _FAIL),
    }
)
"""What is heard by stage."""

_COLUMN = {ClientStage.FRESH: 0, ClientStage.SENT: 1, ClientStage.IN_HAND: 2}


def sent(step: ClientTransition) -> ClientTransition:
    """The step once its question is on its way: a trial that was fresh is not any more."""
    if step.action is Action.SUBMIT and step.stage is ClientStage.FRESH:
        return ClientTransition(ClientStage.SENT, step.action)
    return step


def next_transition(
    stage: ClientStage, heard: ReplyCode | ClientInput, *, own: bool = True
) -> ClientTransition:
    """What a client does with what it hears.

    Args:
        stage: How far the trial has come.
        heard: What was heard.
        own: Whether a verdict names this trial; `busy` with another's trial is a refusal.

    Raises:
        ProtocolError: that cannot be heard now: the rig breaks the protocol.
    """
    if heard is ReplyCode.BUSY and not own:
        return _FAIL
    found = None if stage is ClientStage.OVER else TABLE[heard][_COLUMN[stage]]
    if found is None:
        raise ProtocolError(f"the rig says {heard!s} of a trial that is {stage!s}")
    return found
