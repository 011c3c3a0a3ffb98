"""Rig of a board that closes the loop itself."""

import contextlib
import logging
import struct
import threading
import time
from collections import deque
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estune.core import pidf
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput, RigError
from estune.hardware.compensation.plan import CompensationTerms
from estune.hardware.config import RigConfig
from estune.hardware.shared_memory import MotionPhase
from estune.hardware.trial_board.link import REASONS, BoardLink, BoardStatus
from estune.recordings.black_box_file import ROW
from estune.support.closing import Closing
from estune.trial import GUARD, SATURATED, Outcome, RigDescription, TrialRecord, TrialRequest
from estune.trial.executed_trials import ExecutedTrials, stopped_trial
from estune.trial.records import COLUMNS, record_of

DRIVER = "trial-board"
"""Name of the driver in a rig's file by which the loop is the board's."""

BEAT_s = 0.1
"""Interval of the sign of life; the board stops by itself after guard.heartbeat_s without one."""
_POLL_s = 0.01
_TRIALS_MOVED = 8
"""Trials whose samples the black box may be late for."""
_PART, _BODY_MAX = 28, 236  # numbers, bytes: LONGEST of the C text less the sample's number
_NUMBERS = ("tension", "effort", "angle")
_OUTCOMES = {
    1: Outcome.DONE,
    2: Outcome.GUARD,
    3: Outcome.CANCELLED,
    4: Outcome.INTERRUPTED,
}

_log = logging.getLogger(__name__)


class BoardRig(Closing):
    """Runs trials on a board; a `Rig` with its errors, also where the board does not answer.

    Args:
        config: The rig's file; `driver.settings` are `port`, `baud`, `answer_within_s` and
            `attempts`.

    Attributes:
        stop_reason: Why the board's guard last ended a trial; empty if it did not.

    Raises:
        RigError: no board answers at the port.
    """

    notes: tuple[str, ...] = ()

    def __init__(self, config: RigConfig) -> None:
        self._config = config
        self._description = config.describe()
        settings = {"baud": 921600, "answer_within_s": 0.05, "attempts": 5}
        self._link = BoardLink(**{**settings, **config.driver.settings})
        self._records = ExecutedTrials()
        self._trial = threading.Lock()
        self._moved: deque[NDArray[np.void]] = deque(maxlen=_TRIALS_MOVED)
        self._samples = 0
        self._ended = threading.Event()
        self._failure = ""
        self.stop_reason = ""
        try:
            self._number = self._link.status(b"s").trial
            self._link.status(b"g", self._coefficients(self._description.gains))
        except BaseException:
            self._link.close()
            raise
        self._beating = threading.Thread(target=self._beat, name="sign of life", daemon=True)
        self._beating.start()

    def describe(self) -> RigDescription:
        """Description of the rig, with its live gains."""
        self._check_alive()
        return self._description

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs one trial, or returns the record of it if that trial id has run before."""
        with self._trial:
            self._check_alive()
            stored = self._records.find_record(request)
            if stored is not None:
                return stored
            self._description.limits.check(request.profile)
            self._description.check_gains(request.gains, trial=True)
            if request.compensation:
                raise InvalidInput(
                    f"rig {self._description.name} is a board, whose compensations are compiled "
                    "in; change its file, export and flash it anew"
                )
            setpoint = request.profile.setpoint(self._config.sampling_Hz)
            self._send_setpoint(setpoint)
            try:
                began = self._begin(request, len(setpoint))
                status = self._until_ended(request)
            except BaseException:
                # The sign of life goes on: the board would run a trial that nobody waits for.
                with contextlib.suppress(RigError):
                    self._stop()
                raise
            record = self._record(request, status, setpoint, began)
            self._records.add(request, record)
            self._note_motion(record)
            return record

    def motion_since(self, sample: int) -> NDArray[np.void]:
        """Samples of trials after one of this number; between trials a board reports none."""
        rows = np.concatenate([np.empty(0, ROW), *self._moved])
        return rows[rows["sample"] > sample]

    def apply(self, gains: Gains) -> None:
        """Makes gains the live ones, without a jump of the effort."""
        with self._trial:
            self._check_alive()
            self._description.check_gains(gains)
            status = self._link.status(b"g", self._coefficients(gains))
            if status.latched:
                raise self._latched(status)
            self._description = replace(self._description, gains=gains)

    def abort(self) -> RigDescription:
        """Stops the trial under way, if any, and returns once the live gains are back."""
        self._check_alive()
        with stopped_trial(self._trial, self._stop):
            return self.describe()

    def estop(self, reason: str) -> None:
        """Emergency stop: the board brings the effort to zero from its next sample on.

        The rig takes neither trials nor gains until it is cleared. This is software: a reel that
        can hurt people needs a switch that cuts the amplifier's power, too.
        """
        _log.warning("rig %s: emergency stop: %s", self._description.name, reason)
        self._link.status(b"x")

    def clear(self) -> None:
        """Resets the emergency stop, and a stop by the board's guard."""
        self._check_alive()
        self._link.status(b"c")

    def wait(self) -> None:
        """Returns when the board no longer answers, or the rig was closed."""
        self._ended.wait()

    def close(self) -> None:
        """Stops the trial and leaves the board, which then comes to rest by itself."""
        if self._ended.is_set() and not self._failure:
            return
        if not self._failure:
            with stopped_trial(self._trial, self._stop):
                self._ended.set()
        # The interpreter must not shut down while a thread is inside the system.
        self._beating.join()
        self._link.close()

    def _stop(self) -> None:
        self._link.status(b"a")

    def _send_setpoint(self, setpoint: FloatArray) -> None:
        for first in range(0, len(setpoint), _PART):
            part = setpoint[first : first + _PART].astype("<f8").tobytes()
            # A board that runs a trial drops the part: the next would run by an old setpoint.
            if self._link.status(b"p", struct.pack("<I", first) + part).pending:
                raise RigError(
                    f"the board of rig {self._description.name} still runs an earlier trial; stop "
                    "it first"
                )

    def _begin(self, request: TrialRequest, samples: int) -> datetime:
        deadline_s = time.monotonic() + self._config.safe.ramp_s + 1.0
        self._number = (self._number + 1) % 2**32
        head = struct.pack("<IIB", self._number, samples, request.profile.loop == "open")
        preload = struct.pack("<d", request.profile.preload_N)
        body = head + preload + self._coefficients(request.gains)
        while (status := self._link.status(b"t", body)).trial != self._number:
            if status.latched:
                raise self._latched(status)
            if time.monotonic() > deadline_s:  # else it is still on the way to its safe state
                raise RigError(
                    f"the board of rig {self._description.name} takes no trial in state "
                    f"{status.state.name}; check its program"
                )
            time.sleep(_POLL_s)
        return datetime.now(UTC)

    def _until_ended(self, request: TrialRequest) -> BoardStatus:
        motion = self._config.motion
        longest_s = motion.take_up_s + motion.settle_within_s + request.profile.duration_s
        deadline_s = time.monotonic() + 2.0 * longest_s + 5.0
        while (status := self._link.status(b"s")).pending:
            if time.monotonic() > deadline_s:
                self._link.status(b"x")
                raise RigError(
                    f"the trial has not ended on the board of rig {self._description.name} after "
                    f"{2.0 * longest_s + 5.0:.0f} s; it is stopped: check its sampling rate"
                )
            time.sleep(_POLL_s)
        # Its memory is empty: the record would be that of no trial, by gains of the file.
        if status.trial != self._number:
            raise RigError(
                f"the board of rig {self._description.name} was restarted; check it, then start "
                "the rig anew"
            )
        return status

    def _record(
        self,
        request: TrialRequest,
        status: BoardStatus,
        setpoint: FloatArray,
        began: datetime,
    ) -> TrialRecord:
        rows = self._rows(status.done)
        outcome = _OUTCOMES[status.outcome]
        return record_of(
            *(request, self._description, outcome),
            "" if outcome is Outcome.DONE else REASONS[status.reason],
            began.isoformat(timespec="milliseconds"),
            time_s=np.arange(rows.size) / self._config.sampling_Hz,
            setpoint_N=setpoint[: rows.size].copy(),
            tension_N=rows["tension"].copy(),
            current_A=rows["effort"] / self._config.newtons_per_ampere,
            angle_rad=rows["angle"].copy(),
            flags=rows["flags"] * np.uint8(SATURATED),
            **self._compensations(rows),
        )

    def _rows(self, count: int) -> NDArray[np.void]:
        terms = CompensationTerms._fields if self._config.compensation else ()
        row = np.dtype([*((name, "<f8") for name in (*_NUMBERS, *terms)), ("flags", "u1")])
        at_once = _BODY_MAX // row.itemsize
        data = b""
        for first in range(0, count, at_once):
            data += self._link.exchange(b"r", struct.pack("<IB", first, at_once))[4:]
        return np.frombuffer(data, row)

    def _note_motion(self, record: TrialRecord) -> None:
        rows = np.zeros(record.time_s.size, ROW)
        rows["sample"] = self._samples + 1 + np.arange(rows.size)
        for name in COLUMNS:
            rows[name] = getattr(record, name)
        rows["time_s"] += time.monotonic() - rows.size / self._config.sampling_Hz
        rows["phase"], rows["flags"] = MotionPhase.TRIAL, record.flags
        if record.outcome in (Outcome.GUARD, Outcome.INTERRUPTED):
            self.stop_reason = record.reason
            rows["flags"][-1:] |= GUARD
        self._samples += rows.size
        self._moved.append(rows)

    def _compensations(self, rows: NDArray[np.void]) -> dict[str, Any]:
        """The columns of the compensations that are on."""
        if self._config.compensation is None:
            return {}
        amperes = 1.0 / self._config.newtons_per_ampere
        terms: Any = CompensationTerms._make(rows[name] for name in CompensationTerms._fields)
        columns = terms.columns(amperes)
        return {name: np.array(columns[name]) for name in self._config.compensation.columns}

    def _coefficients(self, gains: Gains) -> bytes:
        numbers = pidf.coefficients(self._description.controller, gains)
        return struct.pack(f"<{len(numbers)}d", *map(float, numbers))

    def _latched(self, status: BoardStatus) -> RigError:
        why = REASONS[status.reason] or "stopped"
        return RigError(
            f"rig {self._description.name} is stopped ({why}); check it, then clear it"
        )

    def _beat(self) -> None:
        while not self._ended.wait(BEAT_s):
            try:
                self._link.status(b"s")
            except (RigError, OSError) as error:
                self._failure = str(error)
                self._ended.set()

    def _check_alive(self) -> None:
        if self._failure:
            raise RigError(f"rig {self._description.name}: {self._failure}, then start it anew")
        if self._ended.is_set():
            raise RigError(f"rig {self._description.name} is closed; start a new one")
