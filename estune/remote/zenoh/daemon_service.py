"""A daemon over Zenoh: `DaemonServer` answers queries and commands, `DaemonClient` sends them."""

import logging
import secrets
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Literal, Protocol, Self, TypeVar

import zenoh

from estune.errors import EstuneError, InvalidInput, RigError
from estune.remote.messages.codec import Message, decode, encode
from estune.remote.messages.daemon import (
    ANSWER_MAX_BYTES,
    ANY_DAEMON,
    DAEMON_VERBS,
    Command,
    CommandAnswer,
    DaemonKeys,
    DaemonStatus,
    DaemonVerb,
    EventMessage,
    Events,
    History,
    Request,
)
from estune.remote.security import OPEN, Security
from estune.remote.zenoh.endpoints import check_endpoint
from estune.remote.zenoh.zenoh_session import (
    AGAIN_S,
    ListeningSession,
    Reply,
    close_session,
    open_client,
)

ASK_S = 2.0

_log = logging.getLogger(__name__)
_Reply = TypeVar("_Reply", bound=Message)


class Supervised(Protocol):
    """The supervision of one rig, as the server sees it. Any thread may call; none may wait."""

    def status(self) -> DaemonStatus:
        """Current state, with the live gains."""
        ...

    def history(self, request: Request) -> History:
        """Past gain sets, commands and check trials."""
        ...

    def events(self, request: Request) -> Events:
        """Past events."""
        ...

    def command(self, verb: DaemonVerb, command: Command) -> CommandAnswer:
        """Accepts a command; another thread executes it."""
        ...


class DaemonServer:
    """Serves the supervisors of several rigs; nothing is answered before `serve`.

    Attributes:
        endpoint: Where it listens.
    """

    def __init__(self, session: ListeningSession) -> None:
        """Takes over the session: `close` closes it."""
        self.endpoint = session.endpoint
        self._session = session

    def serve(self, rigs: Mapping[str, Supervised]) -> None:
        """Starts to serve rigs, by name."""
        for rig, supervised in rigs.items():
            keys = DaemonKeys(rig)
            for verb in DAEMON_VERBS:
                command = partial(_execute, supervised, verb)
                self._serve(keys.command(self._session.instance, verb), command)
            self._serve(keys.about("status"), partial(_status, supervised))
            self._serve(keys.about("history"), partial(_rows, supervised.history))
            self._serve(keys.about("events"), partial(_rows, supervised.events))
            self._session.announce(keys.alive(self._session.instance))

    def show(self, message: DaemonStatus | EventMessage) -> None:
        """Publishes; a subscriber that is too slow misses it."""
        topic: Literal["status", "events"] = (
            "status" if isinstance(message, DaemonStatus) else "events"
        )
        self._session.publish(DaemonKeys(message.rig).about(topic), encode(message))

    def close(self) -> None:
        """Releases the endpoint."""
        self._session.close()

    def _serve(self, key: str, answer: Callable[[bytes], Message]) -> None:
        self._session.serve(key, partial(_reply_to, key, answer))


def _execute(supervised: Supervised, verb: DaemonVerb, payload: bytes) -> CommandAnswer:
    return supervised.command(verb, decode(Command, payload))


def _status(supervised: Supervised, _payload: bytes) -> DaemonStatus:
    return supervised.status()


def _rows(query: Callable[[Request], Message], payload: bytes) -> Message:
    return query(decode(Request, payload or b"{}"))


def _reply_to(key: str, answer: Callable[[bytes], Message], payload: bytes, reply: Reply) -> None:
    """Replies with the answer, or with the error that prevents it."""
    try:
        data = encode(answer(payload))
    except EstuneError as error:
        data = encode(CommandAnswer(done=False, sentence=str(error)))
    except Exception as error:  # noqa: BLE001  a client waits for a reply
        _log.exception("no answer to %s", key)
        sentence = f"{type(error).__name__}: {error}"
        data = encode(CommandAnswer(done=False, sentence=sentence))
    reply(data)


class DaemonClient:
    """Queries and commands a daemon. A context manager.

    Every method raises `RigError` if no daemon answers for the rig.
    """

    def __init__(
        self, endpoint: str, timeout_s: float = 3.0, *, security: Security = OPEN
    ) -> None:
        """Connects.

        Raises:
            InvalidInput: the endpoint is malformed.
            RigError: nothing listens there.
        """
        check_endpoint(endpoint)
        self.endpoint = endpoint
        self._timeout_s = timeout_s
        deadline_s = time.monotonic() + timeout_s
        remedy = "a daemon with: estune daemon CONFIG"
        self._session = open_client(endpoint, 2 * ANSWER_MAX_BYTES, security, deadline_s, remedy)

    def rigs(self) -> tuple[str, ...]:
        """The supervised rigs, by name."""
        return tuple(sorted({rig for rig, _ in self._present(ANY_DAEMON)}))

    def status(self, rig: str) -> DaemonStatus:
        """Current state of the supervision of a rig."""
        return self._about(DaemonStatus, rig, "status", b"")

    def history(self, rig: str, limit: int = 50) -> History:
        """Past gain sets, commands and check trials of a rig."""
        return self._about(History, rig, "history", encode(Request(limit=limit)))

    def events(self, rig: str, after: int = -1, limit: int = 50) -> list[EventMessage]:
        """Past events of a rig."""
        return self._about(Events, rig, "events", encode(Request(after, limit))).events

    def command(self, rig: str, verb: DaemonVerb, who: str, why: str = "") -> str:
        """Commands the daemon of a rig; returns what is being done.

        Raises:
            InvalidInput: it is refused.
        """
        payload = encode(Command(secrets.token_hex(8), who, why))
        data = self._ask(rig, lambda: DaemonKeys(rig).command(self._instance(rig), verb), payload)
        answer = decode(CommandAnswer, data)
        if not answer.done:
            raise InvalidInput(f"rig {rig}: {answer.sentence}")
        return answer.sentence

    def close(self) -> None:
        """Disconnects."""
        close_session(self._session)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _about(
        self,
        kind: type[_Reply],
        rig: str,
        topic: Literal["status", "history", "events"],
        payload: bytes,
    ) -> _Reply:
        data = self._ask(rig, lambda: DaemonKeys(rig).about(topic), payload)
        if data.startswith(b'{"done"'):
            raise RigError(decode(CommandAnswer, data).sentence)
        return decode(kind, data)

    def _ask(self, rig: str, key: Callable[[], str], payload: bytes) -> bytes:
        deadline_s = time.monotonic() + self._timeout_s
        while True:
            for reply in self._session.get(
                key(),
                payload=payload,
                timeout=ASK_S,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
            ):
                if reply.ok is not None:
                    return reply.ok.payload.to_bytes()
            if time.monotonic() > deadline_s:
                raise RigError(self._no_answer(rig))
            time.sleep(AGAIN_S)

    def _instance(self, rig: str) -> str:
        instances = [instance for _, instance in self._present(DaemonKeys(rig).alive("*"))]
        if len(instances) > 1:
            raise RigError(
                f"{len(instances)} daemons supervise rig {rig!r}; stop all but one of them"
            )
        if not instances:
            raise RigError(self._no_answer(rig))
        return instances[0]

    def _no_answer(self, rig: str) -> str:
        rigs = self.rigs()
        if rig in rigs:  # its daemon is there, and refuses a client without the right by silence
            return (
                f"the daemon at {self.endpoint} supervises rig {rig!r} but does not answer this "
                "request; check that this client has the right to make it, see --security"
            )
        there = f"; there is: {', '.join(rigs)}" if rigs else ""
        return f"no daemon at {self.endpoint} answers for rig {rig!r}{there}"

    def _present(self, key: str) -> set[tuple[str, str]]:
        replies = self._session.liveliness().get(key, timeout=ASK_S)
        words = [str(reply.ok.key_expr).split("/") for reply in replies if reply.ok is not None]
        return {(word[2], word[5]) for word in words}
