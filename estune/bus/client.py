"""Reaches a rig over Zenoh."""

import math
import threading
import time
import weakref
from collections.abc import Callable
from operator import attrgetter
from typing import Self

import zenoh

from estune import frame, protocol
from estune.bus.session import check_endpoint, close_session, open_session
from estune.core.gains import Gains
from estune.errors import InvalidInput, ProtocolError, RigError
from estune.protocol import (
    Answer,
    Cancel,
    Inquire,
    Keys,
    Presence,
    SetGains,
    Submit,
    check_name,
)
from estune.trial import RigDescription, TrialRecord, TrialRequest

HUNG_AFTER_S = 30.0
"""How long a rig may be alive and yet not answer: a simulation can hold its interpreter."""

_ASK_S = 1.0
_AGAIN_S = 0.05
_POLL_FIRST_S, _POLL_MAX_S, _POLL_GROWTH = 0.002, 0.05, 1.5
_RECORDS_MAX_BYTES = frame.MAX_BYTES + 2**16


def connect(endpoint: str, rig: str | None = None, timeout_s: float = 3.0) -> "RemoteRig":
    """Finds a rig.

    Args:
        endpoint: Where a rig, or a Zenoh router that knows rigs, listens: `tcp/127.0.0.1:7447`.
        rig: Name of the rig; None where there is only one.
        timeout_s: How long to wait for a rig that does not answer, now and later, s.

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
    deadline = time.monotonic() + timeout_s
    session = _open(endpoint, deadline)
    try:
        presence = _find(session, endpoint, rig, deadline)
        return RemoteRig(session, endpoint, presence, timeout_s)
    except BaseException:
        close_session(session)
        raise


def find(endpoint: str, timeout_s: float = 3.0) -> tuple[Presence, ...]:
    """The rigs that answer at an endpoint, by name; none is spoken to.

    Args:
        endpoint: Where a rig, or a Zenoh router that knows rigs, listens.
        timeout_s: How long to wait for something to listen there, s.

    Raises:
        InvalidInput: the endpoint is not one.
        RigError: nothing listens there.
    """
    check_endpoint(endpoint)
    session = _open(endpoint, time.monotonic() + timeout_s)
    try:
        return tuple(sorted(_present(session, protocol.ANY_RIG), key=attrgetter("rig")))
    finally:
        close_session(session)


def _open(endpoint: str, deadline: float) -> zenoh.Session:
    while True:
        try:
            return open_session(
                "client", connect=(endpoint,), message_max_bytes=_RECORDS_MAX_BYTES
            )
        except zenoh.ZError as error:
            if time.monotonic() > deadline:
                raise RigError(
                    f"nothing that speaks Zenoh listens at {endpoint}; start a rig there with: "
                    f"estune serve --listen {endpoint}"
                ) from error
        time.sleep(_AGAIN_S)


def _find(session: zenoh.Session, endpoint: str, rig: str | None, deadline: float) -> Presence:
    while True:
        try:
            return protocol.choose(_present(session, protocol.ANY_RIG), rig, endpoint)
        except ProtocolError:
            raise
        except RigError:
            # It may be about to appear, or what is left of an earlier start about to vanish.
            if time.monotonic() > deadline:
                raise
        time.sleep(_AGAIN_S)


def _present(session: zenoh.Session, key: str) -> set[Presence]:
    replies = session.liveliness().get(key, timeout=_ASK_S)
    return {Presence.parse(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None}


class RemoteRig:
    """A rig in another process; the `Rig` protocol over Zenoh. Made by `connect`.

    It stays bound to one instance, one start of the rig's server: after a restart, connect again.
    Every question is repeated until it is answered, which is safe, since none does a thing twice.

    Ctrl-C gets through at any time; a trial then under way goes on at the rig until `abort`.
    """

    def __init__(
        self, session: zenoh.Session, endpoint: str, presence: Presence, timeout_s: float
    ) -> None:
        self.name = presence.rig
        self._session = session
        self._endpoint = endpoint
        self._instance = presence.instance
        self._timeout_s = timeout_s
        self._keys = Keys(presence.rig)
        # Closes the session when this object is let go of or the interpreter ends, too.
        self._finish = weakref.finalize(self, close_session, session)
        self._changed = threading.Event()
        wake = zenoh.handlers.Callback(_setter(self._changed), indirect=False)
        session.declare_subscriber(self._keys.status, wake)
        self.describe()

    def describe(self) -> RigDescription:
        """What the rig is, and which gains are live now.

        Raises:
            RigError: it cannot be reached.
        """
        data = self._insist(self._keys.describe, b"", "")
        return protocol.decode_description(data).rig

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs one trial, or returns the record of it if that trial id has run before.

        Raises:
            InvalidInput: the request is outside the rig's limits; nothing moved.
            RigError: the rig is busy with another's trial, knows another trial by that id, cannot
                be reached, or is gone; where the trial may have run, the message says so.
        """
        trial_id = check_name("trial id", request.trial_id)
        about = f"; trial {trial_id} may have run: see to the rig, then resume the run"
        request_digest = protocol.digest(request)
        self._changed.clear()
        data = self._insist(
            self._keys.command(self._instance, "submit"),
            protocol.encode(Submit(request, request_digest)),
            about,
        )
        pause_s = _POLL_FIRST_S
        while isinstance(state := protocol.decode_trial(data), Answer):
            state.check()
            if state.verdict == "unknown":
                raise RigError(f"rig {self.name!r} has forgotten trial {trial_id}{about}")
            self._changed.wait(pause_s)  # the rig tells when a trial has ended; else ask again
            self._changed.clear()
            pause_s = min(pause_s * _POLL_GROWTH, _POLL_MAX_S)
            inquiry = protocol.encode(Inquire(request_digest))
            data = self._insist(self._keys.result(trial_id), inquiry, about)
        if state.trial_id != trial_id:
            raise ProtocolError(
                f"rig {self.name!r} answers trial {trial_id} with a record of {state.trial_id}"
            )
        return state

    def apply(self, gains: Gains) -> None:
        """Makes gains the live ones.

        Raises:
            InvalidInput: the rig refuses them.
            RigError: the rig is busy with a trial, cannot be reached, or is gone.
        """
        data = self._insist(
            self._keys.command(self._instance, "gains"),
            protocol.encode(SetGains(gains)),
            f"; whether it took the gains {gains} is not known",
        )
        protocol.decode(Answer, data).check()

    def abort(self) -> RigDescription:
        """Stops the trial under way, whosever it is, and returns once the live gains are back.

        Raises:
            RigError: the trial cannot be stopped, or the rig cannot be reached.
        """
        key = self._keys.command(self._instance, "cancel")
        about = "; see to the rig: whether it has stopped is not known"
        trial_id = ""
        while True:
            data = self._insist(key, protocol.encode(Cancel(trial_id)), about)
            answer = protocol.decode(Answer, data)
            answer.check()
            if not answer.trial_id:
                return self.describe()
            trial_id = answer.trial_id  # from now on this one, and not the next that is begun
            time.sleep(_AGAIN_S)

    def close(self) -> None:
        """Lets go of the rig; further calls are refused. A trial under way goes on."""
        self._finish()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _insist(self, key: str, payload: bytes, about: str) -> bytes:
        """Asks until this instance answers.

        Args:
            key: Whom to ask.
            payload: What.
            about: What is to be said if it never answers, after what is known of the rig.

        Raises:
            RigError: the rig was closed, is gone, or does not answer.
        """
        rig = f"rig {self.name!r} at {self._endpoint}"
        asked_at = time.monotonic()
        while (answer := self._ask(key, payload)) is None:
            silent_s = time.monotonic() - asked_at
            present = _present(self._session, self._keys.alive("*"))
            instances = {presence.instance for presence in present}
            if instances and self._instance not in instances:
                raise RigError(f"{rig} was restarted{about or '; connect again'}")
            if not instances and silent_s > self._timeout_s:
                raise RigError(
                    f"{rig} is gone: its process has ended or the "
                    f"network is cut{about or '; start it again and connect again'}"
                )
            if instances and silent_s > max(HUNG_AFTER_S, self._timeout_s):
                raise RigError(
                    f"{rig} is there but has not answered for "
                    f"{silent_s:.0f} s{about or '; see what it is doing, or restart it'}"
                )
            time.sleep(_AGAIN_S)
        return answer

    def _ask(self, key: str, payload: bytes) -> bytes | None:
        """What this instance answers; None means nothing at all, least of all "no"."""
        if not self._finish.alive:
            raise RigError(f"rig {self.name!r} was closed; connect again")
        try:
            replies = self._session.get(
                key,
                payload=payload,
                timeout=_ASK_S,
                # Hears all who answer to the name, and picks its own.
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
            for reply in replies:
                sample = reply.ok
                if sample is None or sample.attachment is None:
                    continue
                if sample.attachment.to_bytes() == self._instance.encode():
                    return sample.payload.to_bytes()
        except zenoh.ZError as error:
            raise RigError(f"rig {self.name!r}: the link has failed ({error})") from error
        return None


def _setter(event: threading.Event) -> Callable[[zenoh.Sample], None]:
    """A callback that sets an event, and holds nothing else: least of all the rig."""

    def set_event(_: zenoh.Sample) -> None:
        event.set()

    return set_event
