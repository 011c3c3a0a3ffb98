"""Single messages to a rig under test."""

import json
import secrets
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import zenoh

from estune.remote import messages
from estune.remote.messages import (
    VERBS,
    Answer,
    Description,
    Following,
    Inquire,
    Keys,
    Part,
    Status,
    digest,
)
from estune.remote.messages.commands import Lease, Submit
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import RENEW_S, Mode
from estune.remote.zenoh.rig_connection import present_at
from estune.trial import TrialRecord, TrialRequest, record_frame

ANSWERED_WITHIN_S = 10.0
"""Timeout of a query, s; generous, as the speed of the machine is not tested."""

MODE_WITHIN_S = 60.0
"""Longest wait for a mode, s."""

HOLDER = "the conformance suite"

PROMPT_S = 0.2
"""Longest time of the fastest of a few replies during a trial, s; they take milliseconds."""

TEST_WITHIN_S = 60.0
"""Time of a test beside its trials, s; one that hangs fails after it."""

PENDING = (ReplyCode.ACCEPTED, ReplyCode.RUNNING, ReplyCode.BUSY)
"""Reply codes of a trial that has no record yet."""


class WireClient:
    """A session that sends single messages to a rig under test."""

    def __init__(self, session: zenoh.Session, name: str | None) -> None:
        """Finds the rig of that name, or the only one."""
        self.session = session
        presence = messages.choose(present_at(session, messages.ANY_RIG), name, "the endpoint")
        self.keys, self.instance = Keys(presence.rig), presence.instance
        self.run = f"conformance-{secrets.token_hex(4)}"
        self.lease = ""
        self._deadline_s = time.monotonic() + TEST_WITHIN_S
        step_s = self.describe().rig.step.duration_s
        self._deadline_s += 10.0 * step_s

    def ask(self, key: str, message: Any) -> bytes:
        """The only reply to a message."""
        self._check_progress(key)
        payload = message if isinstance(message, bytes) else messages.encode(message)
        replies = list(self.session.get(key, payload=payload, timeout=ANSWERED_WITHIN_S))
        assert len(replies) == 1, f"{len(replies)} replies on {key}"
        sample = replies[0].ok
        assert sample is not None, f"an error on {key}"
        assert sample.attachment is not None, f"no instance on {key}"
        assert str(sample.key_expr) == key
        assert sample.attachment.to_bytes() == self.instance.encode()
        return sample.payload.to_bytes()

    def send(self, verb: str, message: Any) -> Answer:
        """Reply to a command, given as a message or as bytes."""
        return messages.decode(Answer, self.ask(self.keys.command(self.instance, verb), message))

    def lacks(self, verb: str) -> bool:
        """Whether the rig does not serve a verb that it may leave out."""
        key = self.keys.command(self.instance, verb)
        return VERBS[verb].optional and not list(
            self.session.get(key, payload=b"", timeout=ANSWERED_WITHIN_S)
        )

    def sent_if_served(self, verb: str, message: Any) -> list[Answer]:
        """Reply to a command that the rig may lack; none if it does."""
        return [] if self.lacks(verb) else [self.send(verb, message)]

    def need(self, verb: str) -> None:
        """Skips a test of a verb that the rig lacks, by a sentence that names it."""
        if self.lacks(verb):
            pytest.skip(
                f"the rig lacks the optional command {verb} of protocol {messages.VERSION}; see "
                "reference/rig-options.md"
            )

    def describe(self) -> Description:
        """Description of the rig."""
        return messages.decode_description(self.ask(self.keys.describe, b""))

    def status(self) -> Status:
        """Status of the rig."""
        return messages.decode(Status, self.ask(self.keys.status, b""))

    def acquire(self) -> None:
        """Acquires the lease."""
        self.lease = secrets.token_hex(8)
        answer = self.send("lease", Lease("acquire", self.lease, HOLDER))
        assert answer.verdict is ReplyCode.ACCEPTED, answer.sentence

    def renew(self) -> None:
        """Renews the lease."""
        self.send("lease", Lease("renew", self.lease))

    def follow(self, tension_N: float, sent_s: float) -> Following | Answer:
        """Reply to a setpoint; its numbers need not be finite."""
        setpoint = {"tension_N": tension_N, "angle_rad": None}
        message = {"lease": self.lease, "sent_s": sent_s, "setpoint": setpoint}
        data = self.ask(self.keys.command(self.instance, "follow"), json.dumps(message).encode())
        if data.startswith(b'{"verdict"'):
            return messages.decode(Answer, data)
        return messages.decode(Following, data)

    def trial(self, number: int = 0, **changes: Any) -> TrialRequest:
        """A trial of the rig's own step; its proportional gain is not the live one."""
        about = self.describe().rig
        gains = replace(about.gains, P=0.9 * about.gains.P)
        return TrialRequest(self.run, number, gains, replace(about.step, **changes))

    def long_trial(self, number: int = 0) -> TrialRequest:
        """A trial that lasts until it is stopped."""
        longest_s = self.describe().rig.limits.duration_max_s
        return self.trial(number, duration_s=min(longest_s, 30.0))

    def submit(self, request: TrialRequest) -> Answer:
        """Reply to a submit; `ended` if it was the record."""
        message = Submit(self.lease, request, digest(request))
        data = self.ask(self.keys.command(self.instance, "submit"), message)
        record = data.startswith(b"RTR1")
        return Answer(ReplyCode.ENDED) if record else messages.decode(Answer, data)

    def inquire(self, request: TrialRequest, **inquiry: int) -> Answer | TrialRecord | Part:
        """State or record of a trial."""
        message = Inquire(digest(request), **inquiry)
        return messages.decode_trial(self.ask(self.keys.result(request.trial_id), message))

    def frame(self, request: TrialRequest) -> bytes:
        """The record's frame, from all its parts, after the end of the trial."""
        key, data = self.keys.result(request.trial_id), b""
        while True:
            got = self.ask(key, Inquire(digest(request), len(data)))
            if not got.startswith(b"RTP1"):
                return got
            part = messages.decode_part(got)
            assert part.offset == len(data)
            data += part.data
            if len(data) == part.total:
                return data

    def code(self, request: TrialRequest) -> ReplyCode:
        """Reply code of an inquiry for a trial without a record."""
        answer = self.inquire(request)
        assert isinstance(answer, Answer), answer
        return answer.verdict

    def record(self, request: TrialRequest) -> TrialRecord:
        """Waits for the record of a trial; renews the lease meanwhile."""
        while True:
            found = self.inquire(request)
            if not isinstance(found, Answer):
                return record_frame.decode(self.frame(request))
            assert found.verdict in PENDING, found
            self.renew()
            time.sleep(RENEW_S / 10)

    def check_prompt(self, query: Callable[[], object]) -> None:
        """Checks that a query is answered at once: the fastest of five, on a machine with load."""
        times_s = []
        for _ in range(5):
            self.renew()
            asked_s = time.monotonic()
            query()
            times_s.append(time.monotonic() - asked_s)
        assert min(times_s) < PROMPT_S, (
            f"the rig took {min(times_s):.2f} s or more for each of five replies in a trial; "
            "a client then takes it for dead"
        )

    def next_sample(self, subscriber: "zenoh.Subscriber[Any]") -> zenoh.Sample:
        """The next publication."""
        while (sample := subscriber.try_recv()) is None:
            self._check_progress("a publication")
            time.sleep(RENEW_S / 10)
        found: zenoh.Sample = sample
        return found

    def _check_progress(self, what: str) -> None:
        """Fails a test that waits for ever, with the name of what it waits for."""
        assert time.monotonic() < self._deadline_s, (
            f"the test hangs: the rig has not come to its end; it last waited for {what}"
        )

    def until(self, *modes: Mode, renew: bool = True) -> Status:
        """Waits for a mode; renews the lease meanwhile."""
        deadline_s = time.monotonic() + MODE_WITHIN_S
        while (status := self.status()).mode not in modes:
            assert time.monotonic() < deadline_s, f"not {modes} but {status}"
            if renew:
                self.renew()
            time.sleep(RENEW_S / 10)
        return status
