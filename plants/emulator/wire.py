"""What the driver and the emulated hardware say to each other: packets of a fixed size."""

import struct
from typing import NamedTuple

COMMAND = struct.Struct("<cq")
"""A verb and a number; the number is the command of a current, else zero."""

READ, WRITE, ENABLE, DISABLE, TRUTH = b"r", b"w", b"e", b"d", b"t"

READING = struct.Struct("<dqq")
"""The answer to READ: time in s, counts of the gauge, counts of the encoder."""

TRUTH_ANSWER = struct.Struct("<dddd?qqd")
"""The answer to TRUTH: the fields of `Truth`."""


class Truth(NamedTuple):
    """How the emulated hardware really stands, which no driver can see.

    Attributes:
        time_s: When, on the monotonic clock, s.
        tension_N: Tension at the gauge, without noise, N.
        current_A: Current that the amplifier gives, A.
        angle_rad: Angle of the drum, rad.
        powered: Whether the amplifier has power.
        tripped: How often the watchdog has cut it off.
        written: How many commands have come.
        last_write_s: When the last came, s.
    """

    time_s: float
    tension_N: float
    current_A: float
    angle_rad: float
    powered: bool
    tripped: int
    written: int
    last_write_s: float
