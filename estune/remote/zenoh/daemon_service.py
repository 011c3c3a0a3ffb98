"""A daemon over Zenoh: `DaemonServer` answers queries and commands, `DaemonClient` sends them."""

import logging
import secrets
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Literal, Protocol, TypeVar

import zenoh

from estune.errors import EstuneError, InvalidInput, RigError
from estune.remote.messages.codec import Message, decode, encode
from estune.remote.messages.daemon import (
    ANSWER_MAX_BYTES,
    ANY_DAEMON,
    ANY_QUERY,
    ANY_STATUS,
    DAEMON_VERBS,
    Command,
    CommandAnswer,
    DaemonEvent,
    DaemonKeys,
    DaemonStatus,
    DaemonVerb,
    Events,
    History,
    Request,
    any_command,
)
from estune.remote.security import OPEN, Security
from estune.remote.zenoh.endpoints import check_endpoint
from estune.remote.zenoh.listening_session import ListeningSession
from estune.remote.zenoh.zenoh_session import (
    AGAIN_S,
    ClosingSession,
    open_client,
)

ASK_S = 2.0

_log = logging.getLogger(__name__)
_Reply = TypeVar("_Reply", bound=Message)
_Answer = Callable[[bytes], Message]


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
    """Serves the supervisors of several rigs; nothing is answered before `serve`."""

    def __init__(self, session: ListeningSession) -> None:
        """Takes over the session: `close` closes it."""
        self.endpoint = session.endpoint
        self._session = session

    def serve(self, rigs: Mapping[str, Supervised], *, announced: bool = True) -> None:
        """Starts to serve rigs, by name, and announces them, or leaves that to `announce`.

        Commands do not wait for queries. A wildcard query is answered for all rigs.
        """
        session, instance = self._session, self._session.instance
        commands: dict[str, _Answer] = {}
        queries: dict[str, _Answer] = {}
        for rig, supervised in rigs.items():
            keys = DaemonKeys(rig)
            for verb in DAEMON_VERBS:
                commands[keys.command(instance, verb)] = partial(_execute, supervised, verb)
            queries[keys.about("status")] = partial(_status, supervised)
            queries[keys.about("history")] = partial(_rows, supervised.history)
            queries[keys.about("events")] = partial(_rows, supervised.events)

        def command(key: str, payload: bytes) -> Iterator[tuple[str, bytes]]:
            if key in commands:
                yield key, _encoded(key, commands[key], payload)

        def query(asked: str, payload: bytes) -> Iterator[tuple[str, bytes]]:
            wildcard = zenoh.KeyExpr(asked)
            for key in [asked] if asked in queries else filter(wildcard.intersects, queries):
                yield key, _encoded(key, queries[key], payload)

        session.serve_many(any_command(instance), command, session.lane())
        session.serve_many(ANY_QUERY, query, session.lane())
        for rig in rigs if announced else ():
            self.announce(rig)

    def announce(self, rig: str) -> None:
        """Announces that this daemon has a rig."""
        self._session.announce(DaemonKeys(rig).alive(self._session.instance))

    def withdraw(self, rig: str) -> None:
        """Announces that it has the rig no longer."""
        self._session.withdraw(DaemonKeys(rig).alive(self._session.instance))

    def show(self, message: DaemonStatus | DaemonEvent) -> None:
        """Publishes; a subscriber that is too slow misses it."""
        topic: Literal["status", "events"] = (
            "status" if isinstance(message, DaemonStatus) else "events"
        )
        self._session.publish(DaemonKeys(message.rig).about(topic), encode(message))

    def close(self) -> None:
        """Releases the endpoint."""
        self._session.close()


def _execute(supervised: Supervised, verb: DaemonVerb, payload: bytes) -> CommandAnswer:
    return supervised.command(verb, decode(Command, payload))


def _status(supervised: Supervised, _payload: bytes) -> DaemonStatus:
    return supervised.status()


def _rows(query: Callable[[Request], Message], payload: bytes) -> Message:
    return query(decode(Request, payload or b"{}"))


def _encoded(key: str, answer: _Answer, payload: bytes) -> bytes:
    try:
        return encode(answer(payload))
    except EstuneError as error:
        sentence = str(error)
    except Exception as error:  # noqa: BLE001  a client waits for a reply
        _log.exception("no answer to %s", key)
        sentence = f"{type(error).__name__}: {error}"
    return encode(CommandAnswer(done=False, sentence=sentence))


class DaemonClient(ClosingSession):
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
        return supervised_at(self._session)

    def statuses(self) -> list[DaemonStatus]:
        """Current state of every rig, by name, from one query of all daemons.

        A rig in the files of several daemons is told by the one that has it.
        """
        found: dict[str, DaemonStatus] = {}
        deadline_s = time.monotonic() + self._timeout_s
        while not found:
            for data in self._replies(ANY_STATUS, b""):
                status = decode(DaemonStatus, data)
                if status.rig not in found or status.live:
                    found[status.rig] = status
            if not found and time.monotonic() > deadline_s:
                raise RigError(f"no daemon answers at {self.endpoint}")
        return [found[rig] for rig in sorted(found)]

    def status(self, rig: str) -> DaemonStatus:
        """Current state of the supervision of a rig."""
        return self._about(DaemonStatus, rig, "status", b"")

    def history(self, rig: str, limit: int = 50) -> History:
        """Past gain sets, commands and check trials of a rig."""
        return self._about(History, rig, "history", encode(Request(limit=limit)))

    def events(self, rig: str, after: int = -1, limit: int = 50) -> list[DaemonEvent]:
        """Past events of a rig."""
        return self._about(Events, rig, "events", encode(Request(after, limit))).events

    def command(self, rig: str, verb: DaemonVerb, who: str, why: str = "") -> str:
        """Commands the daemon of a rig; returns what is being done.

        Raises:
            InvalidInput: it is refused.
        """
        answer = self.send(rig, verb, Command(secrets.token_hex(8), who, why))
        if not answer.done:
            raise InvalidInput(f"rig {rig}: {answer.sentence}")
        return answer.sentence

    def send(self, rig: str, verb: DaemonVerb, command: Command) -> CommandAnswer:
        """Sends a command to the daemon of a rig until it is answered."""
        payload = encode(command)
        data = self._ask(rig, lambda: DaemonKeys(rig).command(self._instance(rig), verb), payload)
        return decode(CommandAnswer, data)

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
            for data in self._replies(key(), payload):
                return data
            if time.monotonic() > deadline_s:
                raise RigError(self._no_answer(rig))
            time.sleep(AGAIN_S)

    def _replies(self, key: str, payload: bytes) -> Iterator[bytes]:
        for reply in self._session.get(
            key,
            payload=payload,
            timeout=ASK_S,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        ):
            if reply.ok is not None:
                yield reply.ok.payload.to_bytes()

    def _instance(self, rig: str) -> str:
        instances = daemon_instances(self._session, rig)
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


def supervised_at(session: zenoh.Session) -> tuple[str, ...]:
    """The rigs that daemons have announced, by name."""
    return tuple(sorted({key.split("/")[2] for key in _present(session, ANY_DAEMON)}))


def daemon_instances(session: zenoh.Session, rig: str) -> list[str]:
    """Instances of the daemons that have announced a rig."""
    return sorted(key.rpartition("/")[2] for key in _present(session, DaemonKeys(rig).alive("*")))


def _present(session: zenoh.Session, key: str) -> set[str]:
    """Liveliness tokens that match a key."""
    replies = session.liveliness().get(key, timeout=ASK_S)
    return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
