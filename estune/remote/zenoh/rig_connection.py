"""Client connection to one rig: queries through silence and restarts."""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

import zenoh

from estune.errors import ProtocolError, RigError
from estune.remote import messages
from estune.remote.messages import Answer, Description, Keys, Presence
from estune.remote.messages.codec import Message
from estune.remote.messages.commands import VERB_OF
from estune.remote.state_machine.client import PATIENCE_S, ClientInput
from estune.remote.zenoh.zenoh_session import AGAIN_S

ASK_S = 1.0
_REPORTED_AFTER_S = 1.5  # a query that was lost once is answered before that
_SHOWN_WITHIN_S = 0.3
"""Time in which a verb is shown to a client that may send it, s; 20 ms at the most on loopback."""
_SHOWN_AGAIN_S = 0.01

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
    """

    def __init__(
        self,
        session: zenoh.Session,
        endpoint: str,
        presence: Presence,
        timeout_s: float,
        patience_s: float | None = None,
    ) -> None:
        self.keys = Keys(presence.rig)
        self.name = presence.rig
        self.instance = presence.instance
        self.timeout_s = timeout_s
        self._patience_s = patience_s
        self._hurried = False
        self._waiting = False
        self._present_since_s: float | None = None
        self._failures: dict[str, str] = {}  # by instance
        self.session = session
        self.closed = False
        self.about: Description | None = None
        self._queriers: dict[str, zenoh.Querier] = {}
        self._label = f"rig {presence.rig!r} at {endpoint}"

    @contextmanager
    def hurried(self) -> Iterator[None]:
        """No call, of any thread, waits longer than by default while the block lasts."""
        self._hurried = True
        try:
            yield
        finally:
            self._hurried = False

    def note_failure(self, sample: zenoh.Sample) -> None:
        """Keeps why a rig's program ended, as it said; called by a thread of the network."""
        if sample.attachment is not None:
            with suppress(ProtocolError):
                failure = messages.decode(messages.Failure, sample.payload.to_bytes())
                self._failures[sample.attachment.to_string()] = failure.reason

    def describe(self) -> Description:
        """Properties of the rig, with its live gains."""
        data = self.query_until_answered(lambda: self.keys.describe, b"")
        self.about = messages.decode_description(data)
        return self.about

    def close(self) -> None:
        """Refuses further queries."""
        self.closed = True

    def is_served(self, verb: str) -> bool:
        """Whether the rig shows this client a verb."""
        key = self.keys.command(self.instance, verb)
        with self._link_failures():
            if key not in self._queriers:
                self._queriers[key] = self.session.declare_querier(key)
                deadline_s = time.monotonic() + _SHOWN_WITHIN_S
                while not self._matches(key) and time.monotonic() < deadline_s:
                    time.sleep(_SHOWN_AGAIN_S)
            return self._matches(key)

    def _matches(self, key: str) -> bool:
        status: Any = self._queriers[key].matching_status
        return bool(status.matching)

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
        priority: zenoh.Priority = zenoh.Priority.DATA,
    ) -> bytes | None:
        """Reply of this instance; None on timeout, which is not a refusal.

        Raises:
            RigError: the connection was closed, or the link has failed.
        """
        with self._link_failures():
            # Receives the replies of all rigs of the name, and selects its own.
            replies = (session or self.session).get(
                key, payload=payload, timeout=timeout_s, **_query_settings(priority)
            )
            for reply in replies:
                if (data := self.own_reply(reply)) is not None:
                    if self._waiting:
                        self._waiting = False
                        _log.warning("%s replies again", self._label)
                    return data
        return None

    def send(
        self, command: Message, receive: Callable[[zenoh.Reply], None], timeout_s: float
    ) -> None:
        """Sends a command before all others, without waiting for the reply.

        It must not be dropped in a congestion: the queue of a priority holds two messages, and is
        full whenever Zenoh's sender does not run at once. Replies of all rigs of the name reach
        `receive`, in a thread of the network that must not wait.

        Raises:
            RigError: the connection was closed, or the link has failed.
        """
        with self._link_failures():
            self.session.get(
                self.command_key(command),
                zenoh.handlers.Callback(receive, indirect=False),
                payload=messages.encode(command),
                timeout=timeout_s,
                **_query_settings(zenoh.Priority.INTERACTIVE_HIGH),
            )

    def own_reply(self, reply: zenoh.Reply) -> bytes | None:
        """Payload of a reply of this instance; None of any other."""
        sample = reply.ok
        if sample is None or sample.attachment is None:
            return None
        own = sample.attachment.to_bytes() == self.instance.encode()
        return sample.payload.to_bytes() if own else None

    @contextmanager
    def _link_failures(self) -> Iterator[None]:
        """Refuses a closed connection, and converts errors of the transport."""
        if self.closed:
            raise RigError(f"rig {self.name!r} was closed; connect again")
        try:
            yield
        except zenoh.ZError as error:
            raise RigError(f"rig {self.name!r}: the link has failed ({error})") from error

    def query_until_answered(
        self, key: Callable[[], str], payload: bytes, unknown: str = ""
    ) -> bytes:
        """Reply of the rig, of any of its instances.

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
        with self._link_failures():
            present = present_at(self.session, self.keys.alive("*"))
        instances = sorted(p.instance for p in present)
        is_present = self.instance in instances
        if not is_present or self._present_since_s is None:
            self._present_since_s = time.monotonic() if is_present else None
        if self._present_since_s is not None:
            # After an outage the command has to be repeated for as long, before it is judged.
            refused_s = time.monotonic() - max(silent_since_s, self._present_since_s)
            if refused_s > self.timeout_s and self.ask(self.keys.status, b"") is not None:
                return LinkStatus(
                    ClientInput.GONE,
                    f"{self._label} answers queries but not this command, as if this client "
                    "had no right to command it, or the rig did not know it, or were overloaded",
                    "ask its administrator for access, update the rig, or relieve its machine",
                )
            # A simulation can hold its interpreter: it is alive without replying.
            limit_s = self._limit_s(max(PATIENCE_S, self.timeout_s))
            sentence, remedy = "is alive but does not reply", "check its program, or restart it"
        elif len(instances) == 1:
            return self._follow(instances[0])
        else:
            limit_s = self._limit_s(self.timeout_s)
            reason = self._failures.get(self.instance)
            sentence = (
                f"has ended: {reason}"
                if reason
                else "is gone: its process has ended or the network is cut"
            )
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
                f"{self._label} was restarted with another ledger, {now.ledger} instead of "
                f"{then.ledger}, without its earlier trials",
            )
        _log.warning("%s was restarted", self._label)
        self.about = now
        return LinkStatus(heard)


def present_at(session: zenoh.Session, key: str) -> set[Presence]:
    """The rigs whose liveliness tokens match a key."""
    replies = session.liveliness().get(key, timeout=ASK_S)
    return {Presence.parse(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None}


def _query_settings(priority: zenoh.Priority) -> dict[str, Any]:
    """Settings of every query; one of more than usual priority does not wait in a batch."""
    return {
        "priority": priority,
        "express": priority is not zenoh.Priority.DATA,
        "target": zenoh.QueryTarget.ALL,
        "consolidation": zenoh.ConsolidationMode.NONE,
    }
