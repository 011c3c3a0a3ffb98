"""ROS 2 messages in CDR (OMG DDS-XTypes 7.4.3, plain CDR version 1, little-endian)."""

import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple

_HEADER = b"\x00\x01\x00\x00"
"""Representation: plain CDR, little-endian."""


class Diagnostic(NamedTuple):
    """One `diagnostic_msgs/DiagnosticStatus`: level 0 to 3 (fine, warning, error, stale)."""

    level: int
    name: str
    message: str
    hardware_id: str
    values: Mapping[str, str]


class _Writer:
    """Bytes of a message; each number is aligned to its own size from the header's end on."""

    def __init__(self, time_ns: int, frame_id: str) -> None:
        """Begins with a `std_msgs/Header`."""
        self._data = bytearray()
        self.numbers("i", time_ns // 10**9)
        self.numbers("I", time_ns % 10**9)
        self.text(frame_id)

    def numbers(self, form: str, *values: float) -> None:
        """Numbers of one kind, as `struct` names it."""
        if values:
            self._data += bytes(-len(self._data) % struct.calcsize(form))
            self._data += struct.pack(f"<{len(values)}{form}", *values)

    def text(self, text: str) -> None:
        """A string: its length with the zero at its end, and its bytes."""
        data = text.encode() + b"\0"
        self.numbers("I", len(data))
        self._data += data

    def doubles(self, values: Sequence[float]) -> None:
        """A sequence of float64."""
        self.numbers("I", len(values))
        self.numbers("d", *values)

    def finish(self) -> bytes:
        """The whole message."""
        return _HEADER + bytes(self._data)


def joint_state(
    time_ns: int, name: str, position_rad: float, effort_Nm: float | None = None
) -> bytes:
    """A `sensor_msgs/JointState` of one joint, without velocity."""
    writer = _Writer(time_ns, "")
    writer.numbers("I", 1)
    writer.text(name)
    writer.doubles([position_rad])
    writer.doubles([])
    writer.doubles([] if effort_Nm is None else [effort_Nm])
    return writer.finish()


def wrench_stamped(time_ns: int, frame_id: str, force_x_N: float) -> bytes:
    """A `geometry_msgs/WrenchStamped` of a force along x."""
    writer = _Writer(time_ns, frame_id)
    writer.numbers("d", force_x_N, 0.0, 0.0, 0.0, 0.0, 0.0)
    return writer.finish()


def diagnostic_array(time_ns: int, diagnostics: Sequence[Diagnostic]) -> bytes:
    """A `diagnostic_msgs/DiagnosticArray`."""
    writer = _Writer(time_ns, "")
    writer.numbers("I", len(diagnostics))
    for level, *texts, values in diagnostics:
        writer.numbers("B", level)
        for text in texts:
            writer.text(text)
        writer.numbers("I", len(values))
        for pair in values.items():
            for text in pair:
                writer.text(text)
    return writer.finish()
