"""Keeps a client's right to command a rig."""

import logging
import secrets
import threading
import time
from typing import Literal

import zenoh

from estune.errors import RigError
from estune.remote import messages
from estune.remote.messages import HOLDER_MAX, Answer, Lease
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import LEASE_S, RENEW_S
from estune.remote.zenoh.rig_connection import AGAIN_S, RigConnection

_RENEWED_WITHIN_S = 0.3
_HELD_WITHIN_S = 1.5 * LEASE_S
_END_WITHIN_S = 2.0

_log = logging.getLogger(__name__)


class LeaseRenewer:
    """Acquires the lease when it is first needed, and renews it from a thread of its own.

    The thread waits on the network and the clock alone, so that it goes on while the main thread
    computes. It knows the conversation, not the rig: a rig that is let go of is closed.
    """

    def __init__(self, talk: RigConnection, holder: str) -> None:
        self._talk = talk
        self._holder = holder[:HOLDER_MAX]
        self._lock = threading.Lock()
        self._token = ""
        self._ended = threading.Event()
        self._needed = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def token(self) -> str:
        """The lease that is held so far as is known; empty if none is."""
        return self._token

    def hold(self) -> str:
        """The lease; asks for one if none is held.

        Raises:
            RigError: another client holds the rig, or it cannot be reached.
        """
        if self._token:
            return self._token
        with self._lock:
            asked_s = time.monotonic()
            while not self._token:
                token = secrets.token_hex(8)
                answer = self._say("acquire", token)
                if answer.verdict is ReplyCode.ACCEPTED:
                    self._token = token
                # What is left of a client that was killed runs out by itself.
                elif time.monotonic() - asked_s > _HELD_WITHIN_S:
                    raise RigError(f"rig {self._talk.name!r}: {answer.sentence}")
                else:
                    time.sleep(AGAIN_S)
            if self._thread is None:
                self._thread = threading.Thread(target=self._renew, name="lease", daemon=True)
                self._thread.start()
            self._needed.set()
        return self._token

    def lost(self, token: str) -> None:
        """Takes note that the rig knows a lease no more."""
        if token and token == self._token:
            self._token = ""

    def release(self) -> None:
        """Gives the lease back, if one is held; what does not arrive runs out by itself."""
        token, self._token = self._token, ""
        if not token:
            return
        message = messages.encode(Lease("release", token))
        try:
            self._talk.ask(self._key(), message, timeout_s=_RENEWED_WITHIN_S)
        except RigError as error:
            _log.debug("the lease was not given back: %s", error)

    def close(self) -> None:
        """Gives the lease back, and renews none any more."""
        self._ended.set()
        thread, until_s = self._thread, time.monotonic() + _END_WITHIN_S
        while thread is not None and thread.is_alive() and time.monotonic() < until_s:
            self._needed.set()
            thread.join(AGAIN_S)
        self.release()

    def _key(self) -> str:
        return self._talk.keys.command(self._talk.instance, "lease")

    def _say(self, action: Literal["acquire"], token: str) -> Answer:
        message = messages.encode(Lease(action, token, self._holder))
        data = self._talk.query_until_answered(self._key, message, "")
        answer = messages.decode(Answer, data)
        if answer.verdict is ReplyCode.REFUSED:
            answer.check()
        return answer

    def _renew(self) -> None:
        while not self._ended.wait(RENEW_S):
            self._needed.clear()
            token = self._token
            if not token:
                self._needed.wait()
                continue
            message = messages.encode(Lease("renew", token))
            try:
                data = self._talk.ask(
                    *(self._key(), message),
                    timeout_s=_RENEWED_WITHIN_S,
                    priority=zenoh.Priority.INTERACTIVE_HIGH,
                )
                if data is not None and messages.decode(Answer, data).verdict is not (
                    ReplyCode.ACCEPTED
                ):
                    _log.warning(
                        "the lease of rig %r was lost: no renewal reached it for %g s",
                        self._talk.name,
                        LEASE_S,
                    )
                    self.lost(token)
            except RigError as error:
                _log.debug("lease not renewed: %s", error)
