"""Zenoh sessions with everything closed that is not needed.

No multicast and no gossip: only named endpoints are reached. No shared memory: it leaves files
behind a killed process and gains nothing at this size. A listener only on request, and on the
loopback address unless remote access is allowed, as there is no authentication by default.
"""

import json
import logging
import re
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any, Literal

import zenoh

from estune.errors import RigError
from estune.remote.security import OPEN, Security
from estune.remote.zenoh.endpoints import (
    check_endpoint,
    check_loopback,
    connection_fault,
    with_port,
)

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
_END_WITHIN_S = 1.0
_PORT_TRIES = 5
_WAITING_MAX = 256
_log = logging.getLogger(__name__)

Reply = Callable[[bytes], None]
"""Sends the reply to a query; must be called at most once."""


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
        role: `client` connects to the endpoints in `connect` and listens nowhere; `peer` listens
            at the endpoints in `listen`.
        listen: Where to listen.
        connect: Where to connect. A client fails at once if nothing listens there; once
            connected, it reconnects by itself after a cut.
        message_max_bytes: Largest message accepted.
        security: Identity of this process, and the rights of others.

    Raises:
        InvalidInput: an endpoint does not match the security settings.
        zenoh.ZError: it cannot listen, or connect.
    """
    for endpoint in (*listen, *connect):
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
    for key, value in security.settings().items():
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


def _close(session: zenoh.Session) -> None:
    try:
        session.close()  # type: ignore[no-untyped-call]
    except zenoh.ZError as error:
        _log.warning("session not closed properly: %s", error)


class Lane:
    """Threads that answer queries in the order of their arrival, and sleep until one arrives.

    Zenoh's own threads put the queries in line and never wait for these: beyond `_WAITING_MAX`,
    the oldest query is dropped, and its sender repeats it. A receiver of Zenoh's would wake some
    twenty times a second to look for signals.
    """

    def __init__(self, threads: int) -> None:
        self._waiting: SimpleQueue[tuple[zenoh.Query, _Handle] | None] = SimpleQueue()
        self._closed = False
        self._threads = [threading.Thread(target=self._serve, daemon=True) for _ in range(threads)]
        for thread in self._threads:
            thread.start()

    def put(self, handle: "_Handle", query: zenoh.Query) -> None:
        """Lines a query up, to be answered by a function."""
        if self._waiting.qsize() >= _WAITING_MAX:
            with suppress(Empty):
                if (oldest := self._waiting.get_nowait()) is not None:
                    oldest[0].drop()  # type: ignore[no-untyped-call]
        self._waiting.put((query, handle))

    def close(self) -> None:
        """Ends the threads, once the answers under way are given."""
        self._closed = True
        for _ in self._threads:
            self._waiting.put(None)
        # The interpreter must not shut down while a thread is inside Zenoh: it would abort.
        for thread in self._threads:
            thread.join(_END_WITHIN_S)

    def _serve(self) -> None:
        while (item := self._waiting.get()) is not None and not self._closed:
            query, handle = item
            with query:  # left undropped, it would keep its sender waiting
                handle(query, b"" if query.payload is None else query.payload.to_bytes())
            del item, query


_Handle = Callable[[zenoh.Query, bytes], None]


class ListeningSession:
    """A session that listens, answers queries in lanes, and publishes.

    Attributes:
        endpoint: Where it listens.
        instance: Identity of this start, attached to every reply and publication.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        instance: str,
        routers: Iterable[str] = (),
        allow_remote: bool = False,
        security: Security = OPEN,
    ) -> None:
        """Listens; port 0 selects a free port.

        Raises:
            InvalidInput: an endpoint is malformed, or reaches other machines without permission.
            RigError: the endpoint is in use.
        """
        routers = tuple(routers)
        for each in (endpoint, *routers):
            check_endpoint(each)
        if not allow_remote:
            check_loopback(endpoint)
        self.instance = instance
        self._session, self.endpoint = _listen(endpoint, routers, security)
        self._threads: list[threading.Thread] = []
        self._lanes: list[Lane] = []
        self._queryables: list[zenoh.Queryable[None]] = []
        self._tokens: dict[str, zenoh.LivelinessToken] = {}

    def lane(self, threads: int = 1) -> Lane:
        """A lane for queries that may wait for each other, but for no others."""
        self._lanes.append(lane := Lane(threads))
        return lane

    def serve(self, key: str, answer: Callable[[bytes, Reply], None], lane: Lane) -> None:
        """Answers the queries on a key.

        Args:
            key: The key. Below `@cmd` only a query on exactly this key is answered: a wildcard
                may reach many rigs, and a command is meant for one. A wildcard query of any other
                key is answered on this key.
            answer: Called with the payload and the function that sends the reply.
            lane: Where the queries wait for it.
        """

        def answer_exact(query: zenoh.Query, payload: bytes) -> None:
            asked = str(query.key_expr)
            if asked == key or "/@cmd/" not in key:
                answer(payload, partial(self._reply, query, key))

        self._declare(key, answer_exact, lane)

    def serve_below(
        self, key: str, answer: Callable[[str, bytes, Reply], None], lane: Lane
    ) -> None:
        """Answers the queries of one chunk below a key, unless that chunk is a wildcard.

        `answer` is called with the chunk, the payload, and the function that sends the reply.
        """

        def answer_chunk(query: zenoh.Query, payload: bytes) -> None:
            chunk = str(query.key_expr).rpartition("/")[2]
            if "*" not in chunk:
                answer(chunk, payload, partial(self._reply, query, f"{key}/{chunk}"))

        self._declare(f"{key}/*", answer_chunk, lane)

    def serve_many(
        self, pattern: str, answer: Callable[[str, bytes], Iterable[tuple[str, bytes]]], lane: Lane
    ) -> None:
        """Answers queries of many keys, each with any number of replies.

        Args:
            pattern: Wildcard expression of the keys. Others may answer some of them.
            answer: Replies, as key and data, to the key or wildcard asked for and the payload.
            lane: Where the queries wait for it.
        """

        def answer_all(query: zenoh.Query, payload: bytes) -> None:
            for key, data in answer(str(query.key_expr), payload):
                self._send(query, key, data)

        self._declare(pattern, answer_all, lane, complete=False)

    def announce(self, key: str) -> None:
        """Declares a liveliness token; last, when all queries are answered."""
        self._tokens[key] = self._session.liveliness().declare_token(key)  # dropped, it vanishes

    def withdraw(self, key: str) -> None:
        """Undeclares a liveliness token, if it is declared."""
        token = self._tokens.pop(key, None)
        if token is not None:
            with suppress(zenoh.ZError):
                token.undeclare()  # type: ignore[no-untyped-call]

    def publish(self, key: str, data: bytes) -> None:
        """Publishes; a subscriber that is too slow misses it."""
        with suppress(zenoh.ZError):
            self._session.put(
                key,
                data,
                congestion_control=zenoh.CongestionControl.DROP,
                attachment=self.instance,
            )

    def start(self, work: Callable[[], None]) -> None:
        """Starts a thread that ends by itself when the session is being closed."""
        thread = threading.Thread(target=work, daemon=True)
        self._threads.append(thread)
        thread.start()

    def close(self) -> None:
        """Closes the session and waits for its threads."""
        close_session(self._session)
        for lane in self._lanes:
            lane.close()
        for thread in self._threads:
            thread.join(_END_WITHIN_S)

    def _declare(self, key: str, handle: _Handle, lane: Lane, *, complete: bool = True) -> None:
        callback = zenoh.handlers.Callback(partial(lane.put, handle), indirect=False)
        declared = self._session.declare_queryable(key, callback, complete=complete)
        self._queryables.append(declared)

    def _reply(self, query: zenoh.Query, key: str, data: bytes) -> None:
        with query:  # the sender must not wait for what follows the reply
            self._send(query, key, data)

    def _send(self, query: zenoh.Query, key: str, data: bytes) -> None:
        try:
            query.reply(key, data, attachment=self.instance)
        except zenoh.ZError as error:
            _log.debug("no reply to %s: %s", key, error)


def _listen(
    endpoint: str, routers: tuple[str, ...], security: Security
) -> tuple[zenoh.Session, str]:
    """A listening session, and its endpoint with the port that was selected."""
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
                certificate = re.search(r"TLS listener.*?\. (.*?) at /", str(error))
                cause = re.search(r"([A-Z][a-z ]+) \(os error \d+\)", str(error))
                raise RigError(
                    f"cannot listen at {actual} with the certificate of --security: "
                    f"{certificate[1]}; make it as in docs/security.md"
                    if certificate and not cause
                    else f"cannot listen at {actual}: {cause[1].lower() if cause else error}; "
                    "choose another port, or port 0 for any free one"
                ) from error
        else:
            return session, actual
    raise AssertionError  # the last try has returned or raised
