"""A daemon over Zenoh: `serve_daemon` lets it be asked and told, `DaemonClient` does so."""

import logging
import secrets
import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any, Protocol, Self, TypeVar

import zenoh

from estune.errors import EstuneError, InvalidInput, RigError
from estune.remote.messages.daemon import (
    ANSWER_MAX_BYTES,
    ANY_DAEMON,
    VERBS,
    Command,
    CommandAnswer,
    DaemonKeys,
    DaemonStatus,
    DaemonVerb,
    EventMessage,
    Events,
    History,
    Request,
    decode_daemon,
    encode_daemon,
)
from estune.remote.security import OPEN, Security
from estune.remote.zenoh.discovery import reached
from estune.remote.zenoh.rig_connection import AGAIN_S
from estune.remote.zenoh.zenoh_session import (
    check_endpoint,
    check_loopback,
    close_session,
    open_listening,
)

ASK_S = 2.0
_WAITING_MAX = 256
_END_WITHIN_S = 1.0

_log = logging.getLogger(__name__)
_Message = TypeVar("_Message")


class Supervised(Protocol):
    """What the server needs of the supervision of one rig. Any thread may call; none may wait."""

    def status(self) -> DaemonStatus:
        """What is done now, and which gains are live."""
        ...

    def history(self, request: Request) -> History:
        """What was done."""
        ...

    def events(self, request: Request) -> Events:
        """What has happened."""
        ...

    def command(self, verb: DaemonVerb, command: Command) -> CommandAnswer:
        """Takes a command; it is carried out by another thread."""
        ...


class DaemonServer:
    """Answers for the keepers of several rigs. A context manager.

    Attributes:
        endpoint: Where it listens.
        instance: Identifies this start of the daemon.
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
        """Listens; nothing is answered before `serve`.

        Raises:
            InvalidInput: an endpoint cannot be used, or other machines could reach it.
            RigError: the endpoint is taken.
        """
        check_endpoint(endpoint)
        if not allow_remote:
            check_loopback(endpoint)
        self.instance = instance
        for router in routers:
            check_endpoint(router)
        self._session, self.endpoint = open_listening(endpoint, tuple(routers), security)
        self._threads: list[threading.Thread] = []
        self._tokens: list[zenoh.LivelinessToken] = []

    def serve(self, rigs: Mapping[str, Supervised]) -> None:
        """Begins to answer for rigs, by name."""
        for rig, supervised in rigs.items():
            keys = DaemonKeys(rig)
            for verb in VERBS:
                self._answer_at(keys.command(self.instance, verb), supervised)
            self._answer_at(f"{keys.root}/*", supervised)
            # Last, so that who finds it can ask it anything. Kept: dropped, it would vanish.
            token = self._session.liveliness().declare_token(keys.alive(self.instance))
            self._tokens.append(token)

    def show(self, message: DaemonStatus | EventMessage) -> None:
        """Publishes; whoever is too slow to take it in misses it."""
        what = "status" if isinstance(message, DaemonStatus) else "events"
        with suppress(zenoh.ZError):
            self._session.put(
                DaemonKeys(message.rig).about(what),  # type: ignore[arg-type]
                encode_daemon(message),
                congestion_control=zenoh.CongestionControl.DROP,
                attachment=self.instance,
            )

    def close(self) -> None:
        """Lets go of the endpoint."""
        close_session(self._session)
        for thread in self._threads:
            thread.join(_END_WITHIN_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _answer_at(self, key: str, supervised: Supervised) -> None:
        ring: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(_WAITING_MAX)
        queryable = self._session.declare_queryable(key, ring, complete=True)
        thread = threading.Thread(
            target=self._answer_all,
            args=(queryable, supervised),
            name=f"answer {key}",
            daemon=True,
        )
        self._threads.append(thread)
        thread.start()

    def _answer_all(self, queries: Any, supervised: Supervised) -> None:
        while True:
            try:
                query = queries.recv()
            except zenoh.ZError:
                return  # the session is closed
            self._answer(query, supervised)
            del query  # held on to, it would keep its sender waiting

    def _answer(self, query: zenoh.Query, supervised: Supervised) -> None:
        payload = b"" if query.payload is None else query.payload.to_bytes()
        try:
            answer = _answer_to(str(query.key_expr).split("/")[4:], payload, supervised)
        except EstuneError as error:
            answer = CommandAnswer(done=False, sentence=str(error))
        except Exception as error:  # noqa: BLE001  somebody waits for an answer
            _log.exception("no answer to %s", query.key_expr)
            answer = CommandAnswer(done=False, sentence=f"{type(error).__name__}: {error}")
        try:
            with query:
                if answer is not None:
                    query.reply(query.key_expr, encode_daemon(answer), attachment=self.instance)
        except (zenoh.ZError, EstuneError) as error:
            _log.debug("no answer to %s: %s", query.key_expr, error)


def _answer_to(words: list[str], payload: bytes, supervised: Supervised) -> Any:
    match words:
        case ["@cmd", _, verb]:
            return supervised.command(verb, decode_daemon(Command, payload))  # type: ignore[arg-type]
        case ["status"]:
            return supervised.status()
        case ["history"]:
            return supervised.history(decode_daemon(Request, payload or b"{}"))
        case ["events"]:
            return supervised.events(decode_daemon(Request, payload or b"{}"))
    return None  # somebody looks around with a wildcard


class DaemonClient:
    """Asks a daemon, and tells it what to do. A context manager."""

    def __init__(
        self, endpoint: str, timeout_s: float = 3.0, *, security: Security = OPEN
    ) -> None:
        """Connects.

        Raises:
            InvalidInput: the endpoint is not one.
            RigError: nothing listens there.
        """
        check_endpoint(endpoint)
        self.endpoint = endpoint
        self._timeout_s = timeout_s
        how = "a daemon with: estune daemon CONFIG"
        self._session = reached(
            *(endpoint, 2 * ANSWER_MAX_BYTES, security, time.monotonic() + timeout_s, how)
        )

    def rigs(self) -> tuple[str, ...]:
        """The rigs that are supervised, by name."""
        return tuple(sorted({rig for rig, _ in self._present(ANY_DAEMON)}))

    def status(self, rig: str) -> DaemonStatus:
        """What is done with a rig.

        Raises:
            RigError: no daemon answers for it.
        """
        return self._about(DaemonStatus, rig, "status", b"")

    def history(self, rig: str, limit: int = 50) -> History:
        """What was done with a rig.

        Raises:
            RigError: no daemon answers for it.
        """
        return self._about(History, rig, "history", encode_daemon(Request(limit=limit)))

    def events(self, rig: str, after: int = -1, limit: int = 50) -> list[EventMessage]:
        """What has happened with a rig.

        Raises:
            RigError: no daemon answers for it.
        """
        request = encode_daemon(Request(after, limit))
        return self._about(Events, rig, "events", request).events

    def command(self, rig: str, verb: DaemonVerb, who: str, why: str = "") -> str:
        """Tells the daemon what to do with a rig.

        Returns:
            What is being done.

        Raises:
            InvalidInput: it is refused.
            RigError: no daemon answers for the rig.
        """
        message = encode_daemon(Command(secrets.token_hex(8), who, why))

        def key() -> str:
            return DaemonKeys(rig).command(self._instance(rig), verb)

        answer = decode_daemon(CommandAnswer, self._ask(rig, key, message))
        if not answer.done:
            raise InvalidInput(f"rig {rig}: {answer.sentence}")
        return answer.sentence

    def close(self) -> None:
        """Lets go of the daemon."""
        close_session(self._session)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _about(self, kind: type[_Message], rig: str, what: Any, message: bytes) -> _Message:
        data = self._ask(rig, lambda: DaemonKeys(rig).about(what), message)
        if data.startswith(b'{"done"'):
            raise RigError(decode_daemon(CommandAnswer, data).sentence)
        return decode_daemon(kind, data)

    def _ask(self, rig: str, key: Any, message: bytes) -> bytes:
        deadline_s = time.monotonic() + self._timeout_s
        while True:
            for reply in self._session.get(
                key(),
                payload=message,
                timeout=ASK_S,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
            ):
                if reply.ok is not None:
                    return reply.ok.payload.to_bytes()
            if time.monotonic() > deadline_s:
                raise RigError(self._nobody(rig))
            time.sleep(AGAIN_S)

    def _instance(self, rig: str) -> str:
        found = [instance for _, instance in self._present(DaemonKeys(rig).alive("*"))]
        if len(found) > 1:
            raise RigError(
                f"{len(found)} daemons say that they supervise rig {rig!r}; stop all but one"
            )
        if not found:
            raise RigError(self._nobody(rig))
        return found[0]

    def _nobody(self, rig: str) -> str:
        others = ", ".join(self.rigs())
        there = f"; there is: {others}" if others else ""
        return f"no daemon at {self.endpoint} answers for rig {rig!r}{there}"

    def _present(self, key: str) -> set[tuple[str, str]]:
        replies = self._session.liveliness().get(key, timeout=ASK_S)
        words = [str(reply.ok.key_expr).split("/") for reply in replies if reply.ok is not None]
        return {(word[2], word[5]) for word in words}
