"""The lease of a client, and the thread that renews all leases of a process."""

import logging
import secrets
import threading
import time

import zenoh

from estune.errors import ProtocolError, RigError
from estune.remote import messages
from estune.remote.messages import HOLDER_MAX, Answer
from estune.remote.messages.commands import Lease
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import LEASE_S, RENEW_S
from estune.remote.zenoh.rig_connection import RigConnection
from estune.remote.zenoh.zenoh_session import AGAIN_S

_RENEWED_WITHIN_S = 0.3  # by then the next renewal is on its way
_HELD_WITHIN_S = 1.5 * LEASE_S  # by then the lease of a killed client has expired
_END_WITHIN_S = 2.0  # the thread is woken, and waits for no rig

_log = logging.getLogger(__name__)


class LeaseRenewal:
    """A thread that renews leases, all in turn every `RENEW_S`, while there are any.

    It never waits for a rig, as replies arrive by callback. So it continues while another thread
    computes, and a rig that hangs delays no other's renewal.
    """

    def __init__(self) -> None:
        self._leases: set[ClientLease] = set()
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    def add(self, lease: "ClientLease") -> None:
        """Renews a lease from now on."""
        with self._changed:
            self._leases.add(lease)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="leases", daemon=True)
                self._thread.start()

    def remove(self, lease: "ClientLease") -> None:
        """Renews a lease no longer; with the last one, the thread has ended when this returns."""
        with self._changed:
            self._leases.discard(lease)
            ended = None if self._leases else self._thread
            self._changed.notify_all()
        # The interpreter must not shut down while a thread is inside Zenoh: it would abort.
        if ended is not None and ended is not threading.current_thread():
            ended.join(_END_WITHIN_S)

    def ages_s(self) -> list[float]:
        """Time since each lease was last known to be renewed; of those not expired since."""
        now_s = time.monotonic()
        with self._changed:
            ages_s = [now_s - lease.renewed_s for lease in self._leases if lease.token]
        return [age_s for age_s in ages_s if age_s < LEASE_S]

    def _run(self) -> None:
        due_s = time.monotonic() + RENEW_S
        while True:
            with self._changed:
                while self._leases and (wait_s := due_s - time.monotonic()) > 0.0:
                    self._changed.wait(wait_s)
                if not self._leases:
                    self._thread = None
                    return
                leases = tuple(self._leases)
            for lease in leases:
                lease.renew()
            # After a stall of this process the turns that it missed are not sent in a burst.
            due_s = max(due_s + RENEW_S, time.monotonic() + 0.5 * RENEW_S)


class ClientLease:
    """The lease of one rig: acquired when it is first needed, then renewed by `LeaseRenewal`.

    It refers to the connection, not to the rig: a rig no longer referred to is closed.

    Attributes:
        token: The lease held, as far as is known; empty without one.
        renewed_s: Monotonic time of the last request that the rig is known to have granted.
    """

    def __init__(self, connection: RigConnection, renewal: LeaseRenewal, holder: str) -> None:
        self.token = ""
        self.losses = 0
        self.renewed_s = 0.0
        self._connection = connection
        self._renewal = renewal
        self._holder = holder[:HOLDER_MAX]
        self._lock = threading.Lock()

    def hold(self) -> str:
        """The lease; acquires one if none is held.

        Raises:
            RigError: another client holds it, or the rig is gone.
        """
        with self._lock:
            asked_s = time.monotonic()
            while not self.token:
                token, sent_s = secrets.token_hex(8), time.monotonic()
                answer = self._connection.command(Lease("acquire", token, self._holder))
                if answer.verdict is ReplyCode.REFUSED:
                    answer.check()
                if answer.verdict is ReplyCode.ACCEPTED:
                    # From the sending: the rig's second began later, so it is never overrated.
                    self.renewed_s, self.token = sent_s, token
                    self._renewal.add(self)
                # The lease of a client that was killed expires by itself.
                elif time.monotonic() - asked_s > _HELD_WITHIN_S:
                    raise RigError(f"rig {self._connection.name!r}: {answer.sentence}")
                else:
                    time.sleep(AGAIN_S)
            return self.token

    def drop(self, token: str) -> None:
        """Forgets a lease that the rig has refused."""
        if token and token == self.token:
            self.token = ""
            self.losses += 1

    def release(self) -> None:
        """Returns the lease, if one is held; if the message is lost, the lease expires."""
        token, self.token = self.token, ""
        self._renewal.remove(self)
        if not token:
            return
        command = Lease("release", token)
        key, payload = self._connection.command_key(command), messages.encode(command)
        try:
            self._connection.ask(key, payload, timeout_s=_RENEWED_WITHIN_S)
        except RigError as error:
            _log.debug("the lease was not returned: %s", error)

    def renew(self) -> None:
        """Requests a renewal, without waiting for the reply."""
        token, sent_s = self.token, time.monotonic()
        if not token:
            return

        def receive(reply: zenoh.Reply) -> None:
            data = self._connection.own_reply(reply)
            if data is not None:
                self._receive(data, token, sent_s)

        try:
            self._connection.send(Lease("renew", token), receive, _RENEWED_WITHIN_S)
        except RigError as error:
            _log.debug("lease not renewed: %s", error)

    def _receive(self, data: bytes, token: str, sent_s: float) -> None:
        try:
            answer = messages.decode(Answer, data)
        except ProtocolError as error:
            _log.debug("lease not renewed: %s", error)
            return
        if answer.verdict is ReplyCode.ACCEPTED:
            # Replies may overtake each other: the age must not grow by a late one.
            self.renewed_s = max(self.renewed_s, sent_s)
        elif token == self.token:  # a late refusal of an earlier lease is not of this one
            name = self._connection.name
            _log.warning("lease of rig %r lost: no renewal arrived for %g s", name, LEASE_S)
            self.drop(token)
