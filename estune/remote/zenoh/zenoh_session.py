"""Zenoh sessions with everything closed that is not needed.

No multicast and no gossip: only named endpoints are reached. No shared memory: it leaves files
behind a killed process and gains nothing at this size. A listener only on request, and on the
loopback address unless remote access is allowed, as there is no authentication by default.
"""

import json
import logging
import threading
import time
from typing import Any, Literal

import zenoh

from estune.errors import RigError
from estune.remote.messages.rights import Right
from estune.remote.security import OPEN, Security
from estune.remote.zenoh.endpoints import connection_fault
from estune.support.closing import Closing

LEASE_MS = 2000
"""Time after which a frozen process, whose connections are still open, counts as gone, ms."""

OPEN_WITHIN_MS = 2000
"""Time after which a connection is closed that has not become a session, ms."""

UNOPENED_MAX = 512
"""Connections that may wait to become a session; beyond it, none is accepted until one ends.

It is well below the usual limit of 1024 open files."""

COMMANDS_MAX_BYTES = 64 * 2**10
"""Largest message that a listener accepts; the transport drops longer ones."""

AGAIN_S = 0.05
"""Pause before something is tried again, s."""

_OPEN_AGAIN_MAX_S = 0.5
_CLOSE_WITHIN_S = 5.0
_log = logging.getLogger(__name__)


def open_session(
    role: Literal["client", "peer"],
    *,
    listen: tuple[str, ...] = (),
    connect: tuple[str, ...] = (),
    message_max_bytes: int,
    security: Security = OPEN,
    of_front: Right | None = None,
) -> zenoh.Session:
    """Opens a session.

    Args:
        role: `client` connects to the endpoints in `connect` and listens nowhere; `peer` listens
            at the endpoints in `listen`.
        listen: Where to listen.
        connect: Where to connect. A client fails at once if nothing listens there; once
            connected, it reconnects by itself after a cut.
        message_max_bytes: Largest message accepted.
        security: Identity of this process, and the rights of others.
        of_front: The right of the clients that a TLS front passes on to this listener.

    Raises:
        InvalidInput: an endpoint does not match the security settings.
        zenoh.ZError: it cannot listen, or connect.
    """
    for endpoint in connect:
        security.check_endpoint(endpoint)
    settings: dict[str, Any] = {
        "mode": role,
        "listen": {"endpoints": listen},
        "connect": {
            "endpoints": connect,
            # A peer works without the others and keeps trying.
            "timeout_ms": 0 if role == "client" else -1,
            "exit_on_failure": role == "client",
            "retry": {"period_init_ms": 100, "period_max_ms": 1000},
        },
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},
            "unicast": {
                "open_timeout": OPEN_WITHIN_MS,
                "accept_timeout": OPEN_WITHIN_MS,
                "accept_pending": UNOPENED_MAX,
            },
            "link": {
                "tx": {
                    "lease": LEASE_MS,
                    "keep_alive": 4,
                    # Batching waits a millisecond for further messages, which never come here.
                    "queue": {"batching": {"enabled": False}},
                },
                "rx": {"max_message_size": message_max_bytes},
            },
        },
    }
    config = zenoh.Config.from_json5(json.dumps(settings))
    for key, value in security.settings(of_front).items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def open_client(
    endpoint: str, message_max_bytes: int, security: Security, deadline_s: float, remedy: str
) -> zenoh.Session:
    """A client session with an endpoint, tried until a deadline on the monotonic clock.

    Raises:
        RigError: nothing listens there; the message contains the remedy.
    """
    pause_s = AGAIN_S
    while True:
        try:
            return open_session(
                "client",
                connect=(endpoint,),
                message_max_bytes=message_max_bytes,
                security=security,
            )
        except zenoh.ZError as error:
            if time.monotonic() > deadline_s:
                fault, absent = connection_fault(endpoint, security)
                raise RigError(f"{fault}; start {remedy}" if absent else fault) from error
        time.sleep(pause_s)
        pause_s = min(2.0 * pause_s, _OPEN_AGAIN_MAX_S)


def close_session(session: zenoh.Session) -> None:
    """Closes a session, without waiting longer than a few seconds for a peer that hangs."""
    closing = threading.Thread(target=_close, args=(session,), daemon=True)
    try:
        closing.start()
    except RuntimeError:  # the interpreter is shutting down
        _close(session)
    else:
        closing.join(_CLOSE_WITHIN_S)


class ClosingSession(Closing):
    """What talks by a session of its own, and ends with it."""

    _session: zenoh.Session

    def close(self) -> None:
        """Disconnects."""
        close_session(self._session)


def _close(session: zenoh.Session) -> None:
    try:
        session.close()  # type: ignore[no-untyped-call]
    except zenoh.ZError as error:
        _log.warning("session not closed properly: %s", error)
