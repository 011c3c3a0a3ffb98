"""Packets of a fixed size between the driver and the emulated hardware."""

import struct
from typing import NamedTuple

COMMAND = struct.Struct("<cq")
"""A verb and a number: the current command in counts, else zero."""

READ, WRITE, ENABLE, DISABLE, TRUTH = b"r", b"w", b"e", b"d", b"t"

READING = struct.Struct("<dqq")
"""The answer to READ: time in s, counts of the gauge, counts of the encoder."""

TRUTH_ANSWER = struct.Struct("<dddd?qq")
"""The answer to TRUTH: the fields of `TrueState`."""


class TrueState(NamedTuple):
    """True state of the emulated hardware, which no real driver can read.

    Attributes:
        time_s: Time on the monotonic clock, s.
        tension_N: Tension at the gauge, without noise, N.
        tripped: Number of cut-offs by the watchdog.
        written: Number of current commands.
    """

    time_s: float
    tension_N: float
    current_A: float
    angle_rad: float
    powered: bool
    tripped: int
    written: int
