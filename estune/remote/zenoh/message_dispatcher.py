"""From bytes to a method and back: commands and queries are decoded, executed and answered."""

import logging
from collections.abc import Callable
from typing import NamedTuple

from estune.errors import ProtocolError
from estune.remote import messages
from estune.remote.messages import VERBS, Answer, commands, refusal
from estune.remote.messages.codec import Message
from estune.remote.zenoh.trial_execution import to_estune_error

CommandListener = Callable[[str, bytes, bytes], None]
"""Takes the verb, payload and reply of a command; must return at once and not raise."""

_log = logging.getLogger(__name__)


class Handled(NamedTuple):
    """Reply to a command.

    Attributes:
        answer: The reply; bytes are a record's frame.
        afterwards: Work to be done once the reply was sent.
    """

    answer: Answer | bytes
    afterwards: Callable[[], object] | None = None


class MessageDispatcher:
    """Calls the method named like the verb with the decoded message, and encodes its reply."""

    def __init__(self, heard: CommandListener) -> None:
        self._heard = heard

    def command(self, verb: str, payload: bytes, reply: Callable[[bytes], None]) -> None:
        """Executes a command, however malformed; `reply` is called once and must not raise."""
        handled = Handled(b"")

        def execute() -> Answer | bytes:
            nonlocal handled
            returned = getattr(self, verb)(self._decode(verb, payload))
            handled = returned if isinstance(returned, Handled) else Handled(returned)
            return handled.answer

        def reply_and_tell(data: bytes) -> None:
            reply(data)
            self._heard(verb, payload, data)

        self.query(execute, reply_and_tell, verb)
        try:
            if handled.afterwards is not None:
                handled.afterwards()
        except BaseException:  # noqa: BLE001  the thread must serve further commands
            _log.exception("after %s", verb)

    def query(
        self,
        answer: Callable[[], Message | bytes],
        reply: Callable[[bytes], None],
        activity: str = "a query",
    ) -> None:
        """Replies with a message or a frame, or with the error that prevents it."""
        try:
            made = answer()
            data = made if isinstance(made, bytes) else messages.encode(made)
        except BaseException as error:  # noqa: BLE001  even SystemExit: a client waits for it
            try:
                data = messages.encode(refusal(to_estune_error(error, activity)))
            except ProtocolError as unsendable:  # else the thread would end, and serve nobody more
                data = messages.encode(refusal(unsendable))
        reply(data)

    @staticmethod
    def _decode(verb: str, payload: bytes) -> Message:
        try:
            return messages.decode(VERBS[verb].message, payload)
        except ProtocolError as error:
            if VERBS[verb].message is not commands.Estop:
                raise
            # An emergency stop is obeyed even if its reason cannot be read.
            return commands.Estop(f"(its reason could not be read: {error})")
