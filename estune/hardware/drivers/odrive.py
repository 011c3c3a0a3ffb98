"""An ODrive by CAN Simple (firmware 0.5.2 to 0.6), torque control; it measures no tension.

Its default bus rate of 250 kbit/s is too slow for 632 Hz with a gauge on the bus (380 bits a
sample at worst, 96 % of the period): set `odrv.can.config.baud_rate` to 1000000.
"""

import math
import struct
import time
from collections import Counter
from typing import NamedTuple

from estune.core.quantities import check_positive
from estune.errors import InvalidInput
from estune.hardware.driver import MessageCount, Position
from estune.hardware.drivers.can_bus import CanSocket, Frame, frame_bits

HEARTBEAT, ESTOP, SET_STATE, ENCODER = 0x01, 0x02, 0x07, 0x09
SET_MODE, INPUT_TORQUE, CLEAR_ERRORS = 0x0B, 0x0E, 0x18
"""Commands of CAN Simple, as in docs/can-protocol.rst of the firmware."""

IDLE, CLOSED_LOOP = 1, 8
TORQUE_CONTROL, PASSTHROUGH = 1, 1

_MODE, _STATE, _TORQUE = struct.Struct("<II"), struct.Struct("<I"), struct.Struct("<f")
_ENCODER, _HEARTBEAT = struct.Struct("<ff"), struct.Struct("<IB")

_ASKED = -1
"""Requests for the encoder among the counted messages, beside the received commands."""

SWITCHED_WITHIN_s = 1.0
ATTEMPTS = 3
"""Requests for the encoder within `answer_within_s`."""

HEARTBEATS_MISSED_MAX = 10
"""Heartbeats in a row that may be missing while the axis has power, before its state is unknown.

Ten of 0.1 s: load on the bus delays them, for they have the lowest of priorities.
"""


COUNTS_MAX = 2**31
"""Counts that a drive cannot have turned: its own counter has 32 bits."""


class Heartbeat(NamedTuple):
    """Errors and state of the axis."""

    errors: int
    state: int


class ODrive:
    """A drive for `estune.hardware.drivers.paired`; implements `estune.hardware.Drive`.

    Args:
        interface: The CAN interface, such as can0.
        node: The axis's node id.
        newton_metres_per_count: Torque of one count of the current's calibration C1.
        counts_per_turn: Encoder counts per turn in the rig's file; a float32 of turns is finer.
        answer_within_s: Time within which the encoder's frame must have come; it is asked for
            three times.
        write_within_s: Longest time between two commands while enabled. The firmware's watchdog is
            fed by any frame, reading included, so that it cannot see a dead controller.
        heartbeat_s: Period of the axis's heartbeat; `estune doctor` compares it, and an axis with
            power that sends none for ten periods ends motion.
        bits_per_s: Rate of the bus, from which `estune doctor` computes the time on the wire.

    Raises:
        RigError: there is no such interface.
        InvalidInput: a value is out of its range.
    """

    def __init__(
        self,
        interface: str,
        node: int = 0,
        *,
        newton_metres_per_count: float,
        counts_per_turn: int,
        answer_within_s: float = 0.003,
        write_within_s: float = 0.02,
        heartbeat_s: float = 0.1,
        bits_per_s: int = 1_000_000,
    ) -> None:
        check_positive("newton_metres_per_count", newton_metres_per_count, "N m")
        check_positive("answer_within_s", answer_within_s, "s")  # after NaN no wait would end
        check_positive("write_within_s", write_within_s, "s")  # NaN would see no dead controller
        check_positive("counts_per_turn", abs(counts_per_turn))  # a shaft never seen to turn
        check_positive("heartbeat_s", heartbeat_s, "s")
        check_positive("bits_per_s", bits_per_s, "bit/s")
        if not 0 <= node <= 0x3F:
            raise InvalidInput(f"node is {node}; it must be from 0 to 63")
        self._node = node << 5
        self._torque_Nm, self._counts = newton_metres_per_count, counts_per_turn
        self._answer_s, self._write_s = answer_within_s, write_within_s
        self._enabled = False
        self._written_s = 0.0
        self._turns: float | None = None
        self._refused = ""  # what came in place of the encoder's turns
        self._heartbeat = Heartbeat(0, IDLE)
        self._beat_at_s = time.monotonic()
        self._heartbeat_s, self._bits_per_s = heartbeat_s, bits_per_s
        self._frames = Counter[int]()
        self._bus = CanSocket(interface, self._node, self._node | 0x1F)
        self._opened_s = time.monotonic()

    @property
    def waited_s(self) -> float:
        """Time spent waiting for frames, s."""
        return self._bus.waited_s

    def messages(self) -> tuple[MessageCount, ...]:
        """Encoder frames, asked for; heartbeats, due by their period; torques, unconfirmed."""
        n, due = self._frames, (time.monotonic() - self._opened_s) / self._heartbeat_s
        none_s, four_s, eight_s = (frame_bits(n) / self._bits_per_s for n in (0, 4, 8))
        return (
            MessageCount("encoder", n[_ASKED], n[ENCODER], none_s + eight_s),
            MessageCount("torque", n[INPUT_TORQUE], math.nan, four_s),
            MessageCount("heartbeat", due, n[HEARTBEAT], eight_s),
        )

    def enable(self) -> None:
        """Clears errors, selects torque control and closes the loop of the current.

        Where the axis does not enter closed loop, its position has a fault with the error bits.
        """
        self._send(CLEAR_ERRORS)
        self._send(SET_MODE, _MODE.pack(TORQUE_CONTROL, PASSTHROUGH))
        self.write(0)
        self._send(SET_STATE, _STATE.pack(CLOSED_LOOP))
        self._heartbeat = Heartbeat(0, IDLE)
        deadline_s = time.monotonic() + SWITCHED_WITHIN_s
        while self._heartbeat.state != CLOSED_LOOP and time.monotonic() < deadline_s:
            if self._bus.fault:
                break
            self._take(self._bus.until(deadline_s))
        self._written_s = self._beat_at_s = time.monotonic()
        self._enabled = True

    def request(self) -> None:
        """Asks for the encoder; an answer to an earlier request is discarded."""
        self._take(self._bus.waiting())
        self._turns, self._refused = None, ""
        self._bus.send(Frame(self._node | ENCODER, remote=True))
        self._frames[_ASKED] += 1

    def position(self) -> Position:
        """The encoder's counts, after a request, which is repeated.

        They have a fault where they do not come, and where the axis has left closed loop or fallen
        silent, or no torque has been sent for long.
        """
        turns = self._answered()
        if turns is None:
            waited = (
                f"the ODrive has not answered {ATTEMPTS} requests for its encoder within "
                f"{self._answer_s:g} s"
            )
            refused = self._refused and f": it sent {self._refused}"
            return Position(0, self._bus.fault or waited + refused)
        return Position(round(turns * self._counts), self._power_fault() if self._enabled else "")

    def _power_fault(self) -> str:
        """Why the axis with power is not under control; empty where it is."""
        if self._heartbeat != Heartbeat(0, CLOSED_LOOP):
            return f"the ODrive is not in closed loop ({self._said()}); check drive and supply"
        silent_s = time.monotonic() - self._beat_at_s
        if silent_s > HEARTBEATS_MISSED_MAX * self._heartbeat_s:
            return (
                f"no heartbeat of the ODrive for {silent_s:.1f} s: its state is unknown; check "
                "the drive and its heartbeat_rate_ms"
            )
        if time.monotonic() - self._written_s > self._write_s:
            return f"no torque was commanded for more than {self._write_s:g} s"
        return ""

    def _answered(self) -> float | None:
        """Turns of the encoder, asked for again where no answer comes; None without any."""
        for attempt in range(ATTEMPTS):
            if attempt:
                self.request()
            deadline_s = time.monotonic() + self._answer_s / ATTEMPTS
            while self._turns is None and (frames := self._bus.until(deadline_s)):
                self._take(frames)
                if time.monotonic() > deadline_s:
                    break  # a bus that is flooded always has frames
            if self._turns is not None:
                break
        return self._turns

    def write(self, current_counts: int) -> None:
        """Commands a torque."""
        self._send(INPUT_TORQUE, _TORQUE.pack(current_counts * self._torque_Nm))
        self._frames[INPUT_TORQUE] += 1
        # Not where it was not sent: the axis keeps its last torque, and the next frame, which may
        # pass, clears the fault of this one.
        if not self._bus.fault:
            self._written_s = time.monotonic()

    def disable(self) -> None:
        """Takes the torque away and lets the axis idle."""
        self._enabled = False
        self.write(0)
        self._send(SET_STATE, _STATE.pack(IDLE))

    def safe_state(self) -> None:
        """The drive's emergency stop: it disarms, with an error that `enable` clears."""
        self._enabled = False
        self._send(ESTOP)

    def close(self) -> None:
        """Closes the interface. May be called again."""
        self._bus.close()

    def _send(self, command: int, data: bytes = b"") -> None:
        self._bus.send(Frame(self._node | command, data))

    def _take(self, frames: list[Frame]) -> None:
        for frame in frames:
            command = frame.identifier & 0x1F
            self._frames[command] += 1
            if command == ENCODER:
                self._note_turns(frame.data)
            elif command == HEARTBEAT and len(frame.data) >= _HEARTBEAT.size:
                self._heartbeat = Heartbeat(*_HEARTBEAT.unpack_from(frame.data))
                self._beat_at_s = time.monotonic()

    def _note_turns(self, data: bytes) -> None:
        if len(data) != _ENCODER.size:
            self._refused = f"{len(data)} bytes in place of {_ENCODER.size}"
            return
        turns = _ENCODER.unpack(data)[0]
        if abs(turns * self._counts) < COUNTS_MAX:  # which NaN is not
            self._turns = turns
        else:
            self._refused = f"{turns:g} turns"

    def _said(self) -> str:
        return f"state {self._heartbeat.state}, errors {self._heartbeat.errors:#x}"
