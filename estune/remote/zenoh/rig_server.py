"""Serves a rig over Zenoh."""

import atexit
import logging
import math
import secrets
import threading
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from estune.errors import EstuneError, InvalidInput
from estune.remote import messages
from estune.remote.ledger import FileLedger, Ledger, MemoryLedger
from estune.remote.messages import VERBS, Inquire, Keys
from estune.remote.security import OPEN, Security
from estune.remote.zenoh.listening_session import ListeningSession, Reply
from estune.remote.zenoh.message_dispatcher import CommandListener
from estune.remote.zenoh.request_handler import RequestHandler
from estune.support.closing import Closing
from estune.trial import Rig

SHOW_S = 0.05
"""Publication interval of live samples, s."""

_STATUS_REST_S = 0.02  # changes faster than this are published as one

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
    heard: CommandListener = lambda *_: None,
) -> "RigServer":
    """Serves a rig until the server is closed.

    One client at a time holds the lease, and one trial at a time runs. Another client is refused
    with the name of the holder.

    Args:
        rig: The rig. Closing the server does not close it.
        endpoint: Where to listen; port 0 selects a free one, see `RigServer.endpoint`.
        ledger: File of the trials that have run. None keeps them in memory, which suffices for a
            simulated rig.
        routers: Endpoints of Zenoh routers to connect to as well, through which clients may find
            the rig among others.
        allow_remote: Whether to listen where other machines can connect. Without `security`,
            every client that reaches the endpoint can move the rig.
        security: Users and their rights.
        part_bytes: Size of the parts in which records are sent, as by a small board; 0 sends them
            whole.
        heard: Called with the verb, payload and reply of each command, after the reply.

    Raises:
        InvalidInput: an endpoint or the rig's name cannot be used, other machines could reach the
            endpoint, or a rig that moves has no ledger.
        RigError: the endpoint is in use, or the ledger cannot be used.
    """
    description = rig.describe()
    keys = Keys(description.name)
    if ledger is None and not description.simulated:
        raise InvalidInput(
            f"rig {keys.rig!r} moves: name a ledger file, which stores over a restart what "
            "trials have run, so that none runs twice"
        )
    session = ListeningSession(
        endpoint,
        instance=secrets.token_hex(4),
        routers=routers,
        allow_remote=allow_remote,
        security=security,
    )
    try:
        book = MemoryLedger() if ledger is None else FileLedger(ledger, keys.rig)
    except BaseException:
        session.close()
        raise
    return RigServer(rig, keys, book, session, part_bytes=part_bytes, heard=heard)


class RigServer(Closing):
    """A rig being served. A context manager; made by `serve`."""

    def __init__(
        self,
        rig: Rig,
        keys: Keys,
        ledger: Ledger,
        session: ListeningSession,
        *,
        part_bytes: int,
        heard: CommandListener,
    ) -> None:
        self.endpoint = session.endpoint
        self.name = keys.rig
        self.instance = session.instance
        self._keys = keys
        self._ledger = ledger
        self._session = session
        self._closed = threading.Event()
        self._closing = threading.Event()
        self._status_changed = threading.Event()
        self._handler: RequestHandler | None = None
        # None of the server's threads keeps the interpreter from getting there.
        atexit.register(self.close)
        try:
            self._handler = RequestHandler(
                *(rig, ledger, self._status_changed.set),
                instance=self.instance,
                part_bytes=part_bytes,
                heard=heard,
            )
            self._declare(self._handler)
        except BaseException:
            self.close()
            raise

    @property
    def closed(self) -> bool:
        """Whether it is closed."""
        return self._closed.is_set()

    def wait(self, within_s: float = math.inf) -> bool:
        """Returns when the server is closed, or after a time, and whether it is."""
        return self._closed.wait(None if math.isinf(within_s) else within_s)

    def fail(self, reason: str) -> None:
        """Tells the clients why the rig's program ends; `close` follows."""
        self._session.publish(self._keys.failure, messages.encode(messages.Failure(reason)))

    def close(self) -> None:
        """Stops the active trial, if any, and releases the endpoint and the ledger."""
        atexit.unregister(self.close)
        if self._handler is not None:
            self._handler.close()
        self._closing.set()
        self._status_changed.set()
        self._session.close()
        self._ledger.close()
        self._closed.set()

    def _declare(self, handler: RequestHandler) -> None:
        # A client that is slow to receive a large record delays no command, a trial or a slow
        # disk neither a renewal nor an emergency stop.
        session, keys = self._session, self._keys
        commands, queries = session.lane(), session.lane(threads=2)
        for name, verb in VERBS.items():
            own = session.lane(verb.threads) if verb.threads else commands
            session.serve(keys.command(self.instance, name), partial(handler.command, name), own)

        def result(trial_id: str, payload: bytes, reply: Reply) -> None:
            def answer() -> messages.Answer | bytes:
                return handler.result(trial_id, messages.decode(Inquire, payload))

            handler.query(answer, reply)

        session.serve(
            keys.status,
            lambda asked, reply: handler.query(partial(handler.status, asked), reply),
            queries,
        )
        session.serve(
            keys.describe, lambda _, reply: handler.query(handler.describe, reply), queries
        )
        session.serve_below(keys.result("").rstrip("/"), result, queries)
        is_watched = session.audience(keys.telemetry("*"), self._status_changed.set)
        session.start(partial(self._publish, handler, is_watched))
        session.announce(keys.alive(self.instance))

    def _publish(self, handler: RequestHandler, is_watched: Callable[[], bool]) -> None:
        """Publishes changes of the status, and during a trial its samples, if anyone subscribes.

        Of changes within a few milliseconds, the last is published.
        """
        shown, after = "", 0
        while not self._closing.is_set():
            is_shown = handler.is_showing and is_watched()
            if self._status_changed.wait(SHOW_S if is_shown else None):
                self._status_changed.clear()
                self._session.publish(self._keys.status, messages.encode(handler.status()))
                self._closing.wait(_STATUS_REST_S)
                continue
            try:
                samples = handler.telemetry(after)
                if samples is not None and samples.trial_id != shown:
                    shown, after = samples.trial_id, 0
                    samples = handler.telemetry(after)
                # A subscriber that comes late is shown the newest samples.
                if samples is not None and samples.tension_N.size > messages.LIVE_MAX_SAMPLES:
                    after += samples.tension_N.size - messages.LIVE_MAX_SAMPLES
                    samples = handler.telemetry(after)
            except EstuneError as error:
                _log.debug("no live samples: %s", error)
                continue
            if samples is not None and samples.tension_N.size:
                self._session.publish(self._keys.telemetry(shown), messages.encode_live(samples))
                after = samples.first_sample + min(
                    samples.tension_N.size, messages.LIVE_MAX_SAMPLES
                )
