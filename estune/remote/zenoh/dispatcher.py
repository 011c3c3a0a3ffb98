"""Takes messages in as they come over the link, and gives the answers out as they go back.

Whatever comes, however broken, has one answer, or none where nothing was asked of a rig.
"""

from collections.abc import Callable, Sequence
from functools import partial

from estune.errors import EstuneError
from estune.remote import messages
from estune.remote.messages import (
    Answer,
    Cancel,
    Clear,
    Description,
    Estop,
    Inquire,
    Lease,
    SetGains,
    Submit,
    Void,
)
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.zenoh.replies import to_estune_error
from estune.remote.zenoh.request_handler import RequestHandler

_Say = Callable[[object], None]


class MessageDispatcher:
    """What stands between bytes and an attendant."""

    def __init__(
        self, attendant: RequestHandler, instance: str, ledger: str, part_bytes: int = 0
    ) -> None:
        """Opens the desk.

        Args:
            attendant: Who does what is asked.
            instance: This start of the rig.
            ledger: Identity of its ledger.
            part_bytes: Records are answered in parts of so many bytes; 0 answers them whole.
        """
        self._attendant = attendant
        self._instance = instance
        self._ledger = ledger
        self._part_bytes = part_bytes

    def answer(self, words: Sequence[str], payload: bytes, reply: Callable[[bytes], None]) -> None:
        """Answers a query.

        Args:
            words: Its key after the rig's name, chunk by chunk.
            payload: What came with it.
            reply: Called once with the answer; not at all where none is due. Must not raise.
        """
        say = partial(_encoded, reply)
        try:
            match words:
                case ["@cmd", _, verb]:
                    self._command(verb, payload, say)
                case _:
                    self._question(words, payload, say)
        except BaseException as error:  # noqa: BLE001  even SystemExit: somebody waits for it
            say(messages.refusal(to_estune_error(error, "/".join(words))))

    def _command(self, verb: str, payload: bytes, say: _Say) -> None:
        attendant, decode = self._attendant, messages.decode
        match verb:
            case "lease":
                say(attendant.lease(decode(Lease, payload)))
            case "submit":
                attendant.submit(decode(Submit, payload), partial(self._briefly, say))
            case "cancel":
                say(attendant.cancel(decode(Cancel, payload)))
            case "void":
                say(attendant.void(decode(Void, payload)))
            case "gains":
                say(attendant.set_gains(decode(SetGains, payload)))
            case "estop":
                attendant.estop(_reason(payload), say)
            case "clear":
                decode(Clear, payload)
                say(attendant.clear())

    def _question(self, words: Sequence[str], payload: bytes, say: _Say) -> None:
        match words:
            case ["result", trial_id]:
                inquiry = messages.decode(Inquire, payload)
                say(self._attendant.result(trial_id, inquiry, self._part_bytes))
            case ["status"]:
                say(self._attendant.status(self._instance))
            case ["describe"]:
                say(Description(self._attendant.describe(), self._instance, self._ledger))
            case _:
                pass  # somebody looks around with a wildcard, or asks for what does not exist

    def _briefly(self, say: _Say, message: Answer | bytes) -> None:
        """Answers a submit; where records travel in parts, with where to ask for them."""
        whole = self._part_bytes and isinstance(message, bytes)
        say(Answer(ReplyCode.ENDED) if whole else message)


def _encoded(reply: Callable[[bytes], None], message: object) -> None:
    reply(message if isinstance(message, bytes) else messages.encode(message))


def _reason(payload: bytes) -> Estop:
    """Whatever was sent: an emergency stop is obeyed even if its reason cannot be read."""
    try:
        return messages.decode(Estop, payload)
    except EstuneError as error:
        return Estop(f"(its reason could not be read: {error})")
