"""Serves a rig over Zenoh."""

import atexit
import logging
import secrets
import threading
from collections.abc import Callable, Iterable
from functools import partial
from typing import Self

import zenoh

from estune import protocol
from estune.bus.attendant import Attendant, named
from estune.bus.session import (
    COMMANDS_MAX_BYTES,
    check_endpoint,
    check_loopback,
    close_session,
    listen_error,
    open_session,
    with_port,
)
from estune.protocol import Cancel, Description, Inquire, Keys, SetGains, Submit
from estune.trial import Rig

_PORT_TRIES = 5
_WAITING_MAX = 256
_END_WITHIN_S = 1.0

_log = logging.getLogger(__name__)
_Reply = Callable[[object], None]


def serve(
    rig: Rig,
    endpoint: str = "tcp/127.0.0.1:0",
    *,
    routers: Iterable[str] = (),
    allow_remote: bool = False,
) -> "RigServer":
    """Makes a rig reachable, until the server is closed.

    One trial runs at a time. A second client that submits meanwhile is told so by an error, and
    does not wait: it could not know for how long.

    Args:
        rig: The rig. It stays the caller's: closing the server does not close it.
        endpoint: Where to listen; port 0 picks a free one, see `RigServer.endpoint`.
        routers: Endpoints of Zenoh routers to be joined as well, through which clients may find
            the rig among others.
        allow_remote: Whether to listen where other machines can reach it. Nobody is asked for a
            password: whoever reaches the endpoint can move the rig.

    Raises:
        InvalidInput: an endpoint or the rig's name cannot be used, or other machines could reach
            the endpoint.
        RigError: the endpoint is taken.
    """
    check_endpoint(endpoint)
    routers = tuple(routers)
    for router in routers:
        check_endpoint(router)
    if not allow_remote:
        check_loopback(endpoint)
    keys = Keys(rig.describe().name)
    return RigServer(rig, keys, *_listen(endpoint, routers))


def _listen(endpoint: str, routers: tuple[str, ...]) -> tuple[zenoh.Session, str]:
    """A session that listens, and where it does."""
    for tries_left in reversed(range(_PORT_TRIES)):
        actual = with_port(endpoint)
        try:
            session = open_session(
                "peer", listen=(actual,), connect=routers, message_max_bytes=COMMANDS_MAX_BYTES
            )
        except zenoh.ZError as error:
            # Another process may have taken the free port in between.
            if actual == endpoint or not tries_left:
                raise listen_error(actual, error) from error
        else:
            return session, actual
    raise AssertionError  # the last try has returned or raised


class RigServer:
    """A rig being served. A context manager; made by `serve`.

    Attributes:
        endpoint: Where it listens.
        name: Name of the rig.
        instance: Identifies this start of the server.
    """

    def __init__(self, rig: Rig, keys: Keys, session: zenoh.Session, endpoint: str) -> None:
        self.endpoint = endpoint
        self.name = keys.rig
        self.instance = secrets.token_hex(4)
        self._keys = keys
        self._session = session
        self._closed = threading.Event()
        self._threads: list[threading.Thread] = []
        self._attendant = Attendant(rig, self._publish_status)
        # No thread of ours keeps the interpreter from getting there.
        atexit.register(self.close)
        try:
            self._declare()
        except BaseException:
            self.close()
            raise

    def wait(self) -> None:
        """Returns when the server is closed; Ctrl-C gets through."""
        self._closed.wait()

    def close(self) -> None:
        """Stops the trial under way, if any, and lets go of the endpoint."""
        atexit.unregister(self.close)
        self._attendant.close()
        close_session(self._session)
        # The interpreter must not shut down under a thread that is inside Zenoh: it would abort.
        for thread in self._threads:
            thread.join(_END_WITHIN_S)
        self._closed.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _declare(self) -> None:
        # Two threads take the commands in: one may be running a trial. Questions have a third,
        # so that no client that is slow to take in a large record keeps another's `cancel`
        # waiting. Rings: where clients flood the rig, the oldest queries are dropped (their
        # senders ask again), and Zenoh's own threads never wait for ours.
        command = self._keys.command(self.instance, "*")
        for key, threads in ((command, 2), (self._keys.anything, 1)):
            ring: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(
                _WAITING_MAX
            )
            queryable = self._session.declare_queryable(key, ring, complete=True)
            for _ in range(threads):
                thread = threading.Thread(target=self._answer_all, args=(queryable,), daemon=True)
                self._threads.append(thread)
                thread.start()
        # Last, so that who finds the rig can ask it anything. Kept: dropped, it would vanish.
        self._token = self._session.liveliness().declare_token(self._keys.alive(self.instance))

    def _answer_all(self, queries: "zenoh.Queryable[zenoh.Handler[zenoh.Query]]") -> None:
        while True:
            try:
                query = queries.recv()
            except zenoh.ZError:
                return  # the session is closed
            self._answer(query)
            del query  # held on to, it would keep its sender waiting

    def _answer(self, query: zenoh.Query) -> None:
        key = str(query.key_expr)
        payload = b"" if query.payload is None else query.payload.to_bytes()
        reply = partial(self._reply, query)
        try:
            self._act(key.split("/")[3:], payload, reply)
        except BaseException as error:  # noqa: BLE001  even SystemExit: somebody waits for it
            reply(protocol.refusal(named(error, key)))

    def _act(self, key: list[str], payload: bytes, reply: _Reply) -> None:
        """Does what is asked. The key begins after the rig's name."""
        attendant = self._attendant
        match key:
            case ["@cmd", _, "submit"]:
                attendant.submit(protocol.decode(Submit, payload), reply)
            case ["@cmd", _, "cancel"]:
                reply(attendant.cancel(protocol.decode(Cancel, payload)))
            case ["@cmd", _, "gains"]:
                reply(attendant.set_gains(protocol.decode(SetGains, payload)))
            case ["result", trial_id]:
                inquiry = protocol.decode(Inquire, payload)
                reply(attendant.result(trial_id, inquiry.digest))
            case ["status"]:
                reply(attendant.status())
            case ["describe"]:
                reply(Description(attendant.describe(), self.instance))
            case _:
                pass  # somebody looks around with a wildcard, or asks for what does not exist

    def _reply(self, query: zenoh.Query, message: object) -> None:
        data = message if isinstance(message, bytes) else protocol.encode(message)
        try:
            with query:  # left undropped, it would keep its sender waiting
                query.reply(query.key_expr, data, attachment=self.instance)
        except zenoh.ZError as error:
            _log.debug("no answer to %s: %s", query.key_expr, error)

    def _publish_status(self) -> None:
        """Tells whoever waits for a trial that one has ended."""
        try:
            self._session.put(self._keys.status, protocol.encode(self._attendant.status()))
        except zenoh.ZError as error:
            _log.debug("nobody told that a trial has ended: %s", error)
