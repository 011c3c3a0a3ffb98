"""Messages put under the keys of other programs; nothing is received."""

import time

import zenoh

from estune.remote.security import OPEN
from estune.remote.zenoh.zenoh_session import COMMANDS_MAX_BYTES, ClosingSession, open_client

_OPENED_WITHIN_S = 3.0


class PutSession(ClosingSession):
    """A client of a router, for puts and liveliness tokens alone. A context manager.

    Args:
        remedy: What to start where nothing listens there.

    Raises:
        RigError: nothing listens there.
    """

    def __init__(self, router: str, remedy: str) -> None:
        deadline_s = time.monotonic() + _OPENED_WITHIN_S
        self._session = open_client(router, COMMANDS_MAX_BYTES, OPEN, deadline_s, remedy)
        self._tokens: list[object] = []

    @property
    def session_id(self) -> str:
        """Zenoh's id of this session, in hexadecimal digits."""
        return str(self._session.info.zid())

    def declare_token(self, key: str) -> None:
        """Declares a liveliness token, which lasts as long as the session."""
        self._tokens.append(self._session.liveliness().declare_token(key))

    def put(self, key: str, payload: bytes, attachment: bytes | None) -> None:
        """Sends a message to whoever has subscribed to the key; waits while the queue is full.

        Zenoh drops a put where its queue, of two messages, is full or just being emptied: of
        bursts as short as seven messages one was lost now and then. Only the caller waits.
        """
        self._session.put(
            key,
            payload,
            attachment=attachment,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
