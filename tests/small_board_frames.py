"""What the small board writes on the wire and reads from it: JSON, struct and CRC, no estune."""

import json
import math
import struct
import zlib

RATE_HZ, PART = 100.0, 1024
FIELDS = {  # of the parts of messages: those that they must and may have
    "setpoint": ({"tension_N"}, {"angle_rad"}),
    "result": ({"digest"}, {"offset", "length"}),
    "request": ({"run", "number", "gains", "profile"}, {"attempt"}),
    "P": ({"P", "I", "D", "setpoint_filter_s"}, set()),
    "step": ({"kind", "preload_N", "step_N", "step_at_s", "duration_s"}, {"loop", "ramp_s"}),
}


class Refused(Exception):
    """Refusal, with the kind of error."""


def answer(verdict, trial_id="", error="", sentence=""):
    reply = {"verdict": verdict, "trial_id": trial_id, "error": error, "sentence": sentence}
    return json.dumps(reply).encode()


def finite(*values):
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise Refused("ProtocolError", f"{value!r} is no number")
        if not math.isfinite(value):
            raise Refused("ProtocolError", f"{value!r} is not finite")


def check_fields(what, message, names=None):
    """Refuses an object with missing, unknown or wrong fields."""
    needed, more = names or FIELDS[what]
    if not isinstance(message, dict) or not needed <= set(message) <= needed | more:
        raise Refused("ProtocolError", f"{what}: wrong fields")
    for name, value in message.items():
        number = name in ("offset", "length", "number", "attempt")
        if number and (type(value) is not int or value < 0):
            raise Refused("ProtocolError", f"{name}: no whole number")
        text = name in ("lease", "holder", "digest", "trial_id", "action", "run")
        if text and not isinstance(value, str):
            raise Refused("ProtocolError", f"{name}: no text")
    return message


def gains_of(values):
    check_fields("P", values)
    finite(*values.values())
    if not (values["P"] > 0.0 and min(values.values()) >= 0.0):
        raise Refused("ProtocolError", "gains out of range")
    return values


def parse(payload):
    if len(payload) > 2048:
        raise Refused("ProtocolError", "longer than 2048 bytes")
    try:
        return json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise Refused("ProtocolError", str(error)) from error


def part(whole, offset, length):
    """Part of a frame from a byte on."""
    piece = whole[offset : offset + min(length or PART, PART)]
    if not piece:
        raise Refused("ProtocolError", "no such part")
    head = struct.pack("<4sII", b"RTP1", len(whole), offset)
    return head + struct.pack("<I", zlib.crc32(head + bytes(4) + piece)) + piece


def record(rig, trial, rows, stop):
    """Frame of a record: header and columns."""
    header = {
        "columns": ["time_s", "setpoint_N", "tension_N", "current_A", "angle_rad"],
        "samples": len(rows),
        "trial_id": trial["id"],
        "rig": rig,
        "sampling_Hz": RATE_HZ,
        "cable_length_m": 0.8,
        "preload_N": float(trial["profile"][0]),
        "gains": trial["gains"],
        "outcome": "cancelled" if stop else "done",
        "reason": stop,
        "started_at": "2009-05-04T12:00:00+00:00",
        "software": "small board 1",
        "loop": "closed",
        "profile": "step",
    }
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    body = b"".join(struct.pack(f"<{len(c)}d", *c) for c in zip(*rows, strict=True))
    body += bytes(len(rows))
    head = struct.pack("<4sII", b"RTR1", len(text), len(body))
    checksum = zlib.crc32(head + bytes(4) + text + body)
    return head + struct.pack("<I", checksum) + text + body
