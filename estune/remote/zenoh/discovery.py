"""Finds what listens at an endpoint: a session with it, the rigs there, one rig."""

import getpass
import math
import os
import socket
import time
from functools import partial
from operator import attrgetter

import zenoh

from estune.errors import InvalidInput, ProtocolError, RigError
from estune.remote import messages
from estune.remote.messages import Presence, check_name
from estune.remote.security import OPEN, Security
from estune.remote.zenoh.remote_rig import RemoteRig
from estune.remote.zenoh.rig_connection import AGAIN_S, RigConnection, present_at
from estune.remote.zenoh.zenoh_session import check_endpoint, close_session, open_session
from estune.trial import record_frame

RECORDS_MAX_BYTES = record_frame.MAX_BYTES + 2**16
"""Largest message a client takes in."""


def connect(
    endpoint: str,
    rig: str | None = None,
    timeout_s: float = 3.0,
    *,
    holder: str = "",
    security: Security = OPEN,
) -> RemoteRig:
    """Finds a rig.

    Args:
        endpoint: Where a rig, or a Zenoh router that knows rigs, listens: `tcp/127.0.0.1:7447`.
        rig: Name of the rig; None where there is only one.
        timeout_s: How long to wait for a rig that does not answer, now and later, s.
        holder: Who commands the rig, for others to be told; user, machine and process by default.
        security: Who this is, where the rig asks.

    Raises:
        InvalidInput: the endpoint or the name is not one, or the time is not above zero.
        ProtocolError: the rig speaks another version of the protocol.
        RigError: nothing listens there, no rig, not the one asked for, several and none was
            asked for, or one name served by several processes.
    """
    check_endpoint(endpoint)
    if rig is not None:
        check_name("rig name", rig)
    if not (math.isfinite(timeout_s) and timeout_s > 0.0):
        raise InvalidInput(f"timeout is {timeout_s} s; it must be finite and above zero")
    deadline_s = time.monotonic() + timeout_s
    session = _open(endpoint, security, deadline_s)
    try:
        presence = _find(session, endpoint, rig, deadline_s)
        talk = RigConnection(session, endpoint, presence, timeout_s)
        return RemoteRig(talk, partial(_open, endpoint, security), holder or _whoami())
    except BaseException:
        close_session(session)
        raise


def discover_rigs(
    endpoint: str, timeout_s: float = 3.0, *, security: Security = OPEN
) -> tuple[Presence, ...]:
    """The rigs that answer at an endpoint, by name; none is spoken to.

    Args:
        endpoint: Where a rig, or a Zenoh router that knows rigs, listens.
        timeout_s: How long to wait for something to listen there, s.
        security: Who this is, where the rigs ask.

    Raises:
        InvalidInput: the endpoint is not one.
        RigError: nothing listens there.
    """
    check_endpoint(endpoint)
    session = _open(endpoint, security, time.monotonic() + timeout_s)
    try:
        return tuple(sorted(present_at(session, messages.ANY_RIG), key=attrgetter("rig")))
    finally:
        close_session(session)


def _find(session: zenoh.Session, endpoint: str, rig: str | None, deadline_s: float) -> Presence:
    while True:
        try:
            return messages.choose(present_at(session, messages.ANY_RIG), rig, endpoint)
        except ProtocolError:
            raise
        except RigError:
            # It may be about to appear, or what is left of an earlier start about to vanish.
            if time.monotonic() > deadline_s:
                raise
        time.sleep(AGAIN_S)


def _whoami() -> str:
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a process without a user's name
        user = str(os.getuid())
    return f"{user}@{socket.gethostname()}, process {os.getpid()}"


def _open(endpoint: str, security: Security, deadline_s: float) -> zenoh.Session:
    """A session with a rig, or a router that knows rigs."""
    how = f"a rig there with: estune serve --listen {endpoint}"
    return reached(endpoint, RECORDS_MAX_BYTES, security, deadline_s, how)


def reached(
    endpoint: str, message_max_bytes: int, security: Security, deadline_s: float, how: str
) -> zenoh.Session:
    """A session with what listens at an endpoint, which may be about to.

    Args:
        endpoint: Where it listens.
        message_max_bytes: Largest message taken in.
        security: Who this is, where it asks.
        deadline_s: When to give up, monotonic time.
        how: What to start there, and how.

    Raises:
        RigError: nothing listens there.
    """
    while True:
        try:
            return open_session(
                "client",
                connect=(endpoint,),
                message_max_bytes=message_max_bytes,
                security=security,
            )
        except zenoh.ZError as error:
            if time.monotonic() > deadline_s:
                asked = "asks who this is" if security == OPEN else "does not take this client in"
                raise RigError(
                    f"nothing that speaks Zenoh listens at {endpoint}; start {how}; or what "
                    f"listens {asked}: see --security"
                ) from error
        time.sleep(AGAIN_S)
