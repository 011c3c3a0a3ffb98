"""Conformance suite of the rig protocol, message by message; see docs/rig-protocol.md.

With --endpoint, the rig at that endpoint is tested instead of our own. It will move: it runs the
step trial that it suggests, is stopped in the middle of one, and has its emergency stop called.
"""

import json
import secrets
import time
from contextlib import ExitStack
from dataclasses import fields, replace

import numpy as np
import pytest
import zenoh

from estune.remote import messages
from estune.remote.messages import VERBS, Answer, Inquire, Keys, Part, Presence, Status, digest
from estune.remote.messages.commands import (
    Cancel,
    Clear,
    Estop,
    Lease,
    SetGains,
    Submit,
    Void,
)
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import LEASE_S, RENEW_S, Mode
from estune.remote.zenoh import connect
from estune.remote.zenoh.remote_rig import RECORDS_MAX_BYTES
from estune.remote.zenoh.zenoh_session import open_session
from estune.trial import Outcome, TrialRequest, record_frame
from tests.serve_rig import served, small_board

ANSWERED_WITHIN_S = 10.0  # generous: the speed of the machine is not tested
PENDING = (ReplyCode.ACCEPTED, ReplyCode.RUNNING, ReplyCode.BUSY)


class Board:
    """A rig under test, and a session that sends it single messages."""

    def __init__(self, session: zenoh.Session, name: str | None) -> None:
        self.session = session
        tokens = session.liveliness().get(messages.ANY_RIG, timeout=ANSWERED_WITHIN_S)
        found = {Presence.parse(str(reply.ok.key_expr)) for reply in tokens}
        presence = messages.choose(found, name, "the endpoint")
        self.keys, self.instance = Keys(presence.rig), presence.instance
        self.run = f"conformance-{secrets.token_hex(4)}"
        self.lease = ""

    def ask(self, key: str, message: object) -> bytes:
        """The only reply to a message."""
        payload = message if isinstance(message, bytes) else messages.encode(message)
        replies = list(self.session.get(key, payload=payload, timeout=ANSWERED_WITHIN_S))
        assert len(replies) == 1, f"{len(replies)} replies on {key}"
        sample = replies[0].result
        assert str(sample.key_expr) == key
        assert sample.attachment.to_bytes() == self.instance.encode()
        return sample.payload.to_bytes()

    def send(self, verb: str, message: object) -> Answer:
        return messages.decode(Answer, self.ask(self.keys.command(self.instance, verb), message))

    def describe(self):
        return messages.decode_description(self.ask(self.keys.describe, b""))

    def status(self) -> Status:
        return messages.decode(Status, self.ask(self.keys.status, b""))

    def acquire(self) -> str:
        self.lease = secrets.token_hex(8)
        answer = self.send("lease", Lease("acquire", self.lease, "the conformance suite"))
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
        """Reply to a submit; None if it was the record."""
        message = Submit(self.lease, request, digest(request))
        data = self.ask(self.keys.command(self.instance, "submit"), message)
        return None if data.startswith(b"RTR1") else messages.decode(Answer, data)

    def inquire(self, request: TrialRequest, **inquiry):
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

    def record(self, request: TrialRequest):
        """Waits for the record of a trial; renews the lease meanwhile."""
        while True:
            found = self.inquire(request)
            if not isinstance(found, Answer):
                return record_frame.decode(self.frame(request))
            assert found.verdict in PENDING, found
            self.send("lease", Lease("renew", self.lease))
            time.sleep(RENEW_S / 10)

    def until(self, *modes: Mode, renew: bool = True) -> Status:
        while (status := self.status()).mode not in modes:
            if renew:
                self.send("lease", Lease("renew", self.lease))
            time.sleep(RENEW_S / 10)
        return status


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
    """The rig at rest, with the lease held."""
    with ExitStack() as stack:
        session = open_session("client", connect=(endpoint,), message_max_bytes=RECORDS_MAX_BYTES)
        stack.callback(session.close)
        board = Board(session, request.config.getoption("--rig"))
        board.until(Mode.IDLE, Mode.SAFE, renew=False)
        board.send("clear", Clear())
        board.acquire()
        yield board
        board.send("lease", Lease("release", board.lease))


def test_describe_is_constant_and_within_its_own_limits(board):
    about = board.describe()
    assert (about.rig.name, about.instance) == (board.keys.rig, board.instance)
    assert about.ledger
    about.rig.limits.check(about.rig.step)
    assert board.describe() == about


def test_submit_repeated_runs_the_trial_once_as_requested(board):
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


def test_result_in_parts_equals_the_whole_frame(board):
    request = board.trial()
    board.submit(request)
    board.record(request)
    whole = board.frame(request)
    data = b""
    while len(data) < len(whole):
        part = board.inquire(request, offset=len(data), length=700)
        assert isinstance(part, Part)
        assert (part.offset, part.total, len(part.data) <= 700) == (len(data), len(whole), True)
        data += part.data
    assert data == whole


def test_submit_of_another_request_under_a_used_id_is_refused(board):
    request = board.trial()
    board.submit(request)
    board.record(request)
    other = replace(request, gains=replace(request.gains, P=1.1 * request.gains.P))
    for answer in (board.submit(other), board.inquire(other)):
        assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "RigError")


def test_result_of_a_trial_never_submitted_is_unknown(board):
    assert board.inquire(board.trial(99)).verdict is ReplyCode.UNKNOWN


def test_submit_outside_the_limits_is_refused(board):
    limits = board.describe().rig.limits
    too_high = 2.0 * limits.tension_max_N if np.isfinite(limits.tension_max_N) else 1e300
    for number, changes in enumerate(
        ({"step_N": too_high}, {"duration_s": 2.0 * limits.duration_max_s + 1.0})
    ):
        answer = board.submit(board.trial(number, **changes))
        assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "InvalidInput")
        assert board.inquire(board.trial(number, **changes)).verdict is ReplyCode.UNKNOWN


def test_commands_without_the_lease_are_refused_with_the_holder(board):
    request, mine = board.trial(), board.lease
    board.lease = "0" * 16
    gains = board.describe().rig.gains
    for answer in (
        board.send("lease", Lease("acquire", board.lease, "another")),
        *(board.send("lease", Lease(action, board.lease)) for action in ("renew", "release")),
        board.submit(request),
        board.send("gains", SetGains(board.lease, gains)),
        board.send("void", Void(board.lease, request.trial_id, digest(request))),
    ):
        assert answer.verdict is ReplyCode.HELD
        assert "the conformance suite" in answer.sentence
    assert board.inquire(request).verdict is ReplyCode.UNKNOWN
    board.send("lease", Lease("release", mine))
    assert board.submit(request).verdict is ReplyCode.NO_LEASE
    assert board.status().holder == ""
    board.lease = mine
    board.acquire()


def test_lease_not_renewed_expires_and_stops_the_trial(board):
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


def test_lease_released_stops_the_trial(board):
    request = board.long_trial()
    board.submit(request)
    board.until(Mode.RUNNING)
    board.send("lease", Lease("release", board.lease))
    board.until(Mode.IDLE, renew=False)
    assert board.record(request).outcome is Outcome.CANCELLED
    board.acquire()


def test_submit_during_a_trial_is_busy_until_cancel_ends_it(board):
    request, gains = board.long_trial(), board.describe().rig.gains
    board.submit(request)
    status = board.until(Mode.RUNNING)
    assert (status.trial_id, status.holder) == (request.trial_id, "the conformance suite")
    for answer in (
        board.submit(board.trial(1)),
        board.send("gains", SetGains(board.lease, gains)),
    ):
        assert (answer.verdict, answer.trial_id) == (ReplyCode.BUSY, request.trial_id)
    assert board.send("cancel", Cancel(board.lease, "another-00000")).trial_id == ""
    while (
        answer := board.submit(request)
    ).verdict is ReplyCode.ACCEPTED:  # the mode changes before the ledger does
        board.send("lease", Lease("renew", board.lease))
    assert answer.verdict is ReplyCode.RUNNING
    while board.send("cancel", Cancel(board.lease)).trial_id:
        board.send("lease", Lease("renew", board.lease))
    record = board.record(request)
    assert (record.outcome, bool(record.reason)) == (Outcome.CANCELLED, True)
    assert board.describe().rig.gains == gains
    assert board.send("cancel", Cancel(board.lease)) == Answer(ReplyCode.ACCEPTED)


def test_void_trial_never_runs(board):
    request, ended = board.trial(), board.status().ended
    void = Void(board.lease, request.trial_id, digest(request))
    assert board.send("void", void).verdict is ReplyCode.VOID
    assert board.submit(request).verdict is ReplyCode.VOID
    assert board.inquire(request).verdict is ReplyCode.VOID
    other = board.trial(1)
    board.submit(other)
    board.record(other)
    late = Void(board.lease, other.trial_id, digest(other))
    assert board.send("void", late).verdict is ReplyCode.ENDED
    assert board.status().ended == ended + 1


def test_gains_set_are_live(board):
    before = board.describe().rig.gains
    other = replace(before, P=0.8 * before.P)
    for gains in (other, before):
        assert board.send("gains", SetGains(board.lease, gains)).verdict is ReplyCode.ACCEPTED
        assert board.describe().rig.gains == gains


@pytest.mark.parametrize("payload", [b"", b'{"reason":"smoke"}', b"\xff{", b'{"reason":3}'])
def test_estop_with_any_payload_is_obeyed_and_holds_until_clear(board, payload):
    request, gains = board.long_trial(), board.describe().rig.gains
    board.submit(request)
    board.until(Mode.RUNNING)
    assert board.send("estop", payload).verdict is ReplyCode.ACCEPTED
    status = board.until(Mode.SAFE)
    assert bool(status.latched)
    assert board.record(request).outcome is Outcome.CANCELLED
    for answer in (
        board.submit(board.trial(1)),
        board.send("gains", SetGains(board.lease, gains)),
    ):
        assert answer.verdict is ReplyCode.SAFE
    assert board.send("estop", Estop("again")).verdict is ReplyCode.ACCEPTED
    assert board.send("clear", Clear()).verdict is ReplyCode.ACCEPTED
    assert board.status().mode is Mode.LEASED
    board.submit(board.trial(1))
    assert board.record(board.trial(1)).outcome is Outcome.DONE


def test_invalid_commands_are_refused_without_effect(board):
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
    for verb in VERBS.keys() - {"estop"}:
        for payload in wrong:
            answer = board.send(verb, payload)
            assert (answer.verdict, answer.error) == (ReplyCode.REFUSED, "ProtocolError")
    assert board.inquire(request).verdict is ReplyCode.UNKNOWN
    assert board.status().mode is Mode.LEASED


def test_command_on_a_foreign_key_is_not_executed(board):
    request = board.trial()
    payload = messages.encode(Submit(board.lease, request, digest(request)))
    keys = ("reel/**", f"{board.keys.root}/*/*/submit", board.keys.command("0" * 8, "submit"))
    for key in keys:
        target = zenoh.QueryTarget.ALL
        for reply in board.session.get(key, payload=payload, target=target, timeout=5.0):
            assert "@cmd" not in str(reply.result.key_expr)
    assert board.inquire(request).verdict is ReplyCode.UNKNOWN


def example(board: Board, verb: str, request: TrialRequest):
    """A valid command that would have an effect."""
    gains = board.describe().rig.gains
    values = {
        "action": "release",
        "lease": board.lease,
        "holder": "wildcard",
        "reason": "wildcard",
        "request": request,
        "trial_id": request.trial_id,
        "digest": digest(request),
        "gains": replace(gains, P=0.8 * gains.P),
    }
    kind = VERBS[verb].message
    return kind(**{field.name: values[field.name] for field in fields(kind)})


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("key", ["reel/v1/*/@cmd/*/{}", "{root}/@cmd/*/{}", "{root}/@cmd/**"])
def test_command_on_a_wildcard_key_is_neither_executed_nor_answered(board, verb, key):
    request, before = board.trial(), board.describe()
    if verb == "clear":
        board.send("estop", Estop("to be cleared by its own key only"))
        board.until(Mode.SAFE)
    status = board.status()
    replies = board.session.get(
        key.format(verb, root=board.keys.root),
        payload=messages.encode(example(board, verb, request)),
        target=zenoh.QueryTarget.ALL,
        timeout=ANSWERED_WITHIN_S,
    )
    assert not [reply for reply in replies if reply.ok is not None]
    board.send("lease", Lease("renew", board.lease))
    assert (board.status(), board.describe()) == (status, before)
    assert board.inquire(request).verdict is ReplyCode.UNKNOWN


@pytest.mark.parametrize("name", ["status", "describe"])
def test_query_on_a_wildcard_key_is_answered_on_the_rigs_own_key(board, name):
    own = getattr(board.keys, name)
    for key in (f"reel/v1/*/{name}", f"reel/*/*/{name}", f"{board.keys.root}/{name[:3]}$*"):
        replies = board.session.get(
            key,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=ANSWERED_WITHIN_S,
        )
        samples = [reply.ok for reply in replies if reply.ok is not None]
        mine = [s for s in samples if s.attachment.to_bytes() == board.instance.encode()]
        assert [str(sample.key_expr) for sample in mine] == [own]


def test_status_is_published_at_each_change(board):
    ring = zenoh.handlers.RingChannel(100)
    with board.session.declare_subscriber(board.keys.status, ring) as subscriber:
        request = board.trial()
        board.submit(request)
        board.record(request)
        ended = board.status().ended
        while True:
            sample = subscriber.recv()
            assert sample.attachment.to_bytes() == board.instance.encode()
            if messages.decode(Status, sample.payload.to_bytes()).ended == ended:
                break


def test_remote_rig_runs_a_trial(endpoint, board, request):
    board.send("lease", Lease("release", board.lease))
    with connect(endpoint, rig=request.config.getoption("--rig")) as rig:
        trial = board.trial(7)
        record = rig.run(trial)
        assert (record.trial_id, record.outcome) == (trial.trial_id, Outcome.DONE)
        assert rig.abort() == rig.describe()
    board.acquire()


def test_killed_board_reports_the_trial_as_interrupted(tmp_path):
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
                board.send("cancel", Cancel(board.lease))
                assert board.record(request).outcome is Outcome.CANCELLED
            session.close()
    assert len(identities) == 1
