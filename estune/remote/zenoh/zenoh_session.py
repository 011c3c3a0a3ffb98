"""Zenoh sessions with everything closed that is not needed.

No multicast and no gossip: nobody is found who was not named. No shared memory: it leaves files
behind a killed process and gains nothing at this size. A listener only where one is asked for,
and on this machine only unless the caller insists: who is asked for no password could be anybody.
"""

import ipaddress
import json
import logging
import re
import socket
import threading
from typing import Any, Literal

import zenoh

from estune.errors import InvalidInput, RigError
from estune.remote.security import OPEN, Security

LEASE_MS = 2000
"""A process that stops dead, without closing its connections, is missed after this time."""

COMMANDS_MAX_BYTES = 64 * 2**10
"""Largest message a rig takes in; longer ones are dropped by the transport, before any of ours."""

_CLOSE_WITHIN_S = 5.0
_PORT_TRIES = 5
_log = logging.getLogger(__name__)


def open_session(
    role: Literal["client", "peer"],
    *,
    listen: tuple[str, ...] = (),
    connect: tuple[str, ...] = (),
    message_max_bytes: int,
    security: Security = OPEN,
) -> zenoh.Session:
    """Opens a session.

    Args:
        role: `client` reaches the endpoints named in `connect` and is reached by nobody; `peer`
            is reached at the endpoints named in `listen`.
        listen: Where to listen.
        connect: Whom to connect to. A client fails at once if nobody is there; once connected,
            it connects again by itself after a cut.
        message_max_bytes: Larger messages are not taken in.
        security: How it shows who it is, and whom it lets do what.

    Raises:
        InvalidInput: an endpoint does not go with the security.
        zenoh.ZError: it cannot listen, or reach anybody.
    """
    for endpoint in (*listen, *connect):
        security.check_endpoint(endpoint)
    settings: dict[str, Any] = {
        "mode": role,
        "listen": {"endpoints": listen},
        "connect": {
            "endpoints": connect,
            # A peer goes on without the others and keeps trying.
            "timeout_ms": 0 if role == "client" else -1,
            "exit_on_failure": role == "client",
            "retry": {"period_init_ms": 100, "period_max_ms": 1000},
        },
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},
            "unicast": {"open_timeout": 2000, "accept_timeout": 2000},
            "link": {
                "tx": {
                    "lease": LEASE_MS,
                    "keep_alive": 4,
                    # Batching waits a millisecond for more to send, which here never comes.
                    "queue": {"batching": {"enabled": False}},
                },
                "rx": {"max_message_size": message_max_bytes},
            },
        },
    }
    config = zenoh.Config.from_json5(json.dumps(settings))
    for key, value in security.settings().items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def open_listening(
    endpoint: str, routers: tuple[str, ...], security: Security
) -> tuple[zenoh.Session, str]:
    """A session that takes commands, and where it listens: port 0 is a free one.

    Raises:
        RigError: nothing can listen there.
    """
    for tries_left in reversed(range(_PORT_TRIES)):
        actual = with_port(endpoint)
        try:
            session = open_session(
                "peer",
                listen=(actual,),
                connect=routers,
                message_max_bytes=COMMANDS_MAX_BYTES,
                security=security,
            )
        except zenoh.ZError as error:
            # Another process may have taken the free port in between.
            if actual == endpoint or not tries_left:
                raise listen_error(actual, error) from error
        else:
            return session, actual
    raise AssertionError  # the last try has returned or raised


def close_session(session: zenoh.Session) -> None:
    """Closes a session, but waits no longer than a few seconds for a peer that hangs."""
    closing = threading.Thread(target=_close, args=(session,), daemon=True)
    try:
        closing.start()
    except RuntimeError:  # the interpreter is shutting down
        _close(session)
    else:
        closing.join(_CLOSE_WITHIN_S)


def _close(session: zenoh.Session) -> None:
    try:
        session.close()  # type: ignore[no-untyped-call]
    except zenoh.ZError as error:
        _log.warning("session not closed in good order: %s", error)


def check_endpoint(endpoint: str) -> None:
    """Refuses what is no endpoint.

    Raises:
        InvalidInput: it is not of the form tcp/host:port (or tls, quic, unixsock-stream).
    """
    form = r"(tcp|tls|quic)/(\[[0-9a-fA-F:.]+\]|[^\s/:\[\]]+):(\d{1,5})|unixsock-stream/\S+"
    match = re.fullmatch(form, endpoint)
    if match is None or int(match[3] or 0) > 65535:
        raise InvalidInput(
            f"endpoint {endpoint!r} is not one; write it as tcp/host:port, "
            "for example tcp/127.0.0.1:7447"
        )


def check_loopback(endpoint: str) -> None:
    """Refuses to listen where other machines could reach it.

    Raises:
        InvalidInput: they could.
    """
    if endpoint.startswith("unixsock-stream/"):
        return
    host, _ = _host_and_port(endpoint)
    try:
        found = {info[4][0] for info in socket.getaddrinfo(host, None)}
    except OSError as error:
        raise InvalidInput(f"endpoint {endpoint!r}: host {host!r} is not known") from error
    if not all(ipaddress.ip_address(str(address)).is_loopback for address in found):
        raise InvalidInput(
            f"listening at {endpoint} would let any machine on the network move the rig; listen "
            "at tcp/127.0.0.1, or allow it expressly (allow_remote) on a network you trust"
        )


def with_port(endpoint: str) -> str:
    """The endpoint, with a free port in place of port 0: Zenoh does not tell which it took."""
    if endpoint.startswith("unixsock-stream/"):
        return endpoint
    host, port = _host_and_port(endpoint)
    if port != 0:
        return endpoint
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.bind((host, 0))
        return f"{endpoint.rpartition(':')[0]}:{probe.getsockname()[1]}"


def listen_error(endpoint: str, error: zenoh.ZError) -> RigError:
    """Why a listener could not be opened, without the library's internals."""
    cause = re.search(r"([A-Z][a-z ]+) \(os error \d+\)", str(error))
    return RigError(
        f"cannot listen at {endpoint}: {cause[1].lower() if cause else error}; "
        "choose another port, or port 0 for any free one"
    )


def _host_and_port(endpoint: str) -> tuple[str, int]:
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port)
