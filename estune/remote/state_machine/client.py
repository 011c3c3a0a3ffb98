"""Reaction of a client to each input while it wants one trial run once, and its record.

::

    fresh      no message about the trial was sent
    sent       a submit was sent; whether it arrived is unknown
    in_hand    the rig has confirmed that it has the trial
    over       the trial has ended, or the client gives up

A missing reply carries no information: the client then queries the ledger, and submits again only
if the ledger has no entry. A trial that the rig has confirmed is never submitted again. An
interrupted trial is reported as such: the caller decides whether to run it again.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from estune.core.sentence_enum import SentenceEnum
from estune.errors import ProtocolError
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.support.state_table import IMPOSSIBLE, StateTable, TableRow, described

PATIENCE_S = 30.0
"""Time for which a client waits for a rig that does not reply, by default, s."""


class ClientStage(StrEnum):
    """Progress of a trial, as far as the client can know it."""

    FRESH = "fresh"
    SENT = "sent"
    IN_HAND = "in_hand"
    OVER = "over"


class ClientInput(SentenceEnum):
    """Input of a client besides a reply code."""

    RECORD = "record", "the record of the trial"
    SILENCE = "silence", "no reply in time"
    LEASED = "leased", "the lease was granted"
    RESTARTED = "restarted", "the rig was restarted with the same ledger"
    EMPTIED = "emptied", "a simulated rig was restarted with an empty ledger: nothing has moved"
    REPLACED = "replaced", "another ledger replies under the rig's name"
    GONE = "gone", "no reply until the client's timeout"


class Action(StrEnum):
    """Next action of a client."""

    SUBMIT = "submit"
    INQUIRE = "inquire"
    WAIT = "wait, then inquire"
    LEASE = "acquire the lease, then submit"
    RECORD = "return the record"
    INTERRUPTED = "return: interrupted"
    NOTHING_RAN = "return: nothing ran"
    FAIL = "raise the rig's error"
    GONE = "raise: gone, the trial did not run"
    AMBIGUOUS = "raise: the trial may have run"


@dataclass(frozen=True, slots=True)
class ClientTransition:
    """Next stage and action of a client."""

    stage: ClientStage
    action: Action


Move = Callable[[], ClientTransition]


def _after(stage: ClientStage, action: Action) -> Move:
    transition = ClientTransition(stage, action)

    @described(f"{action} (`{stage}`)")
    def move() -> ClientTransition:
        return transition

    return move


START = ClientTransition(ClientStage.FRESH, Action.SUBMIT)
"""Start of each trial; the rig consults its ledger before it accepts a submit."""

_FRESH, _SENT, _IN_HAND = (ClientStage.FRESH,), (ClientStage.SENT,), (ClientStage.IN_HAND,)
_START = _after(ClientStage.FRESH, Action.SUBMIT)
_RESUBMIT = _after(ClientStage.SENT, Action.SUBMIT)
_ASK_SENT = _after(ClientStage.SENT, Action.INQUIRE)
_WAIT_SENT = _after(ClientStage.SENT, Action.WAIT)
_LEASE = _after(ClientStage.SENT, Action.LEASE)
_ASK_IN_HAND = _after(ClientStage.IN_HAND, Action.INQUIRE)
_WAIT_IN_HAND = _after(ClientStage.IN_HAND, Action.WAIT)
_RECORD = _after(ClientStage.OVER, Action.RECORD)
_INTERRUPTED = _after(ClientStage.OVER, Action.INTERRUPTED)
_NOTHING_RAN = _after(ClientStage.OVER, Action.NOTHING_RAN)
_FAIL = _after(ClientStage.OVER, Action.FAIL)
_GONE = _after(ClientStage.OVER, Action.GONE)
_AMBIGUOUS = _after(ClientStage.OVER, Action.AMBIGUOUS)


def _row(fresh: Move | str, sent: Move | str, in_hand: Move | str) -> TableRow[ClientStage, Move]:
    return TableRow(IMPOSSIBLE, (fresh, _FRESH), (sent, _SENT), (in_hand, _IN_HAND))


TABLE: StateTable[ReplyCode | ClientInput, ClientStage, Move] = StateTable(
    ClientStage,
    {
        # by stage: fresh, sent, in hand; nothing more is heard once it is over
        ClientInput.RECORD: _row(IMPOSSIBLE, _RECORD, _RECORD),
        ClientInput.SILENCE: _row(IMPOSSIBLE, _ASK_SENT, _ASK_IN_HAND),
        ClientInput.LEASED: _row(_START, _RESUBMIT, _ASK_IN_HAND),
        ClientInput.RESTARTED: _row(_START, _ASK_SENT, _ASK_IN_HAND),
        ClientInput.EMPTIED: _row(_START, _START, _START),
        ClientInput.REPLACED: _row(_GONE, _AMBIGUOUS, _AMBIGUOUS),
        ClientInput.GONE: _row(_GONE, _AMBIGUOUS, _AMBIGUOUS),
        ReplyCode.ACCEPTED: _row(IMPOSSIBLE, _WAIT_IN_HAND, _WAIT_IN_HAND),
        ReplyCode.RUNNING: _row(IMPOSSIBLE, _WAIT_IN_HAND, _WAIT_IN_HAND),
        ReplyCode.ENDED: _row(IMPOSSIBLE, _ASK_IN_HAND, _ASK_IN_HAND),
        ReplyCode.NEVER_STARTED: _row(IMPOSSIBLE, _NOTHING_RAN, _NOTHING_RAN),
        ReplyCode.INTERRUPTED: _row(IMPOSSIBLE, _INTERRUPTED, _INTERRUPTED),
        ReplyCode.VOID: _row(IMPOSSIBLE, _NOTHING_RAN, _AMBIGUOUS),
        ReplyCode.UNKNOWN: _row(IMPOSSIBLE, _RESUBMIT, _AMBIGUOUS),
        # Busy with this very trial while the ledger is being written, else with another's.
        ReplyCode.BUSY: _row(IMPOSSIBLE, _WAIT_SENT, _WAIT_IN_HAND),
        ReplyCode.HELD: _row(_FAIL, _FAIL, _ASK_IN_HAND),
        ReplyCode.NO_LEASE: _row(_LEASE, _LEASE, _ASK_IN_HAND),
        ReplyCode.SAFE: _row(_FAIL, _FAIL, _ASK_IN_HAND),
        ReplyCode.REFUSED: _row(_FAIL, _FAIL, _FAIL),
    },
)


def sent(step: ClientTransition) -> ClientTransition:
    """The transition once its message was sent: a fresh trial is fresh no longer."""
    if step.action is Action.SUBMIT and step.stage is ClientStage.FRESH:
        return _RESUBMIT()
    return step


def next_transition(
    stage: ClientStage, heard: ReplyCode | ClientInput, *, own: bool = True
) -> ClientTransition:
    """Transition of a client on an input.

    Raises:
        ProtocolError: the input is impossible in this stage: the rig violates the protocol.
    """
    if heard is ReplyCode.BUSY and not own:
        return _FAIL()
    move = TABLE.cell(heard, stage)
    if isinstance(move, str):
        raise ProtocolError(f"the rig replies {heard!s} to a trial that is {stage!s}")
    return move()
