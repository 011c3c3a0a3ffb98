"""Connections of one process to rigs: a session for each endpoint, and one renewal of leases."""

import threading
from dataclasses import dataclass

import zenoh

from estune.remote.security import OPEN, Security
from estune.remote.zenoh.client_lease import LeaseRenewal
from estune.remote.zenoh.zenoh_session import close_session, open_client
from estune.trial import record_frame

RECORDS_MAX_BYTES = record_frame.MAX_BYTES + 2**16
"""Largest message that a client accepts."""


@dataclass(slots=True, eq=False)
class _Opened:
    session: zenoh.Session
    users: int = 0


class Network:
    """Sessions shared by rigs: one for each endpoint, so one for all rigs behind a router."""

    def __init__(self, security: Security = OPEN) -> None:
        self.renewal = LeaseRenewal()
        self._security = security
        self._opened: dict[str, _Opened] = {}
        self._lock = threading.Lock()

    def join(self, endpoint: str, deadline_s: float) -> zenoh.Session:
        """The session with an endpoint; `leave` has to follow.

        Raises:
            RigError: nothing listens there until a time on the monotonic clock.
        """
        with self._lock:
            opened = self._opened.get(endpoint)
            if opened is not None:
                opened.users += 1
                return opened.session
        session = self.open(endpoint, deadline_s)
        with self._lock:
            first = self._opened.setdefault(endpoint, _Opened(session))
            first.users += 1
        if first.session is not session:  # another thread was faster
            close_session(session)
        return first.session

    def leave(self, endpoint: str) -> None:
        """Closes the session with an endpoint, if no other rig uses it."""
        with self._lock:
            opened = self._opened[endpoint]
            opened.users -= 1
            if opened.users:
                return
            del self._opened[endpoint]
        close_session(opened.session)

    def open(self, endpoint: str, deadline_s: float) -> zenoh.Session:
        """A session of its own with an endpoint; raises as `join` does."""
        remedy = f"a rig there with: estune serve --listen {endpoint}"
        return open_client(endpoint, RECORDS_MAX_BYTES, self._security, deadline_s, remedy)
