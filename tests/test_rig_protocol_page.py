"""docs/reference/rig-protocol.md agrees with the code."""

import json
import re
import struct
import zlib

import numpy as np
import pytest

from estune.remote import messages
from estune.remote.state_machine.reply_codes import OF_TRIAL
from estune.remote.state_machine.state import Mode
from estune.remote.state_machine.trials import TrialState
from estune.trial import record_frame
from experiments.inert_rig import RECORD
from tests.protocol_examples import EXAMPLES, SAMPLES
from tests.rig_protocol_page import PAGE, SECTIONS, STATES, page
from tests.support_rigs import same

TEXT = PAGE.read_text("utf-8")


def section(name: str) -> str:
    return re.search(rf"<!-- from the code: {name} -->\n(.*?)<!-- end -->", TEXT, re.DOTALL)[1]


def dump_bytes(name: str) -> bytes:
    """Bytes of a hexadecimal dump in the page."""
    lines = re.findall(r"^[0-9a-f]{4}  ((?:[0-9a-f]{2} ?)+)", section(name), re.MULTILINE)
    return bytes.fromhex("".join(lines))


def test_page_is_up_to_date():
    assert set(re.findall(r"from the code: (\w+)", TEXT)) == set(SECTIONS)
    assert page(TEXT) == TEXT, "run: ./dev python -m tests.rig_protocol_page"


def test_table_of_submits_has_a_state_of_every_mode():
    assert [state.mode for state in STATES] == list(Mode)


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
