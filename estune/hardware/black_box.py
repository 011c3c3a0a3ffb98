"""Black box of a rig: its last minutes of motion and its commands on disk, copied at every stop.

A folder beside the rig's file holds `motion.blackbox`, written round and round while the reel is
powered (`estune.recordings.black_box_file`), `commands.log` with the two files before it, and of
each stop a copy `stop-<time>.blackbox` with the reason and the last commands in a `.json` of the
same name. `estune records` and `estune explain` read them as any record.

A thread does all of it, twice a second: neither the loop nor a command waits for a disk, and a
full disk costs the box and not the rig. What it has taken survives the kill of the program, and a
power cut but for what the system has not yet written.
"""

import json
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from logging.handlers import RotatingFileHandler
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from estune.errors import RigError
from estune.hardware.shared_memory import MotionPhase
from estune.hardware.tables import BlackBoxTable
from estune.recordings.black_box_file import ENDING, HEAD_BYTES, ROW, head
from estune.support.closing import Closing
from estune.support.file_limits import parse_json
from estune.support.whole_file import replace_file
from estune.trial import GUARD, RigDescription

KEEP_S = 0.5
"""Time between two visits of the box to its rig; the shared memory holds eight times as much at
1 kHz."""

AFTER_S = 2.0
"""Time after a stop that its copy still shows: longer than the ramp to the safe state."""

_COMMANDS_SHOWN = 100
_COMMANDS_BYTES = 2**20
_QUIET = frozenset(("follow",))  # its setpoints are in the motion
_AT_REST = (MotionPhase.OFF, MotionPhase.STOPPED)
_log = logging.getLogger(__name__)


class MovingRig(Protocol):
    """What a black box asks of its rig."""

    @property
    def stop_reason(self) -> str:
        """Why it last stopped; empty if it did not."""

    def describe(self) -> RigDescription:
        """Description of the rig, with its live gains."""

    def motion_since(self, sample: int) -> NDArray[np.void]:
        """Rows of `black_box_file.ROW` after a sample, as far as they are still there."""


class BlackBox(Closing):
    """The black box of one rig; a context manager."""

    def __init__(self, rig: MovingRig, folder: Path, table: BlackBoxTable) -> None:
        """Begins to record; what a program left that did not end in order is kept as a stop.

        Raises:
            OSError: the folder cannot be written.
        """
        self.stops = 0
        self._rig, self._folder, self._kept = rig, folder, table.stops_kept
        self._about = _metadata(rig.describe())
        self._rows = round(60.0 * table.minutes * self._about["sampling_Hz"])
        self._written = self._sample = 0
        self._stop: tuple[float, str] | None = None  # when its copy is due, and its reason
        self._recent: deque[dict[str, Any]] = deque(maxlen=_COMMANDS_SHOWN)
        self._heard: SimpleQueue[tuple[str, str, bytes, bytes]] = SimpleQueue()
        folder.mkdir(parents=True, exist_ok=True)
        self._motion = folder / f"motion{ENDING}"
        if self._motion.exists():
            self._keep_former()
        flags = os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC
        self._file = os.open(self._motion, flags, 0o644)
        os.pwrite(self._file, head(self._about), 0)
        self._commands = RotatingFileHandler(
            folder / "commands.log", maxBytes=_COMMANDS_BYTES, backupCount=2, encoding="utf-8"
        )
        self._closing = threading.Event()
        self._failed = False
        self._thread = threading.Thread(target=self._keep, name="black box", daemon=True)
        self._thread.start()

    def hear(self, verb: str, payload: bytes, reply: bytes) -> None:
        """Takes a command and its reply; returns at once."""
        if verb not in _QUIET and b'"renew"' not in payload:
            self._heard.put((_now(), verb, payload, reply))

    def close(self, reason: str = "") -> None:
        """Writes what is left, and a stop if the rig's program ends for a reason; idempotent."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._thread.join()
        if reason:
            self._stop = 0.0, reason
        elif self._stop:
            self._stop = 0.0, self._stop[1]
        self._visit()
        with suppress(OSError):
            os.pwrite(self._file, head(self._about | {"ended": _now()}), 0)
        os.close(self._file)
        self._commands.close()

    def _keep(self) -> None:
        while not self._closing.wait(KEEP_S):
            self._visit()

    def _visit(self) -> None:
        """Takes what has happened since the last visit; copies a stop that is due."""
        try:
            self._take()
            if self._stop and time.monotonic() >= self._stop[0]:
                self._copy(self._stop[1])
                self._stop = None
            self._failed = False
        except Exception as error:  # noqa: BLE001  the rig must not suffer
            if not self._failed:
                _log.error("the black box in %s is not written: %s", self._folder, error)
            self._failed = True

    def _take(self) -> None:
        rows = self._rig.motion_since(self._sample)
        if rows.size:
            self._sample = int(rows["sample"][-1])
            self._write(rows[~np.isin(rows["phase"], _AT_REST)])
            if (rows["flags"] & GUARD).any():
                self._note_stop(self._rig.stop_reason or "the guard has tripped")
        with suppress(Empty):
            while True:
                at, verb, payload, reply = self._heard.get_nowait()
                said = {"at": at, "verb": verb, "command": _json(payload), "answer": _json(reply)}
                self._recent.append(said)
                line = logging.LogRecord("", 0, "", 0, json.dumps(said), None, None)
                self._commands.emit(line)
                if verb == "estop":
                    given = said["command"]
                    why = given.get("reason", "") if isinstance(given, dict) else given
                    self._note_stop(f"emergency stop: {why or 'no reason given'}")

    def _write(self, rows: NDArray[np.void]) -> None:
        kept = rows[-self._rows :]
        first = self._written % self._rows
        ahead = min(kept.size, self._rows - first)
        os.pwrite(self._file, kept[:ahead].tobytes(), HEAD_BYTES + first * ROW.itemsize)
        os.pwrite(self._file, kept[ahead:].tobytes(), HEAD_BYTES)
        self._written += kept.size

    def _note_stop(self, reason: str) -> None:
        """A stop soon after another is in the copy of that one."""
        if self._stop is None:
            self._stop = time.monotonic() + AFTER_S, reason

    def _copy(self, reason: str) -> None:
        with suppress(Exception):  # the rig may have ended; its last description then stands
            self._about = _metadata(self._rig.describe())
        data = os.pread(self._file, HEAD_BYTES + self._rows * ROW.itemsize, 0)
        self._store(data, {"reason": reason, "commands": list(self._recent)})
        _log.warning("rig %s stopped: %s; see %s", self._about["rig"], reason, self._folder)

    def _keep_former(self) -> None:
        """Keeps what the program before this one wrote; as a stop if it did not end in order."""
        data = self._motion.read_bytes()
        if b'"ended"' not in data[:HEAD_BYTES] and len(data) > HEAD_BYTES:
            self._store(data, {"reason": "the rig's program was killed, or lost its power"})
        self._motion.replace(self._folder / f"former{ENDING}")

    def _store(self, data: bytes, stop: dict[str, Any]) -> None:
        stem = self._folder / f"stop-{datetime.now(UTC):%Y%m%dT%H%M%S-%f}"
        replace_file(stem.with_name(stem.name + ENDING), data)
        about = json.dumps({**self._about, **stop, "at": _now()}, indent=2)
        replace_file(stem.with_name(stem.name + ".json"), about.encode())
        self.stops += 1
        for old in sorted(self._folder.glob(f"stop-*{ENDING}"))[: -self._kept]:
            old.unlink()
            old.with_name(old.name.removesuffix(ENDING) + ".json").unlink(missing_ok=True)


@contextmanager
def black_box(rig: MovingRig, file: Path, table: BlackBoxTable) -> Iterator[BlackBox | None]:
    """The black box of a rig with this file, in the folder `<file>-blackbox`; None without one.

    Raises:
        RigError: the folder cannot be written.
    """
    if not table.minutes:
        yield None
        return
    folder = file.with_name(f"{file.stem}-blackbox")
    try:
        box = BlackBox(rig, folder, table)
    except OSError as error:
        raise RigError(
            f"the black box of the rig cannot be written in {folder}: {error.strerror or error}; "
            "make room, let the rig write there, or set minutes = 0 in [black_box] of its file"
        ) from error
    with box:
        yield box


def _metadata(rig: RigDescription) -> dict[str, Any]:
    gains = rig.gains
    return rig.signals.stated | {
        "rig": rig.name,
        "sampling_Hz": rig.controller.sampling_Hz,
        "cable_length_m": rig.cable_length_m,
        "preload_N": rig.step.preload_N,
        "loop": "closed",
        "gains": {name: getattr(gains, name) for name in ("P", "I", "D", "setpoint_filter_s")},
        "profile": "custom",
        "software": rig.software,
    }


def _json(data: bytes) -> Any:
    """JSON of a command or reply; what is none as its size."""
    try:
        return parse_json(data)
    except ValueError:
        return f"{len(data)} bytes"


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
