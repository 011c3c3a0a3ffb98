"""Rigs at an endpoint: `discover_rigs` lists them, `connect` opens one."""

import math
import os
import time
from operator import attrgetter

import zenoh

from estune.errors import InvalidInput, ProtocolError, RigError
from estune.remote import messages
from estune.remote.messages import Presence, check_name
from estune.remote.security import OPEN, Security
from estune.remote.zenoh.daemon_service import supervised_at
from estune.remote.zenoh.endpoints import check_endpoint
from estune.remote.zenoh.network import Network
from estune.remote.zenoh.remote_rig import RemoteRig
from estune.remote.zenoh.rig_connection import RigConnection, present_at
from estune.remote.zenoh.zenoh_session import AGAIN_S, ClosingSession
from estune.support.user import user_at_host


def connect(
    endpoint: str,
    rig: str | None = None,
    timeout_s: float = 3.0,
    *,
    found_within_s: float | None = None,
    patience_s: float | None = None,
    holder: str = "",
    security: Security = OPEN,
    network: Network | None = None,
) -> RemoteRig:
    """Connects to a rig.

    Args:
        endpoint: Endpoint of a rig, or of a Zenoh router: `tcp/127.0.0.1:7447`.
        rig: Name of the rig; None for the only one.
        timeout_s: Timeout for a rig that does not reply, s.
        found_within_s: How long to look for the rig, s; `timeout_s` by default.
        patience_s: The timeout once connected, s: for how long a cut of the network is waited
            out. Not for emergency stops and aborts. By default `timeout_s`, but 30 s for a rig
            that is alive.
        holder: Name of the lease holder, as others see it; user, machine and process by default.
        security: Credentials, if the rig requires authentication.
        network: Sessions shared with other rigs, in place of `security`; a new one by default.

    Raises:
        InvalidInput: the endpoint or the name is malformed, or the time is not above zero.
        ProtocolError: the rig uses another version of the protocol.
        RigError: nothing listens there, there is no rig, not the one named, several and none was
            named, or one name served by several processes.
    """
    check_endpoint(endpoint)
    if rig is not None:
        check_name("rig name", rig)
    times_s = {"timeout": timeout_s, "patience": patience_s, "time to find it": found_within_s}
    for name, time_s in times_s.items():
        if time_s is not None and not (math.isfinite(time_s) and time_s > 0.0):
            raise InvalidInput(f"{name} is {time_s} s; it must be finite and above zero")
    deadline_s = time.monotonic() + (found_within_s or timeout_s)
    network = network or Network(security)
    session = network.join(endpoint, deadline_s)
    try:
        presence = _find(session, endpoint, rig, deadline_s)
        connection = RigConnection(session, endpoint, presence, timeout_s, patience_s)
    except BaseException:
        network.leave(endpoint)
        raise
    return RemoteRig(connection, network, endpoint, holder or _this_process())


def discover_rigs(
    endpoint: str, timeout_s: float = 3.0, *, security: Security = OPEN
) -> tuple[Presence, ...]:
    """The rigs at an endpoint, by name; none of them is queried.

    Raises:
        InvalidInput: the endpoint is malformed.
        RigError: nothing listens there.
    """
    with EndpointPresences(endpoint, timeout_s, security=security) as there:
        return there.rigs()


class EndpointPresences(ClosingSession):
    """The rigs and daemons at an endpoint, as they come and go. A context manager."""

    def __init__(
        self, endpoint: str, timeout_s: float = 3.0, *, security: Security = OPEN
    ) -> None:
        """Connects; raises as `discover_rigs` does."""
        check_endpoint(endpoint)
        self._session = Network(security).open(endpoint, time.monotonic() + timeout_s)

    def rigs(self) -> tuple[Presence, ...]:
        """The rigs that are there now, by name; none of them is queried."""
        return tuple(sorted(present_at(self._session, messages.ANY_RIG), key=attrgetter("rig")))

    def supervised(self) -> tuple[str, ...]:
        """The rigs that daemons there supervise now, by name."""
        return supervised_at(self._session)


def _find(session: zenoh.Session, endpoint: str, rig: str | None, deadline_s: float) -> Presence:
    while True:
        try:
            return messages.choose(present_at(session, messages.ANY_RIG), rig, endpoint)
        except ProtocolError:
            raise
        except RigError:
            # It may be about to appear, or the token of an earlier start about to vanish.
            if time.monotonic() > deadline_s:
                raise
        time.sleep(AGAIN_S)


def _this_process() -> str:
    return f"{user_at_host()}, process {os.getpid()}"
