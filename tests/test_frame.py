"""The record frame: decoded bit for bit; any other bytes are refused."""

import json
import math
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from estune.core.gains import Gains
from estune.core.quantities import SMALLEST
from estune.errors import ProtocolError
from estune.remote.ledger import MemoryLedger
from estune.remote.zenoh.trial_execution import SharedRigState, TrialExecutor
from estune.support.printable import printable
from estune.trial import OPTIONAL_COLUMNS, Outcome, TrialRecord, TrialRequest, record_frame
from tests.support_rigs import description, response, same
from tests.support_runs import ArithmeticRig

finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(min_value=SMALLEST, allow_infinity=False)
# What is not printable is replaced when a frame is decoded.
text = st.text(st.characters(codec="utf-8"), max_size=20).map(printable)


@st.composite
def records(draw) -> TrialRecord:
    samples = draw(st.integers(0, 40))
    column = arrays(np.float64, samples)  # NaN with any payload, infinities, subnormals included
    return TrialRecord(
        trial_id=draw(text),
        rig=draw(text),
        sampling_Hz=draw(positive),
        cable_length_m=draw(st.none() | finite),
        preload_N=draw(finite),
        gains=Gains(draw(positive), *(abs(draw(finite)) for _ in range(3))),
        outcome=draw(st.sampled_from(Outcome)),
        reason=draw(text),
        started_at=draw(text),
        software=draw(text),
        time_s=draw(column),
        setpoint_N=draw(column),
        tension_N=draw(column),
        current_A=draw(column),
        angle_rad=draw(column),
        flags=draw(arrays(np.uint8, samples)),
        **{name: draw(st.none() | column) for name in OPTIONAL_COLUMNS},
        loop=draw(st.sampled_from(["closed", "open"])),
        profile=draw(st.sampled_from(["step", "triangle", "multisine", "chirp", "custom"])),
    )


@pytest.fixture(scope="module")
def record() -> TrialRecord:
    rig = description()
    return response(TrialRequest("run", 7, rig.gains, rig.step))


@pytest.fixture(scope="module")
def encode_by_hand(record) -> bytes:
    return record_frame.encode(record)


@given(records())
def test_frame_returns_the_encoded_record(record):
    data = record_frame.encode(record)
    decoded = record_frame.decode(data)
    assert same(record, decoded)
    assert record_frame.encode(decoded) is data
    assert record_frame.encode(replace(decoded)) == data
    assert len(data) <= record_frame.size(
        record.time_s.size, optional=len(record.optional_columns)
    )


def test_changed_record_is_encoded_anew(encode_by_hand):
    decoded = record_frame.decode(encode_by_hand)
    assert not decoded.tension_N.flags.writeable
    changed = replace(decoded, reason="looked at")
    assert record_frame.decode(record_frame.encode(changed)).reason == "looked at"


@given(st.data())
def test_frame_with_corrupt_bits_is_refused(encode_by_hand, data):
    """Single-bit errors, and bursts up to the length that the checksum detects with certainty."""
    start = data.draw(st.integers(0, 8 * len(encode_by_hand) - 32))
    burst = data.draw(st.integers(1, 2**32 - 1))
    damaged = int.from_bytes(encode_by_hand, "little") ^ (burst << start)
    with pytest.raises(ProtocolError):
        record_frame.decode(damaged.to_bytes(len(encode_by_hand), "little"))


@given(st.data())
def test_frame_of_wrong_length_is_refused(encode_by_hand, data):
    end = data.draw(st.integers(0, len(encode_by_hand) - 1))
    more = data.draw(st.binary(min_size=1, max_size=20))
    with pytest.raises(ProtocolError, match=r"cut short|missing"):
        record_frame.decode(encode_by_hand[:end])
    with pytest.raises(ProtocolError, match="too many"):
        record_frame.decode(encode_by_hand + more)


@given(st.binary(max_size=200), st.booleans())
def test_bytes_that_are_no_frame_are_refused(data, sealed):
    with pytest.raises(ProtocolError):
        record_frame.decode(seal(data) if sealed else data)


def seal(header: bytes, body: bytes = b"", magic: bytes = b"RTR1") -> bytes:
    """Frame with correct lengths and checksum around any content; written from the description."""
    lengths = struct.pack("<4sII", magic, len(header), len(body))
    checksum = zlib.crc32(lengths + bytes(4) + header + body)
    return lengths + struct.pack("<I", checksum) + header + body


def test_frame_has_the_documented_layout(encode_by_hand, record):
    header_length = struct.unpack_from("<I", encode_by_hand, 4)[0]
    header = encode_by_hand[16 : 16 + header_length]
    body = encode_by_hand[16 + header_length :]
    assert seal(header, body) == encode_by_hand
    assert header_length % 8 == 0
    assert json.loads(header)["samples"] == record.time_s.size
    assert body.startswith(record.time_s.astype("<f8").tobytes())
    assert body.endswith(record.flags.tobytes())


def test_frame_of_another_version_is_refused_by_name(encode_by_hand):
    with pytest.raises(ProtocolError, match=r"version b'2' at byte 3; this estune reads b'1'"):
        record_frame.decode(b"RTR2" + encode_by_hand[4:])


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"samples": 101}, "does not hold"),
        ({"samples": -1}, "does not hold"),
        ({"samples": 10**30}, "does not hold"),
        ({"columns": ["time_s", "flags"]}, "unknown columns"),
        ({"sampling_Hz": float("nan")}, "sampling_Hz: .*finite"),
        ({"outcome": "splendid"}, "outcome"),
        ({"gains": {"P": -1.0, "I": 0.0, "D": 0.0, "setpoint_filter_s": 0.0}}, "gains: .*above"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_frame_with_wrong_header_is_refused_despite_checksum(encode_by_hand, change, complaint):
    length = struct.unpack_from("<I", encode_by_hand, 4)[0]
    header = json.dumps(json.loads(encode_by_hand[16 : 16 + length]) | change).encode()
    header += b" " * (-len(header) % 8)
    with pytest.raises(ProtocolError, match=complaint):
        record_frame.decode(seal(header, encode_by_hand[16 + length :]))


def test_frame_over_the_limit_is_refused_on_both_sides(record):
    samples = record_frame.MAX_BYTES // 40
    column = np.zeros(samples)
    large = replace(
        record,
        **dict.fromkeys(("time_s", "setpoint_N", "tension_N", "current_A", "angle_rad"), column),
        reference_N=None,
        flags=np.zeros(samples, np.uint8),
    )
    with pytest.raises(ProtocolError, match=f"a frame holds {record_frame.MAX_BYTES}"):
        record_frame.encode(large)
    with pytest.raises(ProtocolError, match=f"the limit is {record_frame.MAX_BYTES}"):
        record_frame.decode(bytes(record_frame.MAX_BYTES + 1))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"tension_N": np.zeros(3)}, "shapes"),
        ({"tension_N": np.zeros((100, 1))}, "shapes"),
        ({"cable_length_m": float("nan")}, "cable_length_m is nan"),
        ({"reason": "\ud800"}, "surrogates"),
    ],
)
def test_encode_refuses_what_decode_would_refuse(record, change, complaint):
    with pytest.raises(ProtocolError, match=complaint):
        record_frame.encode(replace(record, **change))


def test_trial_is_refused_before_it_runs_if_its_record_may_not_fit():
    rig = ArithmeticRig()
    reel = rig.describe()
    reel = replace(reel, limits=replace(reel.limits, duration_max_s=math.inf))
    executor = TrialExecutor(rig, MemoryLedger(), SharedRigState(rig, "", lambda: None), reel)
    columns = 5 + len(OPTIONAL_COLUMNS)
    most = (record_frame.MAX_BYTES - record_frame.size(0)) // (8 * columns + 1)
    for samples, fits in ((most, True), (most + 1, False)):
        step = replace(reel.step, duration_s=samples / reel.controller.sampling_Hz)
        request = TrialRequest("long", 0, reel.gains, step)
        assert (executor.limit_violation(request) is None) == fits
