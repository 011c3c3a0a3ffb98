"""Carries out what the state machine of `estune.remote.state_machine.client` says, for one trial."""

import threading
import time
from typing import NamedTuple

from estune.errors import ProtocolError, RigError
from estune.remote import messages
from estune.remote.messages import Answer, Inquire, Part, Submit
from estune.remote.state_machine import client as machine
from estune.remote.state_machine.client import Action, ClientInput
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.zenoh.lease_renewal import LeaseRenewer
from estune.remote.zenoh.rig_connection import AGAIN_S, RigConnection
from estune.trial import TrialRecord, TrialRequest
from estune.trial.record_frame import decode

_POLL_FIRST_S, _POLL_MAX_S, _POLL_GROWTH = 0.002, 0.05, 1.5


class NoRecord(NamedTuple):
    """A trial that came to nothing, and why."""

    action: Action
    sentence: str


class TrialExchange:
    """Wants one trial run, once, and its record."""

    def __init__(
        self,
        talk: RigConnection,
        lease: LeaseRenewer,
        request: TrialRequest,
        changed: threading.Event,
    ) -> None:
        """`changed` is set whenever the rig says that its status has changed."""
        self.digest = messages.digest(request)
        self._talk = talk
        self._lease = lease
        self._request = request
        self._changed = changed
        self._step = machine.START
        self._answer = Answer(ReplyCode.UNKNOWN)
        self._record: TrialRecord | None = None
        self._silent_since_s: float | None = None
        self._lost = ""
        self._pause_s = _POLL_FIRST_S

    def run(self) -> TrialRecord | NoRecord:
        """Sees the trial through.

        Raises:
            EstuneError: what the rig said, or why nothing is known.
        """
        while True:
            match self._step.action:
                case Action.SUBMIT:
                    self._ask(submit=True)
                case Action.INQUIRE:
                    self._ask(submit=False)
                case Action.WAIT:
                    self._wait()
                case Action.LEASE:
                    self._lease.hold()
                    self._advance(ClientInput.LEASED)
                case _:
                    return self._result()

    def _ask(self, *, submit: bool) -> None:
        """Asks once, and hears what comes of it."""
        if submit:
            lease = self._lease.hold()
            key = self._talk.keys.command(self._talk.instance, "submit")
            payload = messages.encode(Submit(lease, self._request, self.digest))
            self._changed.clear()
        else:
            key = self._talk.keys.result(self._request.trial_id)
            payload = messages.encode(Inquire(self.digest))
        self._step = machine.sent(self._step)
        data = self._talk.ask(key, payload)
        if data is None:
            self._silence()
            return
        self._silent_since_s = None
        found = messages.decode_trial(data)
        if isinstance(found, Part):
            self._gather(found)
        elif isinstance(found, Answer):
            self._answer = found
            if submit and found.verdict in (ReplyCode.NO_LEASE, ReplyCode.HELD):
                self._lease.lost(lease)
            own = found.trial_id in ("", self._request.trial_id)
            self._advance(found.verdict, own=own)
        else:
            self._keep(found)

    def _keep(self, record: TrialRecord) -> None:
        if record.trial_id != self._request.trial_id:
            raise ProtocolError(
                f"rig {self._talk.name!r} answers trial {self._request.trial_id} with a record of "
                f"{record.trial_id}"
            )
        self._record = record
        self._advance(ClientInput.RECORD)

    def _gather(self, part: Part) -> None:
        """Asks for the rest of a record that comes in parts."""
        total, frame = part.total, bytearray()
        key = self._talk.keys.result(self._request.trial_id)
        while True:
            if part.offset != len(frame) or part.total != total:
                raise ProtocolError(
                    f"rig {self._talk.name!r} was asked for byte {len(frame)} of a record of "
                    f"{total} bytes, and answers with byte {part.offset} of {part.total}"
                )
            frame += part.data
            if len(frame) == total:
                self._keep(decode(bytes(frame)))
                return
            inquiry = messages.encode(Inquire(self.digest, len(frame)))
            data = self._talk.ask(key, inquiry)
            if data is None:
                self._silence()
                return
            found = messages.decode_trial(data)
            if not isinstance(found, Part):
                raise ProtocolError(
                    f"rig {self._talk.name!r} answers byte {len(frame)} of a record with no part"
                )
            part = found

    def _silence(self) -> None:
        now_s = time.monotonic()
        if self._silent_since_s is None:
            self._silent_since_s = now_s
        sign = self._talk.check_liveliness(self._silent_since_s)
        self._lost = sign.sentence
        self._advance(sign.heard)
        time.sleep(AGAIN_S)

    def _wait(self) -> None:
        """The rig tells when a trial has ended; else ask again."""
        self._changed.wait(self._pause_s)
        self._changed.clear()
        self._pause_s = min(self._pause_s * _POLL_GROWTH, _POLL_MAX_S)
        self._ask(submit=False)

    def _advance(self, heard: ReplyCode | ClientInput, *, own: bool = True) -> None:
        self._step = machine.next_transition(self._step.stage, heard, own=own)

    def _result(self) -> TrialRecord | NoRecord:
        action, trial_id = self._step.action, self._request.trial_id
        if action is Action.RECORD and self._record is not None:
            return self._record
        if action in (Action.INTERRUPTED, Action.NOTHING_RAN):
            return NoRecord(action, self._answer.verdict.sentence)
        # Whatever of it is still on its way must find a lease that is not the rig's any more.
        self._lease.release()
        if action is Action.FAIL:
            self._answer.check()
            raise ProtocolError(f"rig {self._talk.name!r} says {self._answer.verdict} to a trial")
        about = (
            f"trial {trial_id} may have run: see to the rig, then resume the run"
            if action is Action.AMBIGUOUS
            else f"trial {trial_id} did not run"
        )
        lost = self._lost or f"rig {self._talk.name!r} has forgotten trial {trial_id}"
        raise RigError(f"{lost}; {about}")
