"""A rig in another process, over Zenoh."""

import threading
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from typing import Any

import zenoh

from estune.core.gains import Gains
from estune.errors import EstuneError, ProtocolError, RigError
from estune.remote import messages
from estune.remote.messages import Answer, Inquire, Status, check_name
from estune.remote.messages.commands import (
    Cancel,
    Clear,
    Estop,
    Follow,
    SetGains,
    SwitchOff,
    Void,
)
from estune.remote.messages.rights import Right
from estune.remote.state_machine.client import Action
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.zenoh.client_lease import ClientLease
from estune.remote.zenoh.daemon_service import daemon_instances
from estune.remote.zenoh.network import Network
from estune.remote.zenoh.rig_connection import RigConnection
from estune.remote.zenoh.trial_exchange import TrialExchange
from estune.remote.zenoh.zenoh_session import AGAIN_S, close_session
from estune.support.closing import Closing
from estune.trial import (
    Feedback,
    Outcome,
    RigDescription,
    Setpoint,
    Telemetry,
    TrialRecord,
    TrialRequest,
    empty_record,
)

_SAMPLES_WAITING_MAX = 64  # messages; a slow reader loses the oldest, and no one waits
_STOPPED_WITHIN_S = 0.3  # then the stop is sent again, by a session of its own


class RemoteRig(Closing):
    """A rig in another process: the `Rig` protocol over Zenoh. Made by `connect`.

    The first command acquires the lease, which a thread renews until `release` or `close`; status
    and description need none. A rig that is restarted is followed if its ledger is the same, or if
    it is simulated.

    Every method raises `RigError` if the rig refuses (another client holds it, it is busy with a
    trial, or in its safe state), does not reply, or is gone. Ctrl-C interrupts any call; the
    active trial then continues at the rig until `abort`.
    """

    def __init__(
        self, connection: RigConnection, network: Network, endpoint: str, holder: str
    ) -> None:
        self.name = connection.name
        self._connection = connection
        self._lease = ClientLease(connection, network.renewal, holder)
        self._stop_session = _StopSession(partial(network.open, endpoint))
        self._at_rest = threading.Event()
        wake = zenoh.handlers.Callback(_setter(self._at_rest), indirect=False)
        status = connection.session.declare_subscriber(connection.keys.status, wake)
        note = zenoh.handlers.Callback(connection.note_failure, indirect=False)
        failure = connection.session.declare_subscriber(connection.keys.failure, note)
        # Closes all of it, too, when this object is deleted or the interpreter ends.
        ends: list[Callable[[], object]]
        ends = [self._lease.release, self._stop_session.close, connection.close]
        ends += [status.undeclare, failure.undeclare, partial(network.leave, endpoint)]
        self._finish = weakref.finalize(self, _close, ends)
        self._unanswered: tuple[str, str] | None = None
        self._last_trial_s = 0.0
        try:
            self.describe()
        except BaseException:
            self.close()
            raise

    def describe(self) -> RigDescription:
        """Properties of the rig, with its live gains."""
        return self._connection.describe().rig

    def status(self, *, with_last: bool = False) -> Status:
        """Current state of the rig, and its lease holder; where it says so, its last trial."""
        key, asked = self._connection.keys.status, messages.LAST if with_last else b""
        return messages.decode(Status, self._connection.query_until_answered(lambda: key, asked))

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs one trial, or returns the record of it if that trial id has run before.

        A trial that was interrupted or never started has a record too, of outcome `interrupted`
        or `cancelled` and without samples.

        Raises:
            InvalidInput: the request is outside the rig's limits; nothing moved.
            RigError: no record can be had; where the trial may have run, the message contains it.
        """
        trial_id = check_name("trial id", request.trial_id)
        exchange = TrialExchange(
            *(self._connection, self._lease, request, self._at_rest, self._last_trial_s)
        )
        self._unanswered = trial_id, exchange.digest
        asked_s = time.monotonic()
        result = exchange.run()
        self._last_trial_s = time.monotonic() - asked_s
        self._unanswered = None
        if isinstance(result, TrialRecord):
            return result
        interrupted = result.action is Action.INTERRUPTED
        outcome = Outcome.INTERRUPTED if interrupted else Outcome.CANCELLED
        about = self._connection.about or self._connection.describe()
        at = datetime.now(UTC).isoformat(timespec="milliseconds")
        return empty_record(request, about.rig, outcome, result.sentence, at)

    def has_failed(self, request: TrialRequest) -> bool:
        """Whether no record can ever be had under a trial's id.

        True if the rig's program failed in it, its record is gone, or another trial had the id.
        """
        inquiry = messages.encode(Inquire(messages.digest(request)))
        key = self._connection.keys.result(request.trial_id)
        reply = messages.decode_trial(self._connection.query_until_answered(lambda: key, inquiry))
        return isinstance(reply, Answer) and reply.verdict is ReplyCode.REFUSED

    def apply(self, gains: Gains, original: Gains | None = None) -> None:
        """Sets the live gains.

        Args:
            original: The gains that ran before any daemon that shares the rig set others; a rig
                that cannot keep them sets the gains all the same.
        """
        unknown = f"; whether it has applied the gains {gains} is unknown"
        answer = self._command_with_lease(SetGains("", gains, original), unknown)
        if original is not None and answer.error == ProtocolError.__name__:
            answer = self._command_with_lease(SetGains("", gains), unknown)  # an older rig
        answer.check()

    def switch_off(self, tables: Sequence[str]) -> None:
        """Switches compensations of the rig off, until its next start."""
        unknown = f"; whether it has switched {', '.join(tables)} off is unknown"
        self._command_with_lease(SwitchOff("", tuple(tables)), unknown).check()

    @property
    def ledger(self) -> str:
        """Identity of the rig's ledger, as last described."""
        return self._connection.about.ledger if self._connection.about else ""

    @property
    def original(self) -> Gains | None:
        """The gains that ran before daemons that share the rig set others, as last described."""
        return self._connection.about.original if self._connection.about else None

    def send_setpoint(
        self,
        setpoint: Setpoint,
        receive: Callable[[Feedback | EstuneError], None],
        within_s: float,
    ) -> None:
        """Sends a setpoint, without waiting for the reply; `SetpointStream` sends many.

        Args:
            receive: Takes the reply, in a thread of the network that must not wait; it is not
                called without a reply.
            within_s: Time after which a reply is ignored, s.
        """
        lease = self._lease.hold()

        def decode(reply: zenoh.Reply) -> None:
            if (data := self._connection.own_reply(reply)) is None:
                return
            try:
                receive(messages.decode_following(data).feedback)
            except EstuneError as error:
                receive(error)

        command = Follow(lease, time.monotonic(), setpoint)
        self._connection.send(command, decode, within_s)

    def abort(self) -> RigDescription:
        """Stops the active trial, and returns once the live gains are restored."""
        with self._connection.hurried():
            return self._abort("; whether it has stopped is unknown: inspect the rig")

    def _abort(self, unknown: str) -> RigDescription:
        self._void_unanswered(unknown)
        trial_id = ""
        while True:
            answer = self._connection.command(Cancel(self._lease.token, trial_id), unknown)
            if answer.verdict is ReplyCode.NO_LEASE:
                self._lease.drop(self._lease.token)
                self._lease.hold()
                continue
            answer.check()
            if not answer.trial_id:
                return self.describe()
            trial_id = answer.trial_id  # from now on this one, and not the next that starts
            time.sleep(AGAIN_S)

    def estop(self, reason: str) -> None:
        """Brings the rig to its safe state, without a lease. It stays there until cleared."""
        command = Estop(reason[: messages.HOLDER_MAX])
        payload = messages.encode(command)
        asked_s = time.monotonic()
        while True:
            # First over what is open: a listener may be kept from accepting another session.
            data = self._connection.ask(
                *(self._connection.command_key(command), payload),
                timeout_s=_STOPPED_WITHIN_S,
                session=self._stop_session.session,
                priority=zenoh.Priority.REAL_TIME,
            )
            if data is not None:
                return messages.decode(Answer, data).check()
            if time.monotonic() - asked_s > self._connection.timeout_s:
                raise RigError(
                    f"rig {self.name!r} has not answered the emergency stop: it must be taken as "
                    "not stopped; cut its power"
                )
            with suppress(RigError):
                self._stop_session.open(_STOPPED_WITHIN_S)
            self._connection.check_liveliness(asked_s)

    def clear(self) -> None:
        """Resets the emergency stop, after the operator has removed its cause."""
        self._connection.command(Clear(), "; whether the stop is cleared is unknown").check()

    @contextmanager
    def watch(self) -> Iterator[Iterator[Telemetry]]:
        """Live samples of trials while the block lasts; a slow consumer misses some."""
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(
            _SAMPLES_WAITING_MAX
        )
        key = self._connection.keys.telemetry("*")
        with self._connection.session.declare_subscriber(key, ring) as subscriber:
            yield map(_live, subscriber)

    def daemons(self) -> list[str]:
        """Instances of the daemons that supervise the rig, as far as they join its network."""
        return daemon_instances(self._connection.session, self.name)

    @property
    def right(self) -> Right:
        """What this client may do: a rig shows it only the commands to which it has a right."""
        for right in (Right.COMMAND, Right.STOP):
            verb = next(name for name, verb in messages.VERBS.items() if verb.right is right)
            if self._connection.is_served(verb):
                return right
        return Right.LOOK

    @property
    def leases_lost(self) -> int:
        """Number of leases lost so far: not renewed in time, or ended by the rig."""
        return self._lease.losses

    def acquire(self) -> None:
        """Acquires the lease now, rather than with the first command."""
        self._lease.hold()

    def release(self) -> None:
        """Returns the lease before `close`. The active trial is stopped by it."""
        self._lease.release()

    def close(self) -> None:
        """Disconnects; further calls are refused. The active trial is stopped by it."""
        self._finish()

    def _void_unanswered(self, unknown: str) -> None:
        """Voids a trial whose submit was left unanswered: it must not start any more."""
        if self._unanswered is None or not self._lease.token:
            return
        void = Void("", *self._unanswered)
        while self._command_with_lease(void, unknown).verdict is ReplyCode.BUSY:
            time.sleep(AGAIN_S)  # it is being written to the ledger
        self._unanswered = None

    def _command_with_lease(self, command: Any, unknown: str) -> Answer:
        """Reply to a command under the current lease, under a new one if that was lost."""
        while True:
            lease = self._lease.hold()
            answer = self._connection.command(replace(command, lease=lease), unknown)
            if answer.verdict not in (ReplyCode.NO_LEASE, ReplyCode.HELD):
                return answer
            self._lease.drop(lease)


class _StopSession:
    """A session for emergency stops alone, opened where the rig's own does not reply in time."""

    def __init__(self, reopen: Callable[[float], zenoh.Session]) -> None:
        self._reopen = reopen
        self.session: zenoh.Session | None = None

    def open(self, timeout_s: float) -> None:
        if self.session is None:
            self.session = self._reopen(time.monotonic() + timeout_s)

    def close(self) -> None:
        if self.session is not None:
            close_session(self.session)


def _close(ends: list[Callable[[], object]]) -> None:
    for end in ends:
        with suppress(zenoh.ZError):
            end()


def _live(sample: zenoh.Sample) -> Telemetry:
    trial_id = str(sample.key_expr).rpartition("/")[2]
    return messages.decode_live(trial_id, sample.payload.to_bytes())


def _setter(event: threading.Event) -> Callable[[zenoh.Sample], None]:
    """A callback at each status of a rig without an active trial.

    It refers to the event only: not to the rig, which it would keep alive.
    """

    def set_event(sample: zenoh.Sample) -> None:
        with suppress(ProtocolError):
            if messages.decode(Status, sample.payload.to_bytes()).trial_id:
                return
        event.set()

    return set_event
