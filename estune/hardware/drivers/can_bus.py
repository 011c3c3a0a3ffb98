"""Classical CAN frames on a Linux CAN interface, without a library: they are 16 bytes."""

import select
import socket
import struct
import time
from typing import NamedTuple

from estune.errors import RigError

FRAME = struct.Struct("<IB3x8s")
"""`struct can_frame` of linux/can.h: identifier with flags, length, eight bytes."""
REMOTE, EXTENDED, ERROR = 0x40000000, 0x80000000, 0x20000000
QUEUE_MAX = 1024
"""Frames taken at once: more than the kernel queues for a socket, so that a flood leaves no old
frame, and fewer than a flood brings without end."""
_FILTER = struct.Struct("<II")


class Frame(NamedTuple):
    """One frame; `remote` is a request for the frame of the same identifier.

    Attributes:
        is_data: Whether it is an ordinary frame with data: not remote, and neither of an extended
            identifier, which may have the same number, nor a report of an error on the bus.
    """

    identifier: int
    data: bytes = b""
    remote: bool = False
    is_data: bool = True

    def pack(self) -> bytes:
        """As the kernel takes it."""
        flags = (REMOTE if self.remote else 0) | (EXTENDED if self.identifier > 0x7FF else 0)
        return FRAME.pack(self.identifier | flags, len(self.data), self.data)

    @classmethod
    def unpack(cls, packet: bytes) -> "Frame":
        """As the kernel gives it."""
        identifier, length, data = FRAME.unpack(packet)
        is_data = not identifier & (REMOTE | EXTENDED | ERROR)
        return cls(identifier & 0x1FFFFFFF, data[:length], bool(identifier & REMOTE), is_data)


def frame_bits(length: int) -> int:
    """Bits of a standard frame of so many bytes, at most: with stuffing and the gap after it."""
    return 8 * length + 47 + (34 + 8 * length - 1) // 4


class CanSocket:
    """Frames of one device on a bus.

    Attributes:
        fault: Why the last frame was not sent or received; empty where it was.
        waited_s: Time spent waiting for frames, s.

    Args:
        interface: The interface, such as can0; or the path of a local socket that carries the same
            frames, as the emulated hardware offers.
        first: The lowest identifier that is received.
        last: The highest; both must agree in all but their low bits.

    Raises:
        RigError: there is no such interface, or it is not up.
    """

    def __init__(self, interface: str, first: int, last: int) -> None:
        local = interface.startswith("/")
        if not local and not hasattr(socket, "AF_CAN"):
            raise RigError("CAN interfaces are reached on Linux only; serve the rig there")
        try:
            if local:
                self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
                self._socket.connect(interface)
            else:
                self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
                mask = 0x7FF & ~(first ^ last)
                accepted = _FILTER.pack(first & mask, mask | EXTENDED)
                self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, accepted)
                self._socket.bind((interface,))
        except OSError as error:
            if hasattr(self, "_socket"):
                self._socket.close()
            raise RigError(
                f"no CAN interface {interface}: {error.strerror}; bring it up with: "
                f"ip link set {interface} up type can bitrate 1000000"
            ) from error
        self._range = range(first, last + 1)
        self.waited_s, self.fault = 0.0, ""
        self._socket.settimeout(0.0)
        self._poll = select.poll()
        self._poll.register(self._socket, select.POLLIN)

    def send(self, frame: Frame) -> None:
        """Sends a frame, or sets the fault: the queue is full where no device acknowledges."""
        self.fault = ""
        try:
            self._socket.send(frame.pack())
        except OSError as error:
            self.fault = (
                f"the CAN interface takes no frame ({error.strerror}); check the adapter, the "
                "bus, its rate and its termination"
            )

    def waiting(self) -> list[Frame]:
        """The frames that have arrived."""
        found = []
        for _ in range(QUEUE_MAX):
            if self.fault or not self._poll.poll(0):
                break
            try:
                packet = self._socket.recv(FRAME.size)
            except OSError as error:
                self.fault = f"the CAN interface is gone ({error.strerror}); check the adapter"
                break
            if len(packet) != FRAME.size:
                self.fault = "the CAN interface is gone; check the adapter"
                break
            frame = Frame.unpack(packet)
            if frame.identifier in self._range and frame.is_data:
                found.append(frame)
        return found

    def until(self, instant_s: float) -> list[Frame]:
        """The frames that arrive next, waiting until an instant of `time.monotonic`."""
        began_s = time.monotonic()
        while not (found := self.waiting()):
            left_ms = 1e3 * (instant_s - time.monotonic())
            if left_ms <= 0.0 or self.fault:
                break
            self._poll.poll(int(left_ms))  # whole milliseconds; the rest of the last is watched
        self.waited_s += time.monotonic() - began_s
        return found

    def close(self) -> None:
        """Closes the socket. May be called again."""
        self._socket.close()
