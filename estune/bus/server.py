"""Serves a rig over Zenoh."""

import atexit
import logging
import secrets
import threading
from collections.abc import Callable, Iterable
from queue import Full, Queue
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

_log = logging.getLogger(__name__)
_Answerer = Callable[[str, bytes], bytes]


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
        self._closed.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _declare(self) -> None:
        # Commands and questions wait in lanes of their own, so that no client that is slow to
        # take in a large record keeps another's `cancel` waiting.
        commands, questions = self._lane("commands"), self._lane("questions")
        for key, answer, lane in (
            (self._keys.command(self.instance, "submit"), self._submit, commands),
            (self._keys.command(self.instance, "cancel"), self._cancel, commands),
            (self._keys.command(self.instance, "gains"), self._set_gains, commands),
            (self._keys.result("*"), self._result, questions),
            (self._keys.status, self._status, questions),
            (self._keys.describe, self._describe, questions),
        ):
            # Zenoh's own thread only puts the query into the lane: it must never wait.
            enqueue = zenoh.handlers.Callback(_into(lane, answer), indirect=False)
            self._session.declare_queryable(key, enqueue, complete=True)
        # Last, so that who finds the rig can ask it anything. Kept: dropped, it would vanish.
        self._token = self._session.liveliness().declare_token(self._keys.alive(self.instance))

    def _lane(self, name: str) -> "Queue[tuple[zenoh.Query, _Answerer]]":
        lane: Queue[tuple[zenoh.Query, _Answerer]] = Queue(_WAITING_MAX)
        threading.Thread(target=self._answer_all, args=(lane,), name=name, daemon=True).start()
        return lane

    def _answer_all(self, lane: "Queue[tuple[zenoh.Query, _Answerer]]") -> None:
        while True:
            query, answer = lane.get()
            try:
                # Left undropped, a query keeps its sender waiting until it times out.
                with query:
                    self._answer(query, answer)
            except zenoh.ZError as error:
                if self._session.is_closed():
                    return
                _log.warning("no answer to %s: %s", query.key_expr, error)
            del query, answer

    def _answer(self, query: zenoh.Query, answer: _Answerer) -> None:
        key = str(query.key_expr)
        if "*" in key:
            return  # somebody looks around; there is nothing to answer as one
        payload = b"" if query.payload is None else query.payload.to_bytes()
        try:
            data = answer(key, payload)
        except Exception as error:  # noqa: BLE001  what a rig raises must reach the one who waits
            data = protocol.encode(protocol.refusal(named(error, key)))
        query.reply(query.key_expr, data, attachment=self.instance)

    def _submit(self, _: str, payload: bytes) -> bytes:
        return _encode(self._attendant.submit(protocol.decode(Submit, payload)))

    def _cancel(self, _: str, payload: bytes) -> bytes:
        return _encode(self._attendant.cancel(protocol.decode(Cancel, payload)))

    def _set_gains(self, _: str, payload: bytes) -> bytes:
        return _encode(self._attendant.set_gains(protocol.decode(SetGains, payload)))

    def _result(self, key: str, payload: bytes) -> bytes:
        trial_id = key.rpartition("/")[2]
        return _encode(self._attendant.result(trial_id, protocol.decode(Inquire, payload).digest))

    def _status(self, _: str, __: bytes) -> bytes:
        return protocol.encode(self._attendant.status())

    def _describe(self, _: str, __: bytes) -> bytes:
        return protocol.encode(Description(self._attendant.describe(), self.instance))

    def _publish_status(self) -> None:
        """Tells whoever waits for a trial that one has ended."""
        try:
            self._session.put(self._keys.status, protocol.encode(self._attendant.status()))
        except zenoh.ZError:
            _log.debug("nobody to tell: the session is closed")


def _into(
    lane: "Queue[tuple[zenoh.Query, _Answerer]]", answer: _Answerer
) -> Callable[[zenoh.Query], None]:
    def enqueue(query: zenoh.Query) -> None:
        try:
            lane.put_nowait((query, answer))
        except Full:
            query.drop()  # type: ignore[no-untyped-call]  # an empty reply; the client asks again

    return enqueue


def _encode(state: protocol.Answer | bytes) -> bytes:
    return state if isinstance(state, bytes) else protocol.encode(state)
