"""The binary form of a trial record, on the link and in the journal.

::

    offset 0   4 bytes   the magic, "RTR1"; another digit is another version of the frame
           4   u32       length of the header in bytes, a multiple of 8
           8   u32       length of the body in bytes
          12   u32       CRC-32 of everything else
          16             header: JSON, padded with spaces
                         body: the columns one after the other, `samples` float64 each,
                         and the flags, `samples` bytes

All numbers are little-endian. A microcontroller writes the body with one copy per column; here it
is read without copying. The checksum detects any single flipped bit and any burst of up to 32.
"""

import json
import math
import struct
import zlib
from dataclasses import dataclass, fields
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from estune.core.gains import GAIN_NAMES, Gains
from estune.errors import ProtocolError
from estune.support.plain_fault import plain_fault
from estune.support.printable import printable_json
from estune.trial.outcome import Outcome
from estune.trial.profiles import Kind, Loop
from estune.trial.records import COLUMNS, OPTIONAL_COLUMNS, TrialRecord

if TYPE_CHECKING:
    from pydantic import TypeAdapter

MAX_BYTES = 16 * 2**20
"""Size of the largest frame: 400 000 samples, or 200 000 with all optional columns."""

HEADER_MAX_BYTES = 64 * 2**10
"""Size of the largest header; only the reason of a failed trial has no fixed size."""

FAMILY, _VERSION = b"RTR", b"1"
_PREFIX = struct.Struct("<4sIII")
_FLOAT = np.dtype("<f8")
_to_json = json.JSONEncoder(ensure_ascii=False, separators=(",", ":")).encode


@dataclass(frozen=True, slots=True)
class Header:
    """Header of a frame: the fields of a record but its columns, and the order of those."""

    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

    columns: tuple[str, ...]
    samples: int
    trial_id: str
    rig: str
    sampling_Hz: float
    cable_length_m: float | None
    preload_N: float
    gains: Gains
    outcome: Outcome
    reason: str
    started_at: str
    software: str
    loop: Loop
    profile: Kind | Literal["custom"]


_FACTS = tuple(field.name for field in fields(Header) if field.name not in ("columns", "samples"))

_latest: tuple[TrialRecord | None, bytes] = None, b""


def size(samples: int, *, optional: int = 0) -> int:
    """Upper bound of the size of a frame with so many optional columns, bytes."""
    return _PREFIX.size + HEADER_MAX_BYTES + _body_size(samples, len(COLUMNS) + optional)


def body_at(frame: bytes) -> int:
    """Offset of the body in a frame."""
    return _PREFIX.size + int.from_bytes(frame[4:8], "little")


def encode(record: TrialRecord) -> bytes:
    """The frame of a record.

    Raises:
        ProtocolError: the columns differ in length or shape, a number outside the columns is not
            finite, or the frame would be too large.
    """
    latest, data = _latest
    if record is latest:
        return data
    columns = (*COLUMNS, *record.optional_columns)
    arrays = [np.ascontiguousarray(getattr(record, name), _FLOAT) for name in columns]
    arrays.append(np.ascontiguousarray(record.flags, np.uint8))
    shapes = {array.shape for array in arrays}
    if len(shapes) != 1 or arrays[0].ndim != 1:
        raise ProtocolError(
            f"record of trial {record.trial_id}: columns have shapes {sorted(shapes)}; "
            "they must be one-dimensional and of one length"
        )
    header = _header_json(record, columns, arrays[0].size)
    body_length = sum(array.nbytes for array in arrays)
    length = _PREFIX.size + len(header) + body_length
    if length > MAX_BYTES or len(header) > HEADER_MAX_BYTES:
        raise ProtocolError(
            f"record of trial {record.trial_id} takes {length} bytes, {len(header)} of them its "
            f"header; a frame holds {MAX_BYTES} and {HEADER_MAX_BYTES}: run a shorter trial"
        )
    prefix = (FAMILY + _VERSION, len(header), body_length)
    # Joined from views, so that the columns are copied only once.
    parts: list[bytes | memoryview] = [header, *(array.data for array in arrays)]
    checksum = _checksum(_PREFIX.pack(*prefix, 0), *parts)
    return b"".join((_PREFIX.pack(*prefix, checksum), *parts))


def decode(data: bytes) -> TrialRecord:
    """The record in a frame. Its columns are read-only views of the frame.

    Encoded next, the record gives the same frame: the journal stores what the rig sent.

    Raises:
        ProtocolError: the frame is of another version, corrupt, truncated, too long or too large.
    """
    header_length, body_length = _check_envelope(data)
    body_at = _PREFIX.size + header_length
    header = _parse_header(data[_PREFIX.size : body_at])
    optional = [name for name in OPTIONAL_COLUMNS if name in header.columns]
    if header.columns != (*COLUMNS, *optional):
        raise ProtocolError(f"record frame: unknown columns {', '.join(header.columns)} in header")
    if header.samples < 0 or _body_size(header.samples, len(header.columns)) != body_length:
        raise ProtocolError(
            f"record frame: body of {body_length} bytes does not hold the "
            f"{len(header.columns)} columns of {header.samples} samples the header announces"
        )
    shape = len(header.columns), header.samples
    floats = np.frombuffer(data, _FLOAT, shape[0] * shape[1], body_at).reshape(shape)
    flags = np.frombuffer(data, np.uint8, header.samples, len(data) - header.samples)
    columns: dict[str, Any] = dict(zip(header.columns, floats, strict=True))
    record = TrialRecord(
        **{name: getattr(header, name) for name in _FACTS}, **columns, flags=flags
    )
    global _latest  # noqa: PLW0603  cache of one; a record and its frame never change
    _latest = record, data
    return record


def _check_envelope(data: bytes) -> tuple[int, int]:
    """Lengths of header and body, after a check of magic, lengths and checksum."""
    if len(data) > MAX_BYTES:
        raise ProtocolError(f"record frame of {len(data)} bytes; the limit is {MAX_BYTES}")
    if len(data) < _PREFIX.size:
        raise ProtocolError(
            f"record frame cut short: {len(data)} bytes, its prefix alone takes {_PREFIX.size}"
        )
    magic, header_length, body_length, checksum = _PREFIX.unpack_from(data)
    if magic[:3] != FAMILY:
        raise ProtocolError(f"not a record frame: it begins with {magic!r}, not {FAMILY!r}")
    if magic[3:] != _VERSION:
        raise ProtocolError(
            f"record frame of version {magic[3:]!r} at byte 3; this estune reads {_VERSION!r}: "
            "use the estune that wrote it, or a newer one"
        )
    expected = _PREFIX.size + header_length + body_length
    if len(data) != expected:
        raise ProtocolError(
            f"record frame of {len(data)} bytes; its prefix announces {expected} "
            f"({abs(len(data) - expected)} {'missing' if len(data) < expected else 'too many'})"
        )
    prefix = _PREFIX.pack(magic, header_length, body_length, 0)
    if checksum != _checksum(prefix, memoryview(data)[_PREFIX.size :]):
        raise ProtocolError(f"record frame of {len(data)} bytes is corrupt: wrong checksum")
    if header_length % 8 or header_length > HEADER_MAX_BYTES:
        raise ProtocolError(
            f"record frame: header of {header_length} bytes; it must be a multiple of 8 and "
            f"at most {HEADER_MAX_BYTES}"
        )
    return header_length, body_length


def _checksum(*parts: bytes | memoryview) -> int:
    """CRC-32 of the whole frame, with zero in its own field."""
    checksum = 0
    for part in parts:
        checksum = zlib.crc32(part, checksum)
    return checksum


def _body_size(samples: int, columns: int) -> int:
    return samples * (_FLOAT.itemsize * columns + 1)


@cache
def _adapter() -> "TypeAdapter[Header]":
    from pydantic import TypeAdapter  # noqa: PLC0415  slow to import, not needed by every command

    return TypeAdapter(Header)


def _header_json(record: TrialRecord, columns: tuple[str, ...], samples: int) -> bytes:
    """The header, padded with spaces so that the body begins on a multiple of 8."""
    gains = {name: getattr(record.gains, name) for name in GAIN_NAMES}
    facts: dict[str, Any] = {name: getattr(record, name) for name in _FACTS}
    facts |= {"columns": columns, "samples": samples, "gains": gains}
    for name in ("sampling_Hz", "cable_length_m", "preload_N"):
        if facts[name] is not None and not math.isfinite(facts[name]):
            raise ProtocolError(
                f"record of trial {record.trial_id}: {name} is {facts[name]}; it must be finite"
            )
    try:
        text = _to_json(facts).encode()
    except (TypeError, ValueError) as error:
        raise ProtocolError(f"record of trial {record.trial_id!r}: {error}") from error
    return text + b" " * (-len(text) % 8)


def _parse_header(text: bytes) -> Header:
    try:
        return _adapter().validate_json(printable_json(text))
    except (ValueError, OverflowError) as error:  # an integer may have hundreds of digits
        raise ProtocolError(f"record frame: header: {one_line(error)}") from error


def one_line(error: ValueError | OverflowError) -> str:
    """The first error of a pydantic validation, with its place, in one line."""
    from pydantic import ValidationError  # noqa: PLC0415  as above

    if not isinstance(error, ValidationError):
        return str(error)
    first = error.errors(include_url=False, include_context=False)[0]
    where = ".".join(str(part) for part in first["loc"])
    fault = plain_fault(first["msg"])
    return f"{where}: {fault}" if where else fault
