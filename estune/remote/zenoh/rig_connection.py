"""Client connection to one rig: queries through silence and restarts, and the lease."""

import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import zenoh

from estune.errors import RigError
from estune.remote import messages
from estune.remote.messages import HOLDER_MAX, Answer, Description, Keys, Presence
from estune.remote.messages.codec import Message
from estune.remote.messages.commands import VERB_OF, Lease
from estune.remote.state_machine.client import PATIENCE_S, ClientInput
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import LEASE_S, RENEW_S
from estune.remote.zenoh.zenoh_session import AGAIN_S, close_session

ASK_S = 1.0
_RENEWED_WITHIN_S = 0.3
_HELD_WITHIN_S = 1.5 * LEASE_S
_END_WITHIN_S = 2.0
_REPORTED_AFTER_S = 1.5

_log = logging.getLogger(__name__)


class LinkStatus(NamedTuple):
    """State of a rig that does not reply, and its explanation."""

    heard: ClientInput
    sentence: str = ""
    remedy: str = "restart it and connect again"


_SILENT = LinkStatus(ClientInput.SILENCE)


class RigConnection:
    """Queries one instance of a rig; follows to the next if the rig is restarted.

    Every query is repeated until it is answered, which is safe: none is executed twice.

    Attributes:
        instance: The instance queried.
        about: Its last description.
    """

    def __init__(
        self,
        session: zenoh.Session,
        endpoint: str,
        presence: Presence,
        timeout_s: float,
        patience_s: float | None = None,
    ) -> None:
        """Connects to a rig; times as in `connect`."""
        self.keys = Keys(presence.rig)
        self.name = presence.rig
        self.instance = presence.instance
        self.timeout_s = timeout_s
        self._patience_s = patience_s
        self._hurried = False
        self._waiting = False
        self.session = session
        self.closed = False
        self.about: Description | None = None
        self._label = f"rig {presence.rig!r} at {endpoint}"

    @contextmanager
    def hurried(self) -> Iterator[None]:
        """No call, of any thread, waits longer than by default while the block lasts."""
        self._hurried = True
        try:
            yield
        finally:
            self._hurried = False

    def describe(self) -> Description:
        """Properties of the rig, with its live gains."""
        data = self.query_until_answered(lambda: self.keys.describe, b"")
        self.about = messages.decode_description(data)
        return self.about

    def close(self) -> None:
        """Closes the connection; further queries are refused."""
        self.closed = True
        close_session(self.session)

    def command_key(self, command: Message) -> str:
        """Key of a command to the current instance."""
        return self.keys.command(self.instance, VERB_OF[type(command)])

    def command(self, command: Message, unknown: str = "") -> Answer:
        """Reply to a command; `unknown` as in `query_until_answered`."""
        payload = messages.encode(command)
        data = self.query_until_answered(lambda: self.command_key(command), payload, unknown)
        return messages.decode(Answer, data)

    def ask(
        self,
        key: str,
        payload: bytes,
        *,
        timeout_s: float = ASK_S,
        session: zenoh.Session | None = None,
        priority: zenoh.Priority | None = None,
    ) -> bytes | None:
        """Reply of this instance; None on timeout, which is not a refusal.

        Raises:
            RigError: the connection was closed, or the link has failed.
        """
        if self.closed:
            raise RigError(f"rig {self.name!r} was closed; connect again")
        try:
            replies = (session or self.session).get(
                key,
                payload=payload,
                timeout=timeout_s,
                priority=priority,
                express=priority is not None,
                # Receives the replies of all rigs of the name, and selects its own.
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
            for reply in replies:
                sample = reply.ok
                if sample is None or sample.attachment is None:
                    continue
                if sample.attachment.to_bytes() == self.instance.encode():
                    if self._waiting:
                        self._waiting = False
                        _log.warning("%s replies again", self._label)
                    return sample.payload.to_bytes()
        except zenoh.ZError as error:
            raise RigError(f"rig {self.name!r}: the link has failed ({error})") from error
        return None

    def query_until_answered(
        self, key: Callable[[], str], payload: bytes, unknown: str = ""
    ) -> bytes:
        """Reply of the rig, of any of its instances.

        Args:
            key: Returns the key; called at each attempt, as the key may contain the instance.
            payload: The payload.
            unknown: What is unknown if no reply arrives, for the message.

        Raises:
            RigError: the connection was closed, or the rig is gone, does not reply, or was
                replaced by another.
        """
        asked_s = time.monotonic()
        while (reply := self.ask(key(), payload)) is None:
            status = self.check_liveliness(asked_s)
            if status.heard in (ClientInput.GONE, ClientInput.REPLACED):
                raise RigError(f"{status.sentence}{unknown or f'; {status.remedy}'}")
            time.sleep(AGAIN_S)
        return reply

    def check_liveliness(self, silent_since_s: float) -> LinkStatus:
        """State of a rig silent since that monotonic time; follows it if it was restarted."""
        silent_s = time.monotonic() - silent_since_s
        present = present_at(self.session, self.keys.alive("*"))
        instances = sorted(p.instance for p in present)
        if self.instance in instances:
            if silent_s > self.timeout_s and self.ask(self.keys.status, b"") is not None:
                return LinkStatus(
                    ClientInput.GONE,
                    f"{self._label} answers queries but not this command, as if this client "
                    "had no right to command it",
                    "ask its administrator for access",
                )
            # A simulation can hold its interpreter: it is alive without replying.
            limit_s = self._limit_s(max(PATIENCE_S, self.timeout_s))
            sentence, remedy = "is alive but does not reply", "check its program, or restart it"
        elif len(instances) == 1:
            return self._follow(instances[0])
        else:
            limit_s = self._limit_s(self.timeout_s)
            sentence = "is gone: its process has ended or the network is cut"
            remedy = LinkStatus._field_defaults["remedy"]
        if silent_s > limit_s:
            sentence = f"{self._label} {sentence} ({silent_s:.0f} s without a reply)"
            return LinkStatus(ClientInput.GONE, sentence, remedy)
        if silent_s > _REPORTED_AFTER_S and not self._waiting:
            self._waiting = True
            _log.warning("%s %s; waiting for it, at most %.0f s", self._label, sentence, limit_s)
        return _SILENT

    def _limit_s(self, default_s: float) -> float:
        """Time after which a silent rig is given up."""
        patience_s = default_s if self._patience_s is None else self._patience_s
        return min(patience_s, default_s) if self._hurried else patience_s

    def _follow(self, instance: str) -> LinkStatus:
        """Changes to another instance, if its ledger shows it to be the same rig."""
        before, self.instance = self.instance, instance
        data = self.ask(self.keys.describe, b"")
        if data is None:
            self.instance = before
            return _SILENT
        then, now = self.about, messages.decode_description(data)
        if then is None or now.ledger == then.ledger:
            heard = ClientInput.RESTARTED
        elif now.rig.simulated and then.rig.simulated:
            heard = ClientInput.EMPTIED
        else:
            self.instance = before
            return LinkStatus(
                ClientInput.REPLACED,
                f"{self._label} was restarted with another ledger, without its earlier trials",
            )
        _log.warning("%s was restarted", self._label)
        self.about = now
        return LinkStatus(heard)


def present_at(session: zenoh.Session, key: str) -> set[Presence]:
    """The rigs whose liveliness tokens match a key."""
    replies = session.liveliness().get(key, timeout=ASK_S)
    return {Presence.parse(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None}


class LeaseRenewer:
    """Acquires the lease when it is first needed, and renews it from a thread of its own.

    The thread waits only on the network and the clock, so that it continues while the main thread
    computes. It refers to the connection, not to the rig: a rig no longer referred to is closed.
    """

    def __init__(self, connection: RigConnection, holder: str) -> None:
        self._connection = connection
        self._holder = holder[:HOLDER_MAX]
        self._lock = threading.Lock()
        self._token = ""
        self._ended = threading.Event()
        self._needed = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def token(self) -> str:
        """The lease held, as far as is known; empty without one."""
        return self._token

    def hold(self) -> str:
        """The lease; acquires one if none is held."""
        if self._token:
            return self._token
        with self._lock:
            asked_s = time.monotonic()
            while not self._token:
                token = secrets.token_hex(8)
                answer = self._connection.command(Lease("acquire", token, self._holder))
                if answer.verdict is ReplyCode.REFUSED:
                    answer.check()
                if answer.verdict is ReplyCode.ACCEPTED:
                    self._token = token
                # The lease of a client that was killed expires by itself.
                elif time.monotonic() - asked_s > _HELD_WITHIN_S:
                    raise RigError(f"rig {self._connection.name!r}: {answer.sentence}")
                else:
                    time.sleep(AGAIN_S)
            if self._thread is None:
                self._thread = threading.Thread(target=self._renew, name="lease", daemon=True)
                self._thread.start()
            self._needed.set()
        return self._token

    def drop(self, token: str) -> None:
        """Forgets a lease that the rig has refused."""
        if token and token == self._token:
            self._token = ""

    def release(self) -> None:
        """Returns the lease, if one is held; if the message is lost, the lease expires."""
        token, self._token = self._token, ""
        if not token:
            return
        try:
            self._send(Lease("release", token))
        except RigError as error:
            _log.debug("the lease was not returned: %s", error)

    def close(self) -> None:
        """Returns the lease, and ends the thread."""
        self._ended.set()
        thread, until_s = self._thread, time.monotonic() + _END_WITHIN_S
        while thread is not None and thread.is_alive() and time.monotonic() < until_s:
            self._needed.set()
            thread.join(AGAIN_S)
        self.release()

    def _send(self, command: Lease, priority: zenoh.Priority | None = None) -> Answer | None:
        """Reply to one attempt, if it arrives within the renewal time."""
        data = self._connection.ask(
            *(self._connection.command_key(command), messages.encode(command)),
            timeout_s=_RENEWED_WITHIN_S,
            priority=priority,
        )
        return None if data is None else messages.decode(Answer, data)

    def _renew(self) -> None:
        while not self._ended.wait(RENEW_S):
            self._needed.clear()
            token = self._token
            if not token:
                self._needed.wait()
                continue
            try:
                answer = self._send(Lease("renew", token), zenoh.Priority.INTERACTIVE_HIGH)
            except RigError as error:
                _log.debug("lease not renewed: %s", error)
                continue
            if answer is not None and answer.verdict is not ReplyCode.ACCEPTED:
                name = self._connection.name
                _log.warning("lease of rig %r lost: no renewal arrived for %g s", name, LEASE_S)
                self.drop(token)
