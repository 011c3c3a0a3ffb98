"""Messages of the protocol: encoding, limits, digests, names, choice of a rig."""

import json
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune import errors
from estune.core.gains import Gains
from estune.core.quantities import SMALLEST
from estune.errors import InvalidInput, ProtocolError, RigError
from estune.remote import messages
from estune.remote.messages import (
    VERBS,
    Answer,
    Description,
    Inquire,
    Keys,
    Presence,
    Status,
)
from estune.remote.messages.commands import Lease, Submit
from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import Mode
from estune.support.printable import printable
from estune.trial import TrialRequest, record_frame
from estune.trial.profiles import (
    ChirpProfile,
    MultisineProfile,
    StaircaseProfile,
    StepProfile,
    TriangleProfile,
)
from tests.protocol_examples import EXAMPLES
from tests.support_rigs import description, response

finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(min_value=SMALLEST, allow_infinity=False)
gains = st.builds(Gains, positive, *[finite.map(abs)] * 3)
steps = st.builds(
    lambda preload, size, at, rest: StepProfile(preload, size, at, at + rest),
    *(finite, finite.filter(bool), st.floats(0.0, 10.0), st.floats(0.1, 10.0)),
)
size = finite.filter(bool)
time = st.floats(0.1, 10.0)
loops = st.sampled_from(["closed", "open"])
excitations = st.one_of(
    st.builds(TriangleProfile, finite, size, time, time, loop=loops, shrink=st.floats(0.1, 1.0)),
    st.builds(
        MultisineProfile,
        *(finite, positive, time, st.integers(1, 9), st.integers(10, 2000), time),
        lines=st.sampled_from(["all", "odd", "odd_sparse"]),
        loop=loops,
    ),
    st.builds(ChirpProfile, finite, size, positive, positive, time, loop=loops),
    st.builds(StaircaseProfile, finite, size, st.integers(1, 9), time, time, loop=loops),
)
requests = st.builds(
    TrialRequest,
    st.text(st.characters(codec="utf-8"), max_size=20).filter(lambda run: printable(run) == run),
    st.integers(0, 10**9),
    gains,
    st.one_of(steps, excitations),
    st.integers(0, 99),
)
REQUEST = TrialRequest("run", 3, Gains(0.5, 10.0, 0.0, 0.02), StepProfile(10.0, 5.0, 0.1, 0.5))
SUBMIT = messages.encode(Submit("1e", REQUEST, messages.digest(REQUEST)))


@given(requests)
def test_decode_of_an_encoded_request_returns_it(request):
    sent = Submit("1e", request, messages.digest(request))
    received = messages.decode(Submit, messages.encode(sent))
    assert received == sent
    assert messages.digest(received.request) == sent.digest


@pytest.mark.parametrize(
    "message",
    [
        *EXAMPLES,
        Inquire("ab", 3, 100),
        Status("4f1c", Mode.ABORTING, "run-00003", 3, "anna@lab", "smoke"),
        Answer(ReplyCode.REFUSED, "run-00003", "InvalidInput", "too far"),
        *(Answer(verdict) for verdict in ReplyCode),
        Description(description(), "4f1c", "9e"),
    ],
    ids=lambda message: type(message).__name__,
)
def test_decode_of_an_encoded_message_returns_it(message):
    assert messages.decode(type(message), messages.encode(message)) == message


def test_digest_of_integers_equals_that_of_floats():
    whole = replace(REQUEST, profile=StepProfile(10, 5, 0.1, 0.5))
    received = messages.decode(
        Submit, messages.encode(Submit("1e", whole, messages.digest(whole)))
    )
    assert messages.digest(received.request) == received.digest == messages.digest(REQUEST)


@pytest.mark.parametrize(
    "other",
    [
        replace(REQUEST, gains=replace(REQUEST.gains, D=5e-324)),
        replace(REQUEST, profile=replace(REQUEST.profile, duration_s=0.5000000000000001)),
        replace(REQUEST, profile=replace(REQUEST.profile, loop="open")),
        replace(REQUEST, attempt=1),
    ],
)
def test_digest_differs_for_different_requests(other):
    assert messages.digest(other) != messages.digest(REQUEST)


@pytest.mark.parametrize(
    ("where", "value", "complaint"),
    [
        ((), ("colour", "red"), "colour"),
        (("request",), ("colour", "red"), "request.colour"),
        (("request", "gains"), ("P", float("nan")), "request.gains.P: .*finite"),
        (("request", "gains"), ("I", float("inf")), "request.gains.I: .*finite"),
        (("request", "gains"), ("P", -1.0), "request.gains: .*above zero"),
        (("request", "gains"), ("P", "1"), "request.gains.P: .*number"),
        (("request", "profile"), ("step_N", 0.0), "request.profile.step: .*step_N is 0.0 N"),
        (("request", "profile"), ("kind", "square"), "request.profile: .*square"),
        (("request", "profile"), ("kind", "triangle"), r"request\.profile\.triangle\..*missing"),
        (("request", "profile"), ("loop", "ajar"), r"request\.profile\.step\.loop: .*closed"),
        (("request",), ("number", 1.5), "request.number: .*whole number"),
        (("request", "profile"), ("step_N", 10**400), ".*"),
        (("request",), ("number", True), "request.number: .*whole number"),
        (("request",), ("run", None), "request.run: .*text"),
    ],
)
def test_decode_of_a_wrong_field_names_its_place(where, value, complaint):
    command = json.loads(SUBMIT)
    part = command
    for name in where:
        part = part[name]
    part.update([value])
    with pytest.raises(ProtocolError, match=f"^Submit message: {complaint}"):
        messages.decode(Submit, json.dumps(command).encode())


def test_decode_with_a_missing_field_is_refused():
    command = json.loads(SUBMIT)
    del command["request"]["profile"]
    with pytest.raises(ProtocolError, match=r"request\.profile: .*is missing"):
        messages.decode(Submit, json.dumps(command).encode())


@given(
    st.sampled_from(
        [*(verb.message for verb in VERBS.values()), Inquire, Answer, Status, Description]
    ),
    st.binary(),
)
def test_decode_of_random_bytes_is_refused(kind, data):
    with pytest.raises(ProtocolError):
        messages.decode(kind, data)


@given(st.data())
def test_decode_of_a_truncated_command_is_refused(data):
    with pytest.raises(ProtocolError):
        messages.decode(Submit, SUBMIT[: data.draw(st.integers(0, len(SUBMIT) - 1))])


def test_command_over_the_limit_is_refused_on_both_sides():
    with pytest.raises(ProtocolError, match="the limit is 2048"):
        messages.encode(Submit("", replace(REQUEST, run="x" * 2048), ""))
    with pytest.raises(ProtocolError, match="the limit is 2048"):
        messages.decode(Submit, SUBMIT + b" " * 2048)


def test_description_of_another_protocol_is_refused():
    text = messages.encode(Description(description(), "4f1c", "9e"))
    with pytest.raises(ProtocolError, match="protocol"):
        messages.decode_description(text.replace(b'"protocol":1', b'"protocol":2'))


@pytest.mark.parametrize(
    "kind",
    [
        *(errors.InvalidInput, errors.PlantError, errors.RigError, errors.ProtocolError),
        *(errors.UnsafeStart, errors.JournalError),
    ],
)
def test_check_raises_the_error_of_the_rig(kind):
    answer = messages.encode(messages.refusal(kind("20 N is too much")))
    with pytest.raises(errors.EstuneError, match=r"^20 N is too much$") as raised:
        messages.decode(Answer, answer).check()
    assert raised.type is kind


def test_check_of_an_unknown_error_raises_rig_error():
    with pytest.raises(RigError, match="oil low"):
        Answer(ReplyCode.REFUSED, error="SystemExit", sentence="oil low").check()


def present(*rigs: str) -> set[Presence]:
    return {Presence.parse(f"reel/{rig}") for rig in rigs}


A, B, A_AGAIN, A_NEXT = "v1/a/alive/01", "v1/b/alive/02", "v1/a/alive/03", "v2/a/alive/04"


@pytest.mark.parametrize(
    ("rigs", "rig", "instance"),
    [([A], None, "01"), ([A, B], "b", "02"), ([B, A_NEXT], None, "02"), ([A, A_NEXT], "a", "01")],
)
def test_choose_returns_the_requested_rig(rigs, rig, instance):
    assert messages.choose(present(*rigs), rig, "here").instance == instance


@pytest.mark.parametrize(
    ("rigs", "rig", "kind", "complaint"),
    [
        ([], None, RigError, "no rig answers at here, but .* --security"),
        ([], "a", RigError, "no rig answers at here, but .* --security"),
        ([A, B], "c", RigError, "no rig named 'c' at here; there is: a, b"),
        ([A, B], None, RigError, "2 rigs at here: a, b; name one"),
        ([A, B, A_AGAIN], "a", RigError, r"2 processes .* named 'a' \(instances 01, 03\); stop"),
        ([A, A_AGAIN], None, RigError, "2 processes .* named 'a'"),
        ([A_NEXT], None, ProtocolError, "'a' at here speaks protocol v2, this estune v1; update"),
        ([B, A_NEXT], "a", ProtocolError, "speaks protocol v2"),
    ],
)
def test_choose_without_a_unique_rig_explains_why(rigs, rig, kind, complaint):
    with pytest.raises(RigError, match=complaint) as raised:
        messages.choose(present(*rigs), rig, "here")
    assert raised.type is kind


@pytest.mark.parametrize("name", ["", "a/b", "*", "a*", "a$b", "@a", "a?b", "a#b", " a", "a\n"])
def test_name_that_would_change_the_key_is_refused(name):
    with pytest.raises(InvalidInput, match="cannot be used on the link"):
        Keys(name)


def test_strings_of_a_message_arrive_printable():
    hostile = "\x1b[2J\x1b]0;gone\x07 anna\u202e\x9b1m\r\nestune: all is well"
    data = messages.encode(Lease("acquire", "5ad1e7c0ffee0042", hostile))
    for sent in (data, data.replace(b"\\u001b", b"\\u001B")):
        holder = messages.decode(Lease, sent).holder
        assert not set(holder) & set("\x1b\x07\u202e\x9b\r\n")
        assert holder.startswith("\\x1b[2J")
    plain = messages.encode(Lease("acquire", "5ad1e7c0ffee0042", 'änna "the boss" \\ 1 °'))
    assert messages.decode(Lease, plain).holder == 'änna "the boss" \\ 1 °'
    with pytest.raises(InvalidInput, match="cannot be used on the link"):
        Keys("reel\x9b1m")
    assert Presence.parse("reel/v1/a\x1b[2J/alive/01").rig == "a\\x1b[2J"


def test_reason_in_a_record_arrives_printable():
    record = replace(
        response(TrialRequest("run", 0, Gains(1.0, 2.0, 0.0, 0.0), description().step)),
        reason="guard\x1b[2J",
    )
    data = record_frame.encode(record)
    record_frame.encode(
        response(TrialRequest("run", 0, Gains(1.0, 2.0, 0.0, 0.0), description().step))
    )  # forgets the last record
    assert record_frame.decode(data).reason == "guard\\x1b[2J"


@pytest.mark.parametrize("name", ["a", "reel 2", "Spule-3_ü.1", "x" * 128])
def test_other_names_are_accepted(name):
    assert Presence.parse(Keys(name).alive("0f")) == Presence(name, "v1", "0f")
