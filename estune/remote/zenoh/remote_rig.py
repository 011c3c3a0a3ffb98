"""A rig in another process, reached over Zenoh."""

import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from typing import Literal, Self

import zenoh

from estune.core.gains import Gains
from estune.errors import RigError
from estune.remote import messages
from estune.remote.messages import (
    Answer,
    Cancel,
    Clear,
    Estop,
    Inquire,
    SetGains,
    Status,
    Void,
    check_name,
)
from estune.remote.messages.keys import Verb
from estune.remote.state_machine.client import Action
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.zenoh.lease_renewal import LeaseRenewer
from estune.remote.zenoh.rig_connection import AGAIN_S, RigConnection
from estune.remote.zenoh.trial_exchange import TrialExchange
from estune.remote.zenoh.zenoh_session import close_session
from estune.trial import (
    Outcome,
    RigDescription,
    Telemetry,
    TrialRecord,
    TrialRequest,
    empty_record,
)

_SAMPLES_WAITING_MAX = 64
_STOPPED_WITHIN_S = 0.3


class RemoteRig:
    """A rig in another process; the `Rig` protocol over Zenoh. Made by `estune.remote.zenoh.connect`.

    The first command asks for the right to command the rig, which is then kept, by a thread, until
    `release` or `close`; looking on needs none. A rig that is restarted is followed if its ledger
    tells what it ran before, or if it is simulated.

    Ctrl-C gets through at any time; a trial then under way goes on at the rig until `abort`.
    """

    def __init__(
        self,
        talk: RigConnection,
        reopen: Callable[[float], zenoh.Session],
        holder: str,
    ) -> None:
        self.name = talk.name
        self._talk = talk
        self._lease = LeaseRenewer(talk, holder)
        self._stop_session = _StopSession(reopen)
        # Lets go of all of it when this object is let go of or the interpreter ends, too.
        self._finish = weakref.finalize(self, _let_go, self._lease, self._stop_session, talk)
        self._changed = threading.Event()
        wake = zenoh.handlers.Callback(_setter(self._changed), indirect=False)
        talk.session.declare_subscriber(talk.keys.status, wake)
        self._unanswered: tuple[str, str] | None = None
        self.describe()

    def describe(self) -> RigDescription:
        """What the rig is, and which gains are live now.

        Raises:
            RigError: it cannot be reached.
        """
        return self._talk.describe().rig

    def status(self) -> Status:
        """What the rig does now, and who commands it.

        Raises:
            RigError: it cannot be reached.
        """
        data = self._talk.query_until_answered(lambda: self._talk.keys.status, b"", "")
        return messages.decode(Status, data)

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs one trial, or returns the record of it if that trial id has run before.

        A trial that was cut off or never begun has a record too, of outcome `interrupted` or
        `cancelled` and without samples.

        Raises:
            InvalidInput: the request is outside the rig's limits; nothing moved.
            RigError: another client holds the rig, it is held in its safe state, knows another
                trial by that id, cannot be reached, or is gone; where the trial may have run, the
                message says so.
        """
        trial_id = check_name("trial id", request.trial_id)
        asking = TrialExchange(self._talk, self._lease, request, self._changed)
        self._unanswered = trial_id, asking.digest
        found = asking.run()
        self._unanswered = None
        if isinstance(found, TrialRecord):
            return found
        outcome = Outcome.INTERRUPTED if found.action is Action.INTERRUPTED else Outcome.CANCELLED
        about = self._talk.about or self._talk.describe()
        at = datetime.now(UTC).isoformat(timespec="milliseconds")
        return empty_record(request, about.rig, outcome, found.sentence, at)

    def has_failed(self, request: TrialRequest) -> bool:
        """Whether a trial can never be had under its id: the rig's own program failed in it.

        Or its record is gone, or another trial had the id.

        Raises:
            RigError: it cannot be reached.
        """
        inquiry = messages.encode(Inquire(messages.digest(request)))
        data = self._talk.query_until_answered(
            lambda: self._talk.keys.result(request.trial_id), inquiry, ""
        )
        found = messages.decode_trial(data)
        return isinstance(found, Answer) and found.verdict is ReplyCode.REFUSED

    def apply(self, gains: Gains) -> None:
        """Makes gains the live ones.

        Raises:
            InvalidInput: the rig refuses them.
            RigError: the rig is held by another, busy with a trial, in its safe state, cannot be
                reached, or is gone.
        """
        about = f"; whether it took the gains {gains} is not known"
        self._command("gains", lambda lease: SetGains(lease, gains), about).check()

    def abort(self) -> RigDescription:
        """Stops the trial under way, and returns once the live gains are back.

        Raises:
            RigError: another client holds the rig, the trial cannot be stopped, or the rig cannot
                be reached.
        """
        about = "; see to the rig: whether it has stopped is not known"
        self._void(about)
        trial_id = ""
        while True:
            message = messages.encode(Cancel(self._lease.token, trial_id))
            data = self._talk.query_until_answered(partial(self._key, "cancel"), message, about)
            answer = messages.decode(Answer, data)
            if answer.verdict is ReplyCode.NO_LEASE:
                self._lease.lost(self._lease.token)
                self._lease.hold()
                continue
            answer.check()
            if not answer.trial_id:
                return self.describe()
            trial_id = answer.trial_id  # from now on this one, and not the next that is begun
            time.sleep(AGAIN_S)

    def estop(self, reason: str) -> None:
        """Brings the rig to its safe state, whoever commands it. It stays there until cleared.

        Raises:
            RigError: it did not answer: see to the rig by other means.
        """
        message = messages.encode(Estop(reason[: messages.HOLDER_MAX]))
        asked_s = time.monotonic()
        while True:
            data = self._talk.ask(
                *(self._key("estop"), message),
                timeout_s=_STOPPED_WITHIN_S,
                session=self._stop_session.get(self._talk.timeout_s),
                priority=zenoh.Priority.REAL_TIME,
            )
            if data is not None:
                return messages.decode(Answer, data).check()
            if time.monotonic() - asked_s > self._talk.timeout_s:
                raise RigError(
                    f"rig {self.name!r} has not answered the emergency stop: it must be taken as "
                    "not stopped; cut its power"
                )
            self._talk.check_liveliness(asked_s)

    def clear(self) -> None:
        """Ends an emergency stop. For whoever has seen to the rig.

        Raises:
            RigError: a trial is still being stopped, or the rig cannot be reached.
        """
        message = messages.encode(Clear())
        about = "; whether the stop is cleared is not known"
        data = self._talk.query_until_answered(partial(self._key, "clear"), message, about)
        messages.decode(Answer, data).check()

    @contextmanager
    def watch(self) -> Iterator[Iterator[Telemetry]]:
        """Samples of trials as they run, so long as the block lasts; missed by who is too slow."""
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(
            _SAMPLES_WAITING_MAX
        )
        with self._talk.session.declare_subscriber(
            self._talk.keys.telemetry("*"), ring
        ) as subscriber:
            yield map(_live, subscriber)

    def acquire(self) -> None:
        """Asks for the right to command now, rather than with the first command.

        Raises:
            RigError: another client holds the rig, or it cannot be reached.
        """
        self._lease.hold()

    def release(self) -> None:
        """Gives the right to command back before `close`. A trial under way is stopped by it."""
        self._lease.release()

    def close(self) -> None:
        """Lets go of the rig; further calls are refused. A trial under way is stopped by it."""
        self._finish()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _void(self, about: str) -> None:
        """Sees to it that a trial whose submit was left unanswered does not run after all."""
        if self._unanswered is None or not self._lease.token:
            return
        trial_id, digest = self._unanswered
        while (
            self._command("void", lambda lease: Void(lease, trial_id, digest), about).verdict
            is ReplyCode.BUSY
        ):
            time.sleep(AGAIN_S)  # it is being written into the ledger
        self._unanswered = None

    def _command(
        self, verb: Literal["gains", "void"], message: Callable[[str], object], about: str
    ) -> Answer:
        """Gives a command that needs the lease, under a new one if the old was lost."""
        while True:
            lease = self._lease.hold()
            payload = messages.encode(message(lease))
            data = self._talk.query_until_answered(partial(self._key, verb), payload, about)
            answer = messages.decode(Answer, data)
            if answer.verdict not in (ReplyCode.NO_LEASE, ReplyCode.HELD):
                return answer
            self._lease.lost(lease)

    def _key(self, verb: Verb) -> str:
        return self._talk.keys.command(self._talk.instance, verb)


class _StopSession:
    """A session for emergency stops alone, opened when first needed: nothing queues before it."""

    def __init__(self, reopen: Callable[[float], zenoh.Session]) -> None:
        self._reopen = reopen
        self._session: zenoh.Session | None = None

    def get(self, timeout_s: float) -> zenoh.Session:
        if self._session is None:
            self._session = self._reopen(time.monotonic() + timeout_s)
        return self._session

    def close(self) -> None:
        if self._session is not None:
            close_session(self._session)


def _let_go(lease: LeaseRenewer, stops: _StopSession, talk: RigConnection) -> None:
    lease.close()
    stops.close()
    talk.close()


def _live(sample: zenoh.Sample) -> Telemetry:
    trial_id = str(sample.key_expr).rpartition("/")[2]
    return messages.decode_live(trial_id, sample.payload.to_bytes())


def _setter(event: threading.Event) -> Callable[[zenoh.Sample], None]:
    """A callback that sets an event, and holds nothing else: least of all the rig."""

    def set_event(_: zenoh.Sample) -> None:
        event.set()

    return set_event
