"""Serves a rig over Zenoh."""

import atexit
import logging
import secrets
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Self

import zenoh

from estune.errors import EstuneError, InvalidInput
from estune.remote import messages
from estune.remote.ledger import FileLedger, Ledger, MemoryLedger
from estune.remote.messages import Keys
from estune.remote.messages.keys import Verb
from estune.remote.security import OPEN, Security
from estune.remote.zenoh.dispatcher import MessageDispatcher
from estune.remote.zenoh.request_handler import RequestHandler
from estune.remote.zenoh.zenoh_session import (
    check_endpoint,
    check_loopback,
    close_session,
    open_listening,
)
from estune.trial import Rig

SHOW_S = 0.05
"""How often samples of a trial under way are shown."""

_WAITING_MAX = 256
_END_WITHIN_S = 1.0
_STATUS_REST_S = 0.02

# One thread answers questions: no client that is slow to take in a large record keeps another's
# command waiting. Two take trials in, as one may be running a trial. The lease and the emergency
# stop wait for nobody.
VERBS: dict[Verb, int] = {
    "estop": 1,
    "lease": 1,
    "submit": 2,
    "cancel": 1,
    "void": 1,
    "gains": 1,
    "clear": 1,
}
"""The commands, and how many threads answer each."""

_log = logging.getLogger(__name__)


def serve(
    rig: Rig,
    endpoint: str = "tcp/127.0.0.1:0",
    *,
    ledger: Path | None = None,
    routers: Iterable[str] = (),
    allow_remote: bool = False,
    security: Security = OPEN,
    part_bytes: int = 0,
) -> "RigServer":
    """Makes a rig reachable, until the server is closed.

    One client at a time commands it, and one trial at a time runs. Another client is told who
    holds the rig, and does not wait: it could not know for how long.

    Args:
        rig: The rig. It stays the caller's: closing the server does not close it.
        endpoint: Where to listen; port 0 picks a free one, see `RigServer.endpoint`.
        ledger: The file in which it is remembered which trials have run. None remembers it for as
            long as the process lives, which will do for a simulated rig.
        routers: Endpoints of Zenoh routers to be joined as well, through which clients may find
            the rig among others.
        allow_remote: Whether to listen where other machines can reach it. Without `security`
            whoever reaches the endpoint can move the rig.
        security: Who may reach and command it.
        part_bytes: Records are answered in parts of so many bytes, as a small board does; 0
            answers them whole.

    Raises:
        InvalidInput: an endpoint or the rig's name cannot be used, other machines could reach the
            endpoint, or a rig that moves has no ledger.
        RigError: the endpoint is taken, or the ledger cannot be used.
    """
    check_endpoint(endpoint)
    routers = tuple(routers)
    for router in routers:
        check_endpoint(router)
    if not allow_remote:
        check_loopback(endpoint)
    description = rig.describe()
    keys = Keys(description.name)
    if ledger is None and not description.simulated:
        raise InvalidInput(
            f"rig {keys.rig!r} moves: name a ledger file, which remembers over a restart what "
            "trials it has run, so that none runs twice"
        )
    book = MemoryLedger() if ledger is None else FileLedger(ledger, keys.rig)
    try:
        return RigServer(
            rig, keys, book, *open_listening(endpoint, routers, security), part_bytes=part_bytes
        )
    except BaseException:
        book.close()
        raise


class RigServer:
    """A rig being served. A context manager; made by `serve`.

    Attributes:
        endpoint: Where it listens.
        name: Name of the rig.
        instance: Identifies this start of the server.
    """

    def __init__(
        self,
        rig: Rig,
        keys: Keys,
        ledger: Ledger,
        session: zenoh.Session,
        endpoint: str,
        *,
        part_bytes: int,
    ) -> None:
        self.endpoint = endpoint
        self.name = keys.rig
        self.instance = secrets.token_hex(4)
        self._keys = keys
        self._ledger = ledger
        self._session = session
        self._closed = threading.Event()
        self._closing = threading.Event()
        self._news = threading.Event()
        self._threads: list[threading.Thread] = []
        self._attendant = RequestHandler(rig, ledger, self._news.set)
        self._desk = MessageDispatcher(self._attendant, self.instance, ledger.identity, part_bytes)
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
        """Stops the trial under way, if any, and lets go of the endpoint and the ledger."""
        atexit.unregister(self.close)
        self._attendant.close()
        self._closing.set()
        self._news.set()
        close_session(self._session)
        # The interpreter must not shut down under a thread that is inside Zenoh: it would abort.
        for thread in self._threads:
            thread.join(_END_WITHIN_S)
        self._ledger.close()
        self._closed.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _declare(self) -> None:
        for verb, threads in VERBS.items():
            self._answer_at(self._keys.command(self.instance, verb), threads)
        self._answer_at(self._keys.anything, 1)
        for work in (self._publish_status, self._publish_telemetry):
            self._begin(work)
        # Last, so that who finds the rig can ask it anything. Kept: dropped, it would vanish.
        self._token = self._session.liveliness().declare_token(self._keys.alive(self.instance))

    def _answer_at(self, key: str, threads: int) -> None:
        # Rings: where clients flood the rig, the oldest queries are dropped (their senders ask
        # again), and Zenoh's own threads never wait for ours.
        ring: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(_WAITING_MAX)
        queryable = self._session.declare_queryable(key, ring, complete=True)
        for _ in range(threads):
            self._begin(partial(self._answer_all, queryable))

    def _begin(self, work: Callable[[], None]) -> None:
        thread = threading.Thread(target=work, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _answer_all(self, queries: "zenoh.Queryable[zenoh.Handler[zenoh.Query]]") -> None:
        while True:
            try:
                query = queries.recv()
            except zenoh.ZError:
                return  # the session is closed
            self._answer(query)
            del query  # held on to, it would keep its sender waiting

    def _answer(self, query: zenoh.Query) -> None:
        words = str(query.key_expr).split("/")[3:]
        payload = b"" if query.payload is None else query.payload.to_bytes()
        self._desk.answer(words, payload, partial(self._reply, query))

    def _reply(self, query: zenoh.Query, data: bytes) -> None:
        try:
            with query:  # left undropped, it would keep its sender waiting
                query.reply(query.key_expr, data, attachment=self.instance)
        except zenoh.ZError as error:
            _log.debug("no answer to %s: %s", query.key_expr, error)

    def _publish_status(self) -> None:
        """Shows each change; of changes within a few milliseconds, the last."""
        while not self._closing.is_set():
            self._news.wait()
            self._news.clear()
            self._put(self._keys.status, messages.encode(self._attendant.status(self.instance)))
            self._closing.wait(_STATUS_REST_S)

    def _publish_telemetry(self) -> None:
        shown, after = "", 0
        while not self._closing.wait(SHOW_S):
            try:
                samples = self._attendant.telemetry(after)
                if samples is not None and samples.trial_id != shown:
                    shown, after = samples.trial_id, 0
                    samples = self._attendant.telemetry(after)
            except EstuneError as error:
                _log.debug("no samples to show: %s", error)
                continue
            if samples is not None and samples.tension_N.size:
                self._put(self._keys.telemetry(shown), messages.encode_live(samples))
                after = samples.first + min(samples.tension_N.size, messages.LIVE_MAX_SAMPLES)

    def _put(self, key: str, data: bytes) -> None:
        """Publishes; whoever is too slow to take it in misses it."""
        with suppress(zenoh.ZError):
            self._session.put(
                key,
                data,
                congestion_control=zenoh.CongestionControl.DROP,
                attachment=self.instance,
            )
