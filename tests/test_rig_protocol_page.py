"""docs/reference/rig-protocol.md agrees with the code."""

import json
import re
import struct
import zlib

import numpy as np
import pytest

from estune.remote import messages
from estune.remote.state_machine import events, rig, state
from estune.remote.state_machine.reply_codes import OF_TRIAL, ReplyCode
from estune.remote.state_machine.state import Mode
from estune.remote.state_machine.trials import TrialState
from estune.trial import record_frame
from experiments.inert_rig import RECORD
from tests.protocol_examples import EXAMPLES, SAMPLES
from tests.rig_protocol_page import PAGES, SECTIONS, page
from tests.support_rigs import same

TEXTS = [path.read_text("utf-8") for path in PAGES]
TEXT = "".join(TEXTS)
HELD = state.RigState(state.GrantedLease("right", "anna", 1.0))
ACTIVE, NOTED, RUNNING, STOPPING = (
    HELD._replace(trial=state.AcceptedTrial("active", *progress))
    for progress in ((), (True,), (True, True), (True, True, "a reason"))
)
SAFE = HELD._replace(latched="the first reason")
CLOSED = state.RigState(closed=True)
STATES = (state.RigState(), HELD, ACTIVE, NOTED, RUNNING, STOPPING, SAFE, CLOSED)
"""A state in each mode, in their order; the lease, where one is held, is `right`."""


def section(name: str) -> str:
    return re.search(rf"<!-- from the code: {name} -->\n(.*?)<!-- end -->", TEXT, re.DOTALL)[1]


def dump_bytes(name: str) -> bytes:
    """Bytes of a hexadecimal dump in the page."""
    lines = re.findall(r"^[0-9a-f]{4}  ((?:[0-9a-f]{2} ?)+)", section(name), re.MULTILINE)
    return bytes.fromhex("".join(lines))


def test_pages_are_up_to_date():
    assert set(re.findall(r"from the code: (\w+)", TEXT)) == set(SECTIONS)
    assert [*map(page, TEXTS)] == TEXTS, "run: ./dev python -m tests.rig_protocol_page"


def expected_refusal(before, token, *, outside):
    """Reply code by the order of refusals in the page."""
    if before.mode is Mode.CLOSED:
        return ReplyCode.REFUSED
    if before.mode is Mode.SAFE:
        return ReplyCode.SAFE
    if before.lease is None:
        return ReplyCode.NO_LEASE
    if token != before.lease.token:
        return ReplyCode.HELD
    if before.trial:
        return ReplyCode.BUSY
    return ReplyCode.REFUSED if outside else ReplyCode.ACCEPTED


@pytest.mark.parametrize("token", ["right", "wrong"])
@pytest.mark.parametrize("before", STATES, ids=list(Mode))
def test_commands_are_refused_in_the_order_of_the_page(before, token):
    for outside in ("", "outside the limits"):
        for event in (
            events.SubmitEvent(token, "id", TrialState.UNKNOWN, outside),
            events.FollowEvent(token, outside),
        ):
            code = rig.step(before, event, 0.0).reply_code
            assert code is expected_refusal(before, token, outside=bool(outside)), event
    for event in (events.SetGainsEvent(token), events.SwitchOffEvent(token)):
        code = rig.step(before, event, 0.0).reply_code
        assert code is expected_refusal(before, token, outside=False), event


@pytest.mark.parametrize(
    ("before", "event", "code"),
    [
        (HELD, events.Renew("wrong"), ReplyCode.HELD),
        (HELD, events.Release("wrong"), ReplyCode.HELD),
        (state.RigState(), events.Renew("wrong"), ReplyCode.NO_LEASE),
        (state.RigState(), events.Release("wrong"), ReplyCode.NO_LEASE),
        (RUNNING, events.CancelEvent("wrong"), ReplyCode.HELD),
        (RUNNING, events.CancelEvent("right", "id"), ReplyCode.ACCEPTED),
        (HELD, events.VoidEvent("wrong", "id", TrialState.ENDED), ReplyCode.ENDED),
        (HELD, events.VoidEvent("wrong", "id", TrialState.UNKNOWN), ReplyCode.HELD),
        (ACTIVE, events.VoidEvent("right", "active", TrialState.UNKNOWN), ReplyCode.BUSY),
        (SAFE, events.EstopEvent("another"), ReplyCode.ACCEPTED),
        (SAFE, events.ClearEvent(), ReplyCode.ACCEPTED),
    ],
)
def test_other_commands_are_answered_as_the_page_says(before, event, code):
    move = rig.step(before, event, 0.0)
    assert move.reply_code is code
    if code is not ReplyCode.ACCEPTED or before is RUNNING:
        assert (move.state, move.orders) == (before, ())
    if isinstance(event, events.EstopEvent):
        assert move.state.latched == "the first reason"


@pytest.mark.parametrize("state", TrialState)
def test_page_has_a_reply_for_every_state_of_a_trial(state):
    (row,) = re.findall(rf"^\| `{state}` \|.*\| (.*) \|$", section("trials"), re.MULTILINE)
    assert row == "the frame" or str(OF_TRIAL[state]) in row


def test_frame_of_the_page_decodes_to_its_record():
    assert same(record_frame.decode(dump_bytes("frame_bytes")), RECORD)


def test_frame_of_the_page_has_the_described_layout():
    data = dump_bytes("frame_bytes")
    magic, head, body, checksum = struct.unpack_from("<4sIII", data)
    assert (magic, head % 8, len(data)) == (b"RTR1", 0, 16 + head + body)
    assert checksum == zlib.crc32(data[:12] + bytes(4) + data[16:])
    assert zlib.crc32(b"123456789") == 0xCBF43926
    header = json.loads(data[16 : 16 + head])
    columns = np.frombuffer(data, "<f8", 5 * header["samples"], 16 + head).reshape(5, -1)
    assert header["columns"][2] == "tension_N"
    np.testing.assert_array_equal(columns[2], RECORD.tension_N)
    assert data[-header["samples"] :] == bytes(RECORD.flags)


def test_part_of_the_page_is_the_beginning_of_the_frame():
    part = messages.decode_part(dump_bytes("part_bytes"))
    whole = dump_bytes("frame_bytes")
    assert (part.total, part.offset, part.data) == (len(whole), 0, whole[:32])


def test_live_samples_of_the_page_decode_to_their_samples():
    samples = messages.decode_live(SAMPLES.trial_id, dump_bytes("live_bytes"))
    assert (samples.first_sample, samples.sampling_Hz) == (32, 632.0)
    for name in ("setpoint_N", "tension_N", "current_A", "angle_rad"):
        np.testing.assert_array_equal(getattr(samples, name), getattr(SAMPLES, name))


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: type(example).__name__)
def test_examples_of_the_page_decode(example):
    kind = type(example)
    text = re.search(rf"### {kind.__name__}\n.*?```json\n(.*?)\n```", TEXT, re.DOTALL)[1]
    assert messages.decode(kind, text.encode()) == example
    assert len(text) <= messages.COMMAND_MAX_BYTES or kind is messages.Description
