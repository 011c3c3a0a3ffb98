"""Fuzz test: no message breaks a rig or a client, and no damaged message is accepted.

Valid frames, parts, live samples, commands and replies are changed at random (bits, bytes, pieces
removed, repeated or exchanged with another message's, numbers in the JSON made extreme) and sent
to their receiver. A frame, a part, live samples and a submit carry a checksum: a changed one must
be refused. Any other message must be refused, or be valid as it stands. Each query must have one
reply that can be decoded, only an `EstuneError` may be raised, and the rig must have run exactly
the trials that were submitted.
"""

import logging
from collections import Counter
from dataclasses import replace
from random import Random

import pytest

from estune.errors import EstuneError
from estune.remote import messages
from estune.remote.ledger import MemoryLedger
from estune.remote.messages import Answer, Description, Inquire, Status, digest
from estune.remote.messages.codec import Message
from estune.remote.messages.commands import Cancel, Clear, Lease, Submit, Void
from estune.remote.zenoh.request_handler import RequestHandler
from estune.trial import TrialRequest, record_frame
from estune.trial.profiles import (
    AnyProfile,
    ChirpProfile,
    MultisineProfile,
    StaircaseProfile,
    TriangleProfile,
)
from experiments.inert_rig import DESCRIBED, RECORD, REQUEST, InertRig
from experiments.misuse.mutations import mutated
from tests.protocol_examples import COMMANDS, EXAMPLES, LEASE, SAMPLES

Sent = tuple[str, bytes]
"""Destination and bytes: a verb, `result/<trial id>`, or `decode/<kind>`."""


PROFILES: tuple[AnyProfile, ...] = (
    REQUEST.profile,
    TriangleProfile(15.0, 5.0, 0.2, 0.5, 0.1, shrink=0.5),
    MultisineProfile(15.0, 1.0, 0.2, 1, 15, 0.5, 0.1, lines="odd_sparse"),
    ChirpProfile(15.0, 2.0, 0.0, 30.0, 0.5, 0.1),
    StaircaseProfile(15.0, 2.0, 3, 0.05, 0.5, 0.1),
)


def seeds() -> list[Sent]:
    """Valid messages of every kind but `submit`."""
    whole = record_frame.encode(RECORD)
    commands = COMMANDS | {
        "lease": Lease("renew", LEASE, "fuzz"),
        "cancel": Cancel(LEASE),
        "void": Void(LEASE, "other-00001", digest(REQUEST)),
    }
    inquiries = (Inquire(digest(REQUEST), n, n) for n in (0, 8))
    replies = [e for e in EXAMPLES if isinstance(e, Answer | Status | Description)]
    return [
        *((f"result/{REQUEST.trial_id}", messages.encode(inquiry)) for inquiry in inquiries),
        *((verb, messages.encode(c)) for verb, c in commands.items() if verb != "submit"),
        *((f"decode/{type(r).__name__}", messages.encode(r)) for r in replies),
        ("decode/frame", whole),
        ("decode/part", messages.encode_part(whole, 16, 100)),
        ("decode/live", messages.encode_live(SAMPLES)),
    ]


class Fuzz:
    """Sends messages to their receivers, and checks the results.

    Attributes:
        counts: Number of messages by destination, refused or understood.
        faults: Violations found.
    """

    def __init__(self, seed: int) -> None:
        self.random = Random(seed)  # noqa: S311  nothing here is secret
        self.rig = InertRig(DESCRIBED, RECORD)
        self.handler = RequestHandler(self.rig, MemoryLedger(), lambda: None, instance="0f")
        self.seeds = seeds()
        self.counts: Counter[str] = Counter()
        self.faults: list[str] = []
        self._submitted: set[TrialRequest] = set()

    def turn(self, number: int) -> None:
        """Sends one changed message, and the valid one if it is a submit."""
        if number % 3:
            where, data = self.random.choice(self.seeds)
        else:
            request = replace(REQUEST, number=number, profile=self.random.choice(PROFILES))
            where = "submit"
            data = messages.encode(Submit(LEASE, request, digest(request)))
        changed = mutated(self.random, data, [other for _, other in self.seeds])
        if where.startswith("decode/"):
            self._decode(where.removeprefix("decode/"), data, changed)
            return
        self._send("lease", messages.encode(Lease("acquire", LEASE, "fuzz")))
        self._send(where, changed)
        if where == "submit":
            self._submitted.add(request)
            self._send(where, data)
        self._send("clear", messages.encode(Clear()))

    def finish(self) -> None:
        """Checks that the rig has run the submitted trials and no other."""
        self.handler.close()
        requests = self.rig.requests
        if len(set(requests)) != len(requests):
            self.faults.append("a trial ran twice")
        if others := [r.trial_id for r in requests if r not in self._submitted]:
            self.faults.append(f"trials ran that were not submitted: {others[:3]}")

    def _send(self, where: str, data: bytes) -> None:
        replies: list[bytes] = []
        verb, _, trial_id = where.partition("/")
        if trial_id:
            self.handler.query(
                lambda: self.handler.result(trial_id, messages.decode(Inquire, data)),
                replies.append,
            )
        else:
            self.handler.command(verb, data, replies.append)
        if len(replies) != 1:
            self.faults.append(f"{len(replies)} replies to {where} {data!r}")
            return
        try:
            reply = messages.decode_trial(replies[0])
        except EstuneError as error:
            self.faults.append(f"the reply to {where} {data!r} cannot be decoded: {error}")
            return
        if isinstance(reply, Answer) and "the rig's own program failed" in reply.sentence:
            self.faults.append(f"{where} {data!r} broke the rig's program: {reply.sentence}")
        refused = isinstance(reply, Answer) and reply.error == "ProtocolError"
        self.counts[f"{verb}, {'refused' if refused else 'understood'}"] += 1

    def _decode(self, what: str, original: bytes, data: bytes) -> None:
        kinds: dict[str, type[Message]] = {
            kind.__name__: kind for kind in (Answer, Status, Description)
        }
        try:
            if what in kinds:
                message = messages.decode(kinds[what], data)
                if messages.decode(kinds[what], messages.encode(message)) != message:
                    self.faults.append(f"{what} {data!r} changes when it is sent on")
            elif what == "live":
                messages.decode_live("fuzz", data)
            else:
                messages.decode_trial(data)
        except EstuneError:
            self.counts[f"{what}, refused"] += 1
            return
        except Exception as error:  # noqa: BLE001  this experiment looks for them
            self.faults.append(f"{what} {data!r} raises {type(error).__name__}: {error}")
            return
        self.counts[f"{what}, understood"] += 1
        if what in ("frame", "part", "live") and data != original:
            self.faults.append(f"a damaged {what} passes for a good one: {data!r}")


def fuzz(mutations: int, seed: int = 0) -> Fuzz:
    """Sends a number of changed messages."""
    logging.disable()  # each stop, and each error of a client, would be a line
    try:
        run = Fuzz(seed)
        for number in range(mutations):
            run.turn(number)
        run.finish()
    finally:
        logging.disable(logging.NOTSET)
    return run


@pytest.mark.parametrize(
    "mutations",
    [
        3_000,
        pytest.param(10_000, marks=pytest.mark.slow),
        pytest.param(120_000, marks=pytest.mark.nightly),
    ],
)
def test_fuzz_finds_no_faults(mutations):
    run = fuzz(mutations, seed=1)
    assert run.faults == []
    assert len(run.rig.requests) > 0.3 * mutations
    assert run.counts["submit, refused"] > 0.3 * mutations
    assert all(f"{name}, refused" in run.counts for name in ("frame", "part", "live", "gains"))
