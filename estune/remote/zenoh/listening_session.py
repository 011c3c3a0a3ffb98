"""A session that listens: queries answered in lanes, publications, liveliness tokens."""

import logging
import re
import threading
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from functools import partial
from queue import Empty, SimpleQueue

import zenoh

from estune.errors import RigError
from estune.remote.messages.rights import Right
from estune.remote.security import OPEN, Security, Tls
from estune.remote.zenoh.endpoints import check_endpoint, check_listener, with_port
from estune.remote.zenoh.local_endpoints import EndpointNote
from estune.remote.zenoh.tls_front import InnerEndpoints, TlsFront, listener_context
from estune.remote.zenoh.zenoh_session import COMMANDS_MAX_BYTES, close_session, open_session

Reply = Callable[[bytes], None]
"""Sends the reply to a query; must be called at most once."""

_Handle = Callable[[zenoh.Query, bytes], None]

_END_WITHIN_S = 1.0
_PORT_TRIES = 5  # another process may take the free port before Zenoh does
_WAITING_MAX = 256  # a flood costs its own senders their replies, and no memory
_log = logging.getLogger(__name__)


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

    def put(self, handle: _Handle, query: zenoh.Query) -> None:
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


class ListeningSession:
    """A session that listens, answers queries in lanes, and publishes.

    Behind a TLS front it is one session for each right, as a session knows nothing of the
    certificates there; all serve the same.

    Attributes:
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
        check_listener(endpoint, security, allow_remote=allow_remote)
        for each in routers:
            check_endpoint(each)
            security.check_endpoint(each)
        self.instance = instance
        self._front: TlsFront | None = None
        if security.tls is not None and endpoint.startswith("tls/"):
            self._sessions, self._front = _listen_behind_front(
                endpoint, routers, security, security.tls
            )
            self.endpoint = self._front.endpoint
        else:
            if security.tls is not None:  # quic, whose handshake is Zenoh's own
                listener_context(endpoint, security.tls)
            session, self.endpoint = _listen(endpoint, routers, security)
            self._sessions = (session,)
        self._note = EndpointNote(self.endpoint)
        self._threads: list[threading.Thread] = []
        self._lanes: list[Lane] = []
        self._queryables: list[zenoh.Queryable[None]] = []
        self._audiences: list[zenoh.MatchingListener[None]] = []
        self._tokens: dict[str, list[zenoh.LivelinessToken]] = {}

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
        self._tokens[key] = [  # dropped, they vanish
            session.liveliness().declare_token(key) for session in self._sessions
        ]

    def withdraw(self, key: str) -> None:
        """Undeclares a liveliness token, if it is declared."""
        for token in self._tokens.pop(key, ()):
            with suppress(zenoh.ZError):
                token.undeclare()  # type: ignore[no-untyped-call]

    def publish(self, key: str, data: bytes) -> None:
        """Publishes; a subscriber that is too slow misses it."""
        for session in self._sessions:
            with suppress(zenoh.ZError):
                session.put(
                    key,
                    data,
                    congestion_control=zenoh.CongestionControl.DROP,
                    attachment=self.instance,
                )

    def audience(self, key: str, changed: Callable[[], None]) -> Callable[[], bool]:
        """A function that tells whether anyone subscribes to a key, or to some of a wildcard.

        `changed` is called whenever that changes, in a thread of the network that must not wait.
        """
        publishers = [session.declare_publisher(key) for session in self._sessions]

        def receive(_: zenoh.MatchingStatus) -> None:
            changed()

        callback = zenoh.handlers.Callback(receive, indirect=False)
        self._audiences += [one.declare_matching_listener(callback) for one in publishers]
        return lambda: any(one.matching_status.matching for one in publishers)  # type: ignore[attr-defined]

    def start(self, work: Callable[[], None]) -> None:
        """Starts a thread that ends by itself when the session is being closed."""
        thread = threading.Thread(target=work, daemon=True)
        self._threads.append(thread)
        thread.start()

    def close(self) -> None:
        """Closes the session and waits for its threads."""
        self._note.close()
        if self._front is not None:
            self._front.close()
        for session in self._sessions:
            close_session(session)
        for lane in self._lanes:
            lane.close()
        for thread in self._threads:
            thread.join(_END_WITHIN_S)

    def _declare(self, key: str, handle: _Handle, lane: Lane, *, complete: bool = True) -> None:
        callback = zenoh.handlers.Callback(partial(lane.put, handle), indirect=False)
        self._queryables += [
            session.declare_queryable(key, callback, complete=complete)
            for session in self._sessions
        ]

    def _reply(self, query: zenoh.Query, key: str, data: bytes) -> None:
        with query:  # the sender must not wait for what follows the reply
            self._send(query, key, data)

    def _send(self, query: zenoh.Query, key: str, data: bytes) -> None:
        try:
            query.reply(key, data, attachment=self.instance)
        except zenoh.ZError as error:
            _log.debug("no reply to %s: %s", key, error)


def _listen_behind_front(
    endpoint: str, routers: tuple[str, ...], security: Security, tls: Tls
) -> tuple[tuple[zenoh.Session, ...], TlsFront]:
    """Sessions that only a TLS front reaches, one for each right, and the front."""
    front = TlsFront(endpoint, tls, InnerEndpoints(security))
    with ExitStack() as opened:
        opened.callback(front.close)
        sessions = []
        for right, path in front.inner.paths.items():
            session = open_session(
                "peer",
                listen=(f"unixsock-stream/{path}",),
                connect=routers if right is Right.COMMAND else (),  # they show it once
                message_max_bytes=COMMANDS_MAX_BYTES,
                security=security,
                of_front=right,
            )
            opened.callback(close_session, session)
            sessions.append(session)
        opened.pop_all()
    return tuple(sessions), front


def _listen(
    endpoint: str, routers: tuple[str, ...], security: Security
) -> tuple[zenoh.Session, str]:
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
                    f"{certificate[1]}; make it anew (estune docs security)"
                    if certificate and not cause
                    else f"cannot listen at {actual}: {cause[1].lower() if cause else error}; "
                    "choose another port, or port 0 for any free one"
                ) from error
        else:
            return session, actual
    raise AssertionError  # the last try has returned or raised
