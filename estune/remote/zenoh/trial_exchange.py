"""Submission of one trial at most once, and retrieval of its record.

Executes the state machine `estune.remote.state_machine.client`.
"""

import threading
import time
from typing import NamedTuple

from estune.errors import Interrupted, ProtocolError, RigError
from estune.remote import messages
from estune.remote.messages import Answer, Inquire, Part
from estune.remote.messages.commands import Submit
from estune.remote.state_machine import client as machine
from estune.remote.state_machine.client import Action, ClientInput
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.zenoh.client_lease import ClientLease
from estune.remote.zenoh.rig_connection import RigConnection
from estune.remote.zenoh.zenoh_session import AGAIN_S
from estune.trial import TrialRecord, TrialRequest
from estune.trial.record_frame import decode

# Between a status that is lost and the next query; a rig publishes its status when a trial ends.
# The first query comes after as long as the last trial took: then most trials need none. Ten a
# trial were a third of what a daemon of many rigs computed.
_POLL_FIRST_S, _POLL_MAX_S, _POLL_GROWTH = 0.004, 0.5, 4.0


class NoRecord(NamedTuple):
    """A trial that ended without a record, and why."""

    action: Action
    sentence: str


class TrialExchange:
    """One trial on the client's side."""

    def __init__(
        self,
        connection: RigConnection,
        lease: ClientLease,
        request: TrialRequest,
        at_rest: threading.Event,
        expected_s: float,
    ) -> None:
        self.digest = messages.digest(request)
        self._connection = connection
        self._lease = lease
        self._request = request
        self._at_rest = at_rest
        self._step = machine.START
        self._answer = Answer(ReplyCode.UNKNOWN)
        self._heard: ReplyCode | ClientInput | None = None
        self._record: TrialRecord | None = None
        self._silent_since_s: float | None = None
        self._explanation = ""
        self._pause_s = min(max(expected_s, _POLL_FIRST_S), _POLL_MAX_S)

    def run(self) -> TrialRecord | NoRecord:
        """Follows the trial to its end.

        Raises:
            EstuneError: the error of the rig, or the reason why nothing is known.
        """
        while True:
            match self._step.action:
                case Action.SUBMIT:
                    self._submit()
                case Action.INQUIRE:
                    self._inquire()
                case Action.WAIT:
                    # The rig publishes its status when a trial ends; else it is queried again.
                    self._at_rest.wait(self._pause_s)
                    self._at_rest.clear()
                    self._pause_s = min(self._pause_s * _POLL_GROWTH, _POLL_MAX_S)
                    self._inquire()
                case Action.LEASE:
                    self._lease.hold()
                    self._advance(ClientInput.LEASED)
                case _:
                    return self._result()

    def _submit(self) -> None:
        lease = self._lease.hold()
        command = Submit(lease, self._request, self.digest)
        self._at_rest.clear()
        self._step = machine.sent(self._step)
        key = self._connection.command_key(command)
        self._receive(self._connection.ask(key, messages.encode(command)), lease)

    def _inquire(self) -> None:
        self._receive(self._ask_result())

    def _ask_result(self, offset: int = 0) -> bytes | None:
        key = self._connection.keys.result(self._request.trial_id)
        return self._connection.ask(key, messages.encode(Inquire(self.digest, offset)))

    def _receive(self, data: bytes | None, lease: str = "") -> None:
        """Processes a reply, or its absence, to a query that carried a lease or none."""
        if data is None:
            self._process_silence()
            return
        self._silent_since_s = None
        reply = messages.decode_trial(data)
        if isinstance(reply, Part):
            self._gather(reply)
        elif isinstance(reply, Answer):
            self._answer = reply
            if reply.verdict in (ReplyCode.NO_LEASE, ReplyCode.HELD):
                self._lease.drop(lease)
            own = reply.trial_id in ("", self._request.trial_id)
            self._advance(reply.verdict, own=own)
        else:
            self._keep(reply)

    def _keep(self, record: TrialRecord) -> None:
        if record.trial_id != self._request.trial_id:
            raise ProtocolError(
                f"rig {self._connection.name!r} answers trial {self._request.trial_id} with a "
                f"record of {record.trial_id}"
            )
        self._record = record
        self._advance(ClientInput.RECORD)

    def _gather(self, part: Part) -> None:
        """Queries the rest of a record that is sent in parts."""
        total, frame, rig = part.total, bytearray(), f"rig {self._connection.name!r}"
        while True:
            if part.offset != len(frame) or part.total != total:
                raise ProtocolError(
                    f"{rig} was asked for byte {len(frame)} of a record of {total} bytes, and "
                    f"answers with byte {part.offset} of {part.total}"
                )
            frame += part.data
            if len(frame) == total:
                self._keep(decode(bytes(frame)))
                return
            data = self._ask_result(len(frame))
            if data is None:
                self._process_silence()
                return
            reply = messages.decode_trial(data)
            if not isinstance(reply, Part):
                raise ProtocolError(f"{rig} answers byte {len(frame)} of a record with no part")
            part = reply

    def _process_silence(self) -> None:
        if self._silent_since_s is None:
            self._silent_since_s = time.monotonic()
        status = self._connection.check_liveliness(self._silent_since_s)
        self._explanation = status.sentence
        self._advance(status.heard)
        time.sleep(AGAIN_S)

    def _advance(self, heard: ReplyCode | ClientInput, *, own: bool = True) -> None:
        self._heard = heard
        self._step = machine.next_transition(self._step.stage, heard, own=own)

    def _result(self) -> TrialRecord | NoRecord:
        action, rig = self._step.action, f"rig {self._connection.name!r}"
        trial = f"trial {self._request.trial_id}"
        if action is Action.RECORD and self._record is not None:
            return self._record
        if action in (Action.INTERRUPTED, Action.NOTHING_RAN):
            return NoRecord(action, self._answer.verdict.sentence)
        # A submit still in transit must find a lease that is no longer the rig's.
        self._lease.release()
        if action is Action.FAIL:
            self._answer.check()
            raise ProtocolError(f"{rig} replies {self._answer.verdict} to a trial")
        why = self._explanation or f"{rig} has no entry of it"
        if action is Action.GONE:
            raise RigError(f"{trial} did not run: {why}")
        about = self._connection.about
        if self._heard is ClientInput.GONE or about is None or about.rig.simulated:
            # No order to inspect: whoever asks again by itself, as a daemon does, learns it then.
            raise RigError(
                f"{trial} may have run: {why}; when the run is resumed, the rig's ledger says "
                "whether it has"
            )
        # A ledger without the trial would let it run again: a person must look before.
        raise Interrupted(f"{trial} may have run: {why}")
