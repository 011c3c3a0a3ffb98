"""A serial port as bytes with deadlines."""

import binascii
import errno
import fcntl
import os
import select
import struct
import termios
import time
import tty
from pathlib import Path

from estune.errors import InvalidInput, RigError

LATENCY_MAX_ms = 1
"""Longest time for which a USB adapter may hold back what it has received."""


BITS_PER_BYTE = 10
"""With start and stop bit."""


_REMEDIES = {
    errno.EACCES: "let the user use it, on most systems by: sudo usermod -aG dialout $USER",
    errno.EWOULDBLOCK: "close the other program that uses it",
    errno.EBUSY: "close the other program that uses it",
    errno.ENOTTY: "name the serial port that the board is at",
    errno.EISDIR: "name the serial port that the board is at",
}
"""What to do, by the number of the error."""


CHECKSUM = struct.Struct("<H")
"""CRC-16 with polynomial 0x1021 from 0xFFFF, of everything before it."""


def sealed(packet: bytes) -> bytes:
    """A packet with its checksum."""
    return packet + CHECKSUM.pack(binascii.crc_hqx(packet, 0xFFFF))


class SerialPort:
    """An open port in raw mode, locked against a second program.

    Attributes:
        fault: Why the last bytes were not sent or received; empty where they were.
        byte_s: Time of a byte on the line, s.
        waited_s: Time spent waiting for bytes, s.

    Args:
        path: The device, such as /dev/ttyACM0.
        baud: Rate of the line; boards with USB of their own ignore it.
        sysfs: Where the settings of USB adapters are.

    Raises:
        RigError: it cannot be opened, is in use, or its adapter would delay every answer.
        InvalidInput: there is no such rate.
    """

    def __init__(self, path: str, baud: int, sysfs: Path = Path("/sys/class/tty")) -> None:
        speed = getattr(termios, f"B{baud}", None)
        if speed is None:
            raise InvalidInput(f"baud is {baud}; give a standard rate, such as 921600")
        _check_latency(sysfs / Path(path).name / "device" / "latency_timer", path)
        try:
            self._file = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError as error:
            remedy = _REMEDIES.get(error.errno or 0, "is it plugged in?")
            raise RigError(f"no board at {path}: {error.strerror}; {remedy}") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            tty.setraw(self._file)
            settings = termios.tcgetattr(self._file)
            settings[4] = settings[5] = speed
            termios.tcsetattr(self._file, termios.TCSANOW, settings)
            termios.tcflush(self._file, termios.TCIOFLUSH)
        except (OSError, termios.error) as error:
            os.close(self._file)
            number, why = error.args
            remedy = _REMEDIES.get(number, "check the device")
            raise RigError(f"{path} cannot be used: {why}; {remedy}") from error
        self._poll = select.poll()
        self._poll.register(self._file, select.POLLIN)
        self._path = path
        self.byte_s, self.waited_s, self.fault = BITS_PER_BYTE / baud, 0.0, ""

    def write(self, data: bytes) -> None:
        """Sends bytes, or sets the fault."""
        try:
            sent = os.write(self._file, data)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            self.fault = self._gone(error.strerror)
            return
        full = f"{self._path} takes no more bytes; check the device and the rate of the line"
        self.fault = "" if sent == len(data) else full

    def read(self, until_s: float) -> bytes:
        """Bytes that arrive before an instant of `time.monotonic`; empty if none do."""
        if self.fault:
            return b""  # what would be answered was not sent
        began_s = time.monotonic()
        wait_ms = max(0.0, 1e3 * (until_s - began_s))
        # poll counts whole milliseconds; what is left of the last one is watched.
        while not (arrived := self._poll.poll(int(wait_ms))):
            wait_ms = 0.0
            if time.monotonic() >= until_s:
                break
        self.waited_s += time.monotonic() - began_s
        if not arrived:
            return b""
        try:
            data = os.read(self._file, 4096)
        except BlockingIOError:
            return b""
        except OSError as error:
            self.fault = self._gone(error.strerror)
            return b""
        if not data:
            self.fault = self._gone("hung up")
        return data

    def _gone(self, why: str | None) -> str:
        return f"{self._path} is gone ({why}); plug it in again"

    def close(self) -> None:
        """Closes the port. May be called again."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def _check_latency(timer: Path, path: str) -> None:
    try:
        held_ms = int(timer.read_text())
    except (OSError, ValueError):
        return  # no adapter that holds back
    if held_ms > LATENCY_MAX_ms:
        raise RigError(
            f"the USB adapter of {path} holds answers back for {held_ms} ms; set it with: "
            f"echo {LATENCY_MAX_ms} > {timer}"
        )
