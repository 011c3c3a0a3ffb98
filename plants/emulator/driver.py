"""Driver of the emulated hardware, and an example for a driver of your own."""

import contextlib
import json
import socket
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from estune.errors import RigError
from estune.hardware.driver import Reading, bad_reading
from estune.support.child_process import child_process
from estune.support.closing import Closing
from plants.emulator import wire
from plants.emulator.wire import TrueState

_ANSWER_WITHIN_s = 0.05
_END_WITHIN_s = 2.0


class EmulatedDriver(Closing):
    """Drives an emulated reel; implements `estune.hardware.Driver`.

    Args:
        address: Socket of running hardware (`python -m plants.emulator ADDRESS`). Without one, the
            driver starts hardware of its own, with the settings below, which ends with it.
        reel: Settings of the reference reel, such as cable_length_m.
        effects: Effects of the reel, such as {"name": "stribeck_friction", "coulomb_Nm": 0.02}.
        electronics: See `plants.emulator.board.Electronics`.
        far_end: Motion of the cable's far end; see `plants.emulator.board.FarEnd`.
        seed: Seed of the gauge's noise.
        waits_s: Longest time for which the machine waits for a computer that is held up, and this
            driver for the machine; see `plants.emulator.clock`.

    Raises:
        RigError: nothing answers at the address, or the hardware does not start.
    """

    def __init__(
        self,
        address: str | None = None,
        *,
        reel: Mapping[str, Any] | None = None,
        effects: Sequence[Mapping[str, Any]] = (),
        electronics: Mapping[str, Any] | None = None,
        far_end: Mapping[str, Any] | None = None,
        seed: int = 0,
        waits_s: float = 0.0,
    ) -> None:
        self._own: contextlib.ExitStack = contextlib.ExitStack()
        if address is None:
            settings = {
                "reel": reel or {},
                "effects": list(effects),
                "electronics": electronics or {},
                "far_end": far_end or {},
                "seed": seed,
                "waits_s": waits_s,
            }
            address = self._own.enter_context(emulated_hardware(settings))
        self._last: Reading | None = None
        self._late = False  # whether an answer may come after its time
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(max(_ANSWER_WITHIN_s, waits_s))
        try:
            self._socket.connect(address)
        except OSError as error:
            self.close()
            raise RigError(
                f"no emulated hardware at {address}: {error.strerror}; start it with: "
                f"python -m plants.emulator {address}"
            ) from error

    def enable(self) -> None:
        """Gives the amplifier power."""
        self._say(wire.ENABLE)

    def read(self) -> Reading:
        """Reads gauge and encoder."""
        try:
            while self._late and self._socket.recv(wire.READING.size, socket.MSG_DONTWAIT):
                pass  # an answer to an earlier request
        except BlockingIOError:
            self._late = False
        except OSError as error:
            return bad_reading(f"the emulated hardware is gone: {error.strerror}", self._last)
        try:
            self._say(wire.READ)
            answer = self._socket.recv(wire.READING.size)
        except OSError as error:
            self._late = True
            why = error.strerror or error
            return bad_reading(f"the emulated hardware does not answer: {why}", self._last)
        if len(answer) != wire.READING.size:
            return bad_reading("the emulated hardware has ended", self._last)
        self._last = Reading(*wire.READING.unpack(answer))
        return self._last

    def write(self, current_counts: int) -> None:
        """Commands a motor current."""
        self._say(wire.WRITE, current_counts)

    def disable(self) -> None:
        """Removes the amplifier's power."""
        self._say(wire.DISABLE)

    def safe_state(self) -> None:
        """Removes the amplifier's power: this reel has no brake."""
        self._say(wire.DISABLE)

    def truth(self) -> TrueState:
        """True state of the emulated hardware."""
        self._say(wire.TRUTH)
        answer = self._socket.recv(wire.TRUTH_ANSWER.size)
        return TrueState(*wire.TRUTH_ANSWER.unpack(answer))

    def close(self) -> None:
        """Closes the connection; ends hardware that the driver has started."""
        with contextlib.suppress(OSError):
            self._say(wire.DISABLE)
        self._socket.close()
        self._own.close()

    def _say(self, verb: bytes, number: int = 0) -> None:
        self._socket.send(wire.COMMAND.pack(verb, number))


@contextlib.contextmanager
def emulated_hardware(settings: Mapping[str, Any]) -> Iterator[str]:
    """Emulated hardware in a process of its own, for the duration of the block; its address.

    Args:
        settings: Those of `EmulatedDriver`; and `device`, as of `plants.emulator.devices`.

    Raises:
        RigError: it does not start.
    """
    with tempfile.TemporaryDirectory(prefix="estune-reel-") as folder:
        address = str(Path(folder) / "reel")
        arguments = ("plants.emulator", address, json.dumps(dict(settings)))
        with child_process(
            *arguments,
            end_within_s=_END_WITHIN_s,
            stderr=subprocess.PIPE,
            start_new_session=True,
        ) as process:
            assert process.stdout and process.stderr  # noqa: S101, PT018  asked for above
            if not (reached := process.stdout.readline().strip()):
                errors = process.stderr.read().strip().splitlines() or ["no message"]
                raise RigError(f"the emulated hardware does not start: {errors[-1]}")
            yield reached
