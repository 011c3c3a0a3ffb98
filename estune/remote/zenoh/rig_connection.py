"""Asking one rig questions, through silence and restarts."""

import logging
import time
from collections.abc import Callable
from typing import NamedTuple

import zenoh

from estune.errors import RigError
from estune.remote import messages
from estune.remote.messages import Description, Keys, Presence
from estune.remote.state_machine.client import ClientInput
from estune.remote.zenoh.zenoh_session import close_session

HUNG_AFTER_S = 30.0
"""How long a rig may be alive and yet not answer: a simulation can hold its interpreter."""

ASK_S = 1.0
AGAIN_S = 0.05

_log = logging.getLogger(__name__)


class LinkStatus(NamedTuple):
    """What has become of a rig that does not answer, and how to say it."""

    heard: ClientInput
    sentence: str = ""
    remedy: str = "start it again and connect again"


_SILENT = LinkStatus(ClientInput.SILENCE)


class RigConnection:
    """Asks one instance of a rig; follows to the next if the rig is restarted.

    Every question is repeated until it is answered, which is safe: none does a thing twice.

    Attributes:
        instance: The instance asked.
        about: What it says of itself, as last heard.
    """

    def __init__(
        self, session: zenoh.Session, endpoint: str, presence: Presence, timeout_s: float
    ) -> None:
        self.keys = Keys(presence.rig)
        self.instance = presence.instance
        self.timeout_s = timeout_s
        self.session = session
        self._called = f"rig {presence.rig!r} at {endpoint}"
        self.closed = False
        self.about: Description | None = None

    def describe(self) -> Description:
        """What the rig is, and which gains are live now.

        Raises:
            RigError: it cannot be reached.
        """
        data = self.query_until_answered(lambda: self.keys.describe, b"", "")
        self.about = messages.decode_description(data)
        return self.about

    @property
    def name(self) -> str:
        """Name of the rig."""
        return self.keys.rig

    def close(self) -> None:
        """Ends it; further questions are refused."""
        self.closed = True
        close_session(self.session)

    def ask(
        self,
        key: str,
        payload: bytes,
        *,
        timeout_s: float = ASK_S,
        session: zenoh.Session | None = None,
        priority: zenoh.Priority | None = None,
    ) -> bytes | None:
        """What this instance answers; None means nothing at all, least of all "no".

        Raises:
            RigError: it was closed, or the link has failed.
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
                # Hears all who answer to the name, and picks its own.
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
            for reply in replies:
                sample = reply.ok
                if sample is None or sample.attachment is None:
                    continue
                if sample.attachment.to_bytes() == self.instance.encode():
                    return sample.payload.to_bytes()
        except zenoh.ZError as error:
            raise RigError(f"rig {self.name!r}: the link has failed ({error})") from error
        return None

    def query_until_answered(self, where: Callable[[], str], payload: bytes, about: str) -> bytes:
        """Asks until the rig answers, whichever instance of it.

        Args:
            where: Gives the key to ask at; anew for each try, as it may name the instance.
            payload: What to ask.
            about: What is to be said if it never answers, after what is known of the rig.

        Raises:
            RigError: the rig was closed, is gone, does not answer, or is another now.
        """
        asked_s = time.monotonic()
        while (answer := self.ask(where(), payload)) is None:
            sign = self.check_liveliness(asked_s)
            if sign.heard in (ClientInput.GONE, ClientInput.REPLACED):
                raise RigError(f"{sign.sentence}{about or f'; {sign.remedy}'}")
            time.sleep(AGAIN_S)
        return answer

    def check_liveliness(self, silent_since_s: float) -> LinkStatus:
        """Looks what has become of a rig that does not answer, and follows it if it was restarted.

        Args:
            silent_since_s: When it was first asked what it has not answered, monotonic time.
        """
        silent_s = time.monotonic() - silent_since_s
        present = present_at(self.session, self.keys.alive("*"))
        instances = sorted(p.instance for p in present)
        if self.instance in instances:
            if silent_s > self.timeout_s and self.ask(self.keys.status, b"") is not None:
                return LinkStatus(
                    ClientInput.GONE,
                    f"{self._called} answers questions but not this command, as if this client "
                    "were not let command it",
                    "ask who keeps the rig for access",
                )
            if silent_s > max(HUNG_AFTER_S, self.timeout_s):
                return LinkStatus(
                    ClientInput.GONE,
                    f"{self._called} is there but has not answered for {silent_s:.0f} s",
                    "see what it is doing, or restart it",
                )
        elif len(instances) == 1:
            return self._follow(instances[0])
        elif silent_s > self.timeout_s:
            return LinkStatus(
                ClientInput.GONE,
                f"{self._called} is gone: its process has ended or the network is cut",
            )
        return _SILENT

    def _follow(self, instance: str) -> LinkStatus:
        """Turns to another instance, if it is the same rig as far as its ledger goes."""
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
                f"{self._called} was restarted, and remembers nothing of what it ran before",
            )
        _log.warning("%s was restarted", self._called)
        self.about = now
        return LinkStatus(heard)


def present_at(session: zenoh.Session, key: str) -> set[Presence]:
    """The rigs that show that they live."""
    replies = session.liveliness().get(key, timeout=ASK_S)
    return {Presence.parse(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None}
