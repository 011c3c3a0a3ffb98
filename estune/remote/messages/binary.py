"""Binary messages: parts of a record's frame, and live samples.

docs/reference/rig-options.md has their layout byte by byte. The frame of a whole
record is that of `estune.trial.record_frame`.
"""

import struct
import zlib
from typing import NamedTuple

import numpy as np

from estune.errors import ProtocolError
from estune.remote.messages.codec import decode
from estune.remote.messages.replies import Answer
from estune.trial import Telemetry, TrialRecord, record_frame

PART, LIVE = b"RTP1", b"RTL1"
LIVE_MAX_SAMPLES = 4096

_PART = struct.Struct("<4sIII")
_LIVE = struct.Struct("<4sIIId")
_COLUMNS = ("setpoint_N", "tension_N", "current_A", "angle_rad")
_FLOAT = np.dtype("<f4")


class Part(NamedTuple):
    """A part of a record's frame: length of the whole, offset of the part, and its bytes."""

    total: int
    offset: int
    data: bytes


def encode_part(whole: bytes, offset: int, length: int) -> bytes:
    """The part of a frame from `offset` on, of `length` bytes or up to its end.

    Raises:
        ProtocolError: the part is empty, or a number is negative.
    """
    piece = whole[offset : offset + length]
    if not piece or offset < 0 or length < 0:
        raise ProtocolError(
            f"{length} bytes from byte {offset} on of a record of {len(whole)} bytes: none there"
        )
    prefix = PART, len(whole), offset
    checksum = zlib.crc32(piece, zlib.crc32(_PART.pack(*prefix, 0)))
    return _PART.pack(*prefix, checksum) + piece


def decode_part(data: bytes) -> Part:
    """The part of a frame in a message.

    Raises:
        ProtocolError: it is no part, is corrupt, or exceeds its frame.
    """
    if len(data) <= _PART.size or data[:4] != PART:
        raise ProtocolError(f"{len(data)} bytes are no part of a record")
    magic, total, offset, checksum = _PART.unpack_from(data)
    piece = data[_PART.size :]
    if checksum != zlib.crc32(piece, zlib.crc32(_PART.pack(magic, total, offset, 0))):
        raise ProtocolError(f"part of a record, {len(data)} bytes, is corrupt: wrong checksum")
    if offset + len(piece) > total or total > record_frame.MAX_BYTES:
        raise ProtocolError(
            f"part of a record: bytes {offset} to {offset + len(piece)} of {total}; a record has "
            f"at most {record_frame.MAX_BYTES}"
        )
    return Part(total, offset, piece)


def encode_live(samples: Telemetry) -> bytes:
    """Live samples as a message; at most the first `LIVE_MAX_SAMPLES`."""
    columns = [
        np.asarray(getattr(samples, name)[:LIVE_MAX_SAMPLES], _FLOAT).tobytes()
        for name in _COLUMNS
    ]
    prefix = LIVE, samples.first_sample, len(columns[0]) // _FLOAT.itemsize
    head = _LIVE.pack(*prefix, 0, samples.sampling_Hz)
    checksum = zlib.crc32(b"".join((head, *columns)))
    return b"".join((_LIVE.pack(*prefix, checksum, samples.sampling_Hz), *columns))


def decode_live(trial_id: str, data: bytes) -> Telemetry:
    """The live samples in a message, of the trial that its key names.

    Raises:
        ProtocolError: it is corrupt or no such message.
    """
    if len(data) < _LIVE.size or data[:4] != LIVE:
        raise ProtocolError(f"{len(data)} bytes are no live samples")
    magic, first, samples, checksum, sampling_Hz = _LIVE.unpack_from(data)
    if len(data) != _LIVE.size + samples * len(_COLUMNS) * _FLOAT.itemsize:
        raise ProtocolError(f"live samples: {len(data)} bytes do not hold {samples} samples")
    head = _LIVE.pack(magic, first, samples, 0, sampling_Hz)
    if checksum != zlib.crc32(memoryview(data)[_LIVE.size :], zlib.crc32(head)):
        raise ProtocolError(f"live samples, {len(data)} bytes, are corrupt: wrong checksum")
    if not (np.isfinite(sampling_Hz) and sampling_Hz > 0.0):
        raise ProtocolError(f"live samples: sampling rate {sampling_Hz} Hz; it must be above zero")
    rows = np.frombuffer(data, _FLOAT, offset=_LIVE.size).astype(float)
    columns = dict(zip(_COLUMNS, rows.reshape(len(_COLUMNS), samples), strict=True))
    return Telemetry(trial_id=trial_id, first_sample=first, sampling_Hz=sampling_Hz, **columns)


def decode_trial(data: bytes) -> Answer | Part | TrialRecord:
    """Reply of a rig to `submit` or `result`: the record, a part of it, or why there is none.

    Raises:
        ProtocolError: it is none of these.
    """
    if data.startswith(b"{"):
        return decode(Answer, data)
    return decode_part(data) if data.startswith(PART) else record_frame.decode(data)
