"""The rig protocol as a rig must speak it, message by message; see docs/rig-protocol.md.

With --endpoint, the rig there is held to it instead of our own. It will move: it runs the step
trial it suggests, is stopped in the middle of one, and has its emergency stop called.
"""

import json
import secrets
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zenoh

from estune.remote import messages
from estune.remote.messages import (
    Answer,
    Cancel,
    Clear,
    Estop,
    Inquire,
    Keys,
    Lease,
    Part,
    Presence,
    SetGains,
    Status,
    Submit,
    Void,
    digest,
)
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import LEASE_S, RENEW_S, Mode
from estune.remote.zenoh import connect
from estune.remote.zenoh.discovery import RECORDS_MAX_BYTES
from estune.remote.zenoh.zenoh_session import open_session
from estune.trial import Outcome, TrialRequest, record_frame
from tests.serve_rig import served

ANSWERED_WITHIN_S = 10.0  # generous: what is timed is not how fast this machine is
PENDING = (ReplyCode.ACCEPTED, ReplyCode.RUNNING, ReplyCode.BUSY)


class Board:
    """A rig and a session beside it, to say single messages to it."""

    def __init__(self, session: zenoh.Session, name: str | None) -> None:
        self.session = session
        tokens = session.liveliness().get(messages.ANY_RIG, timeout=ANSWERED_WITHIN_S)
        found = {Presence.parse(str(reply.ok.key_expr)) for reply in tokens}
        presence = messages.choose(found, name, "the endpoint")
        self.keys, self.instance = Keys(presence.rig), presence.instance
        self.run = f"conformance-{secrets.token_hex(4)}"
        self.lease = ""

    def ask(self, key: str, message: object) -> bytes:
        """The one answer to a message."""
        payload = message if isinstance(message, bytes) else messages.encode(message)
        replies = list(self.session.get(key, payload=payload, timeout=ANSWERED_WITHIN_S))
        assert len(replies) == 1, f"{len(replies)} replies on {key}"
        sample = replies[0].result
        assert str(sample.key_expr) == key
        assert sample.attachment.to_bytes() == self.instance.encode()
        return sample.payload.to_bytes()

    def say(self, verb: str, message: object) -> Answer:
        return messages.decode(Answer, self.ask(self.keys.command(self.instance, verb), message))

    def describe(self):
        return messages.decode_description(self.ask(self.keys.describe, b""))

    def status(self) -> Status:
        return messages.decode(Status, self.ask(self.keys.status, b""))

    def acquire(self) -> str:
        self.lease = secrets.token_hex(8)
        answer = self.say("lease", Lease("acquire", self.lease, "the conformance suite"))
        assert answer.verdict is ReplyCode.ACCEPTED, answer.sentence
        return self.lease

    def trial(self, number: int = 0, **changes) -> TrialRequest:
        about = self.describe().rig
        gains = replace(about.gains, P=0.9 * about.gains.P)
        return TrialRequest(self.run, number, gains, replace(about.step, **changes))

    def long_trial(self, number: int = 0) -> TrialRequest:
        longest_s = self.describe().rig.limits.duration_max_s
        return self.trial(number, duration_s=min(longest_s, 30.0))

    def submit(self, request: TrialRequest) -> Answer | None:
        """The answer to a submit; None if it was the record."""
        message = Submit(self.lease, request, digest(request))
        data = self.ask(self.keys.command(self.instance, "submit"), message)
        return None if data.startswith(b"RTR1") else messages.decode(Answer, data)

    def look(self, request: TrialRequest, **inquiry):
        inquire = Inquire(digest(request), **inquiry)
        return messages.decode_trial(self.ask(self.keys.result(request.trial_id), inquire))

    def frame(self, request: TrialRequest) -> bytes:
        """The record's frame, from as many parts as it comes in. The trial has ended."""
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

    def record(self, request: TrialRequest):
        """The record of a trial, once it has ended; keeps the lease meanwhile."""
        while True:
            found = self.look(request)
            if not isinstance(found, Answer):
                return record_frame.decode(self.frame(request))
            assert found.verdict in PENDING, found
            self.say("lease", Lease("renew", self.lease))
            time.sleep(RENEW_S / 10)

    def until(self, *modes: Mode, renew: bool = True) -> Status:
        while (status := self.status()).mode not in modes:
            if renew:
                self.say("lease", Lease("renew", self.lease))
            time.sleep(RENEW_S / 10)
        return status


@contextmanager
def small_board(folder: Path):
    """The board that knows nothing of estune, in a process of its own."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.small_board", "board", str(folder / "board.json")],
        cwd=Path(__file__).parent.parent,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield process, process.stdout.readline().strip()
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()


def pytest_generate_tests(metafunc):
    if "where" in metafunc.fixturenames:
        given = metafunc.config.getoption("--endpoint")
        metafunc.parametrize("where", ["yours"] if given else ["ours", "board"], scope="module")


@pytest.fixture(scope="module")
def endpoint(where, request, tmp_path_factory):
    if where == "yours":
        yield request.config.getoption("--endpoint")
    elif where == "board":
        with small_board(tmp_path_factory.mktemp("board")) as (_, found):
            yield found
    else:
        with served("paced simulated") as server:
            yield server.endpoint


@pytest.fixture
def board(endpoint, request):
    """The rig, at rest, and the lease on it."""
    with ExitStack() as stack:
        session = open_session("client", connect=(endpoint,), message_max_bytes=RECORDS_MAX_BYTES)
        stack.callback(session.close)
        board = Board(session, request.config.getoption("--rig"))
        board.until(Mode.IDLE, Mode.SAFE, renew=False)
        board.say("clear", Clear())
        board.acquire()
        yield board
        board.say("lease", Lease("release", board.lease))


def test_it_says_what_it_is(board):
    about = board.describe()
    assert (about.rig.name, about.instance) == (board.keys.rig, board.instance)
    assert about.ledger
    about.rig.limits.check(about.rig.step)
    assert board.describe() == about


def test_a_trial_runs_once_and_its_record_is_what_was_asked_for(board):
    request, before = board.trial(), board.describe().rig
    ended = board.status().ended
    first = board.submit(request)
    assert first is None or first.verdict in (*PENDING, ReplyCode.ENDED)
    record = board.record(request)
    assert (record.trial_id, record.rig) == (request.trial_id, before.name)
    assert (record.outcome, record.gains) == (Outcome.DONE, request.gains)
    setpoint = request.profile.setpoint(record.sampling_Hz)
    np.testing.assert_allclose(record.setpoint_N, setpoint, rtol=1e-6)
    assert np.all(np.isfinite(record.tension_N))
    assert board.describe().rig.gains == before.gains
    again = board.submit(request)
    assert again is None or again.verdict is ReplyCode.ENDED
    assert board.status().ended == ended + 1


def test_a_record_can_be_had_in_parts(board):
    request = board.trial()
    board.submit(request)
    board.record(request)
    whole = board.frame(request)
    data = b""
    while len(data) < len(whole):
        part = board.look(request, offset=len(data), length=700)
        assert isinstance(part, Part)
        assert (part.offset, part.total, len(part.data) <= 700) == (len(data), len(whole), True)
        data += part.data
    assert data == whole


def test_a_trial_id_stands_for_one_request(board):
    request = board.trial()
    board.submit(request)
    board.record(request)
    other = replace(request, gains=replace(request.gains, P=1.1 * request.gains.P))
    for answer in (board.submit(other), board.look(other)):
        assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "RigError")


def test_what_was_never_asked_for_is_unknown(board):
    assert board.look(board.trial(99)).verdict is ReplyCode.UNKNOWN


def test_outside_its_limits_nothing_moves(board):
    limits = board.describe().rig.limits
    too_high = 2.0 * limits.tension_max_N if np.isfinite(limits.tension_max_N) else 1e300
    for number, changes in enumerate(
        ({"step_N": too_high}, {"duration_s": 2.0 * limits.duration_max_s + 1.0})
    ):
        answer = board.submit(board.trial(number, **changes))
        assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "InvalidInput")
        assert board.look(board.trial(number, **changes)).verdict is ReplyCode.UNKNOWN


def test_without_the_lease_nothing_is_commanded_and_who_holds_it_is_told(board):
    request, mine = board.trial(), board.lease
    board.lease = "0" * 16
    gains = board.describe().rig.gains
    for answer in (
        board.say("lease", Lease("acquire", board.lease, "another")),
        *(board.say("lease", Lease(action, board.lease)) for action in ("renew", "release")),
        board.submit(request),
        board.say("gains", SetGains(board.lease, gains)),
        board.say("void", Void(board.lease, request.trial_id, digest(request))),
    ):
        assert answer.verdict is ReplyCode.HELD
        assert "the conformance suite" in answer.sentence
    assert board.look(request).verdict is ReplyCode.UNKNOWN
    board.say("lease", Lease("release", mine))
    assert board.submit(request).verdict is ReplyCode.NO_LEASE
    assert board.status().holder == ""
    board.lease = mine
    board.acquire()


def test_a_lease_that_is_not_renewed_ends_and_the_trial_with_it(board):
    request = board.long_trial()
    board.submit(request)
    board.until(Mode.RUNNING)
    began_s = time.monotonic()
    board.until(Mode.IDLE, renew=False)
    assert time.monotonic() - began_s > LEASE_S / 2
    record = board.record(request)
    assert (record.outcome, bool(record.reason)) == (Outcome.CANCELLED, True)
    assert board.submit(board.trial(1)).verdict is ReplyCode.NO_LEASE
    board.acquire()


def test_a_client_that_lets_go_ends_its_trial(board):
    request = board.long_trial()
    board.submit(request)
    board.until(Mode.RUNNING)
    board.say("lease", Lease("release", board.lease))
    board.until(Mode.IDLE, renew=False)
    assert board.record(request).outcome is Outcome.CANCELLED
    board.acquire()


def test_one_trial_at_a_time_and_it_can_be_cancelled(board):
    request, gains = board.long_trial(), board.describe().rig.gains
    board.submit(request)
    status = board.until(Mode.RUNNING)
    assert (status.trial_id, status.holder) == (request.trial_id, "the conformance suite")
    for answer in (board.submit(board.trial(1)), board.say("gains", SetGains(board.lease, gains))):
        assert (answer.verdict, answer.trial_id) == (ReplyCode.BUSY, request.trial_id)
    assert board.say("cancel", Cancel(board.lease, "another-00000")).trial_id == ""
    while (
        answer := board.submit(request)
    ).verdict is ReplyCode.ACCEPTED:  # the ledger is written after the mode
        board.say("lease", Lease("renew", board.lease))
    assert answer.verdict is ReplyCode.RUNNING
    while board.say("cancel", Cancel(board.lease)).trial_id:
        board.say("lease", Lease("renew", board.lease))
    record = board.record(request)
    assert (record.outcome, bool(record.reason)) == (Outcome.CANCELLED, True)
    assert board.describe().rig.gains == gains
    assert board.say("cancel", Cancel(board.lease)) == Answer(ReplyCode.ACCEPTED)


def test_a_voided_trial_never_runs(board):
    request, ended = board.trial(), board.status().ended
    void = Void(board.lease, request.trial_id, digest(request))
    assert board.say("void", void).verdict is ReplyCode.VOID
    assert board.submit(request).verdict is ReplyCode.VOID
    assert board.look(request).verdict is ReplyCode.VOID
    other = board.trial(1)
    board.submit(other)
    board.record(other)
    late = Void(board.lease, other.trial_id, digest(other))
    assert board.say("void", late).verdict is ReplyCode.ENDED
    assert board.status().ended == ended + 1


def test_gains_are_live_once_they_are_set(board):
    before = board.describe().rig.gains
    other = replace(before, P=0.8 * before.P)
    for gains in (other, before):
        assert board.say("gains", SetGains(board.lease, gains)).verdict is ReplyCode.ACCEPTED
        assert board.describe().rig.gains == gains


@pytest.mark.parametrize("payload", [b"", b'{"reason":"smoke"}', b"\xff{", b'{"reason":3}'])
def test_an_emergency_stop_is_obeyed_whatever_it_says_and_holds(board, payload):
    request, gains = board.long_trial(), board.describe().rig.gains
    board.submit(request)
    board.until(Mode.RUNNING)
    assert board.say("estop", payload).verdict is ReplyCode.ACCEPTED
    status = board.until(Mode.SAFE)
    assert bool(status.latched)
    assert board.record(request).outcome is Outcome.CANCELLED
    for answer in (board.submit(board.trial(1)), board.say("gains", SetGains(board.lease, gains))):
        assert answer.verdict is ReplyCode.SAFE
    assert board.say("estop", Estop("again")).verdict is ReplyCode.ACCEPTED
    assert board.say("clear", Clear()).verdict is ReplyCode.ACCEPTED
    assert board.status().mode is Mode.LEASED
    board.submit(board.trial(1))
    assert board.record(board.trial(1)).outcome is Outcome.DONE


def test_what_is_no_command_is_refused_and_harms_nothing(board):
    request = board.trial()
    good = json.loads(messages.encode(Submit(board.lease, request, digest(request))))
    wrong = [b"", b"\xff\xfe", b"[]", b"[" * 2000, b'{"x":1}', b"{}" + b" " * 2048]
    wrong += [
        json.dumps(good | changes).encode()
        for changes in ({"colour": "red"}, {"digest": 3}, {"request": None})
    ]
    nested = json.loads(json.dumps(good))
    for value in (float("nan"), "1", None, -1.0):
        nested["request"]["gains"]["P"] = value
        wrong.append(json.dumps(nested).encode())
    for verb in ("lease", "submit", "cancel", "void", "gains", "clear"):
        for payload in wrong:
            if verb == "clear" and payload.strip() == b"{}" and len(payload) <= 2048:
                continue
            answer = board.say(verb, payload)
            assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "ProtocolError")
    assert board.look(request).verdict is ReplyCode.UNKNOWN
    assert board.status().mode is Mode.LEASED


def test_no_wildcard_reaches_a_command_and_no_other_instance_is_answered_for(board):
    request = board.trial()
    payload = messages.encode(Submit(board.lease, request, digest(request)))
    keys = ("reel/**", f"{board.keys.root}/*/*/submit", board.keys.command("0" * 8, "submit"))
    for key in keys:
        target = zenoh.QueryTarget.ALL
        for reply in board.session.get(key, payload=payload, target=target, timeout=5.0):
            assert "@cmd" not in str(reply.result.key_expr)
    assert board.look(request).verdict is ReplyCode.UNKNOWN


def test_each_change_of_its_status_is_published(board):
    ring = zenoh.handlers.RingChannel(100)
    with board.session.declare_subscriber(board.keys.status, ring) as told:
        request = board.trial()
        board.submit(request)
        board.record(request)
        ended = board.status().ended
        while True:
            sample = told.recv()
            assert sample.attachment.to_bytes() == board.instance.encode()
            if messages.decode(Status, sample.payload.to_bytes()).ended == ended:
                break


def test_a_client_of_ours_tunes_with_it(endpoint, board, request):
    board.say("lease", Lease("release", board.lease))
    with connect(endpoint, rig=request.config.getoption("--rig")) as rig:
        trial = board.trial(7)
        record = rig.run(trial)
        assert (record.trial_id, record.outcome) == (trial.trial_id, Outcome.DONE)
        assert rig.abort() == rig.describe()
    board.acquire()


def test_a_board_killed_in_mid_trial_says_so_and_goes_on(tmp_path):
    requests, identities = [], set()
    for kill in (True, False):
        with small_board(tmp_path) as (process, endpoint):
            session = open_session(
                "client", connect=(endpoint,), message_max_bytes=RECORDS_MAX_BYTES
            )
            board = Board(session, None)
            identities.add(board.describe().ledger)
            board.acquire()
            if kill:
                requests.append(board.long_trial())
                board.submit(requests[0])
                board.until(Mode.RUNNING)
                process.kill()
            else:
                assert board.submit(requests[0]).verdict is ReplyCode.INTERRUPTED
                board.run, request = requests[0].run, replace(requests[0], attempt=1)
                board.submit(request)
                board.say("cancel", Cancel(board.lease))
                assert board.record(request).outcome is Outcome.CANCELLED
            session.close()
    assert len(identities) == 1
