"""The served rig behind a device with faults, and a client that asks it for trials."""

import json
import threading
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from estune.errors import EstuneError
from estune.remote import zenoh
from estune.remote.zenoh.endpoints import with_port
from estune.support.child_process import child_process, next_line
from estune.trial import Outcome, RigDescription, TrialRecord, TrialRequest
from plants.emulator import RIG_FILE
from plants.emulator.devices import GAUGE, CanDevices

ANSWER_s = 0.06
BAD_s = 0.15
"""Patience with the emulated devices: programs on a machine that may be busy, and a
pseudo-terminal, whose bytes an ordinary process of the kernel carries. With 6 and 10 ms, at a load
of 19, the serial board's rig latched in 10 of 12 trials without any fault, the other one in none.
"""
RAMP_s = 0.5
TRIAL_s = 1.2
STEP_AT_s = 0.2
SETTLE_s = 0.1

Result = TrialRecord | EstuneError


def driver_table(kind: str, address: str) -> dict[str, Any]:
    """Table `[driver]` of a device."""
    if kind == "serial":
        return {
            "use": "serial-board",
            "settings": {"port": address, "answer_within_s": ANSWER_s},
        }
    drive = {
        "interface": address,
        "newton_metres_per_count": CanDevices.newton_metres_per_count,
        "counts_per_turn": CanDevices.counts_per_turn,
        "answer_within_s": ANSWER_s,
        "write_within_s": 0.2,
    }
    gauge = {"interface": address, "identifier": GAUGE, "answer_within_s": ANSWER_s}
    return {
        "use": "odrive",
        "settings": drive,
        "gauge": {"use": "can-gauge", "settings": gauge},
    }


def rig_tables(kind: str, address: str) -> dict[str, Any]:
    """Tables of the rig's file; limits on lateness are those of a busy machine."""
    tables = tomllib.loads(RIG_FILE.read_text("utf-8"))
    tables["driver"] = driver_table(kind, address)
    tables["guard"] |= {"gap_s": 0.2, "late_in_a_row": 1000, "bad_s": BAD_s, "frozen_s": 2 * BAD_s}
    tables["safe"] |= {"ramp_s": RAMP_s}
    tables["motion"] |= {"settle_s": SETTLE_s, "rate_N_s": 400.0, "settle_N": 1.0}
    tables["step"] |= {"step_at_s": STEP_AT_s, "duration_s": TRIAL_s}
    return tables


def _toml(tables: dict[str, Any]) -> str:
    """TOML of nested tables, all of them inline."""
    return "".join(f"{key} = {_value(value)}\n" for key, value in tables.items())


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_value(one)}" for key, one in value.items()) + " }"
    return json.dumps(value)


class ServedRig:
    """A rig served by `estune serve-hardware`, and a client of it.

    Attributes:
        about: Its description at the start.
        log: File of what the rig has said.
    """

    def __init__(self, endpoint: str, process_id: int, log: Path) -> None:
        self.log = log
        self._endpoint, self._process_id = endpoint, process_id
        self._number = 0
        with zenoh.connect(endpoint, found_within_s=30.0) as rig:
            self.about: RigDescription = rig.describe()
        self._processes = self.processes()

    def processes(self) -> set[int]:
        """Processes of the rig: its own and that of its loop."""
        alive = {self._process_id}
        with suppress(OSError):
            for task in Path(f"/proc/{self._process_id}/task").iterdir():
                alive |= {int(word) for word in (task / "children").read_text().split()}
        running = (Path(f"/proc/{one}/stat") for one in alive)
        states = {int(stat.parent.name): stat.read_text() for stat in running if stat.exists()}
        return {one for one, text in states.items() if text.rpartition(")")[2].split()[0] != "Z"}

    def ended(self) -> int:
        """How many processes have ended since the last call."""
        before, self._processes = self._processes, self.processes()
        return len(before - self._processes)

    def request(self) -> TrialRequest:
        """A request for a new trial of the live gains."""
        self._number += 1
        step = replace(self.about.step, duration_s=TRIAL_s)
        return TrialRequest("device-faults", self._number, self.about.gains, step)

    def run(self, request: TrialRequest) -> Result:
        """The record of a trial, or why there is none."""
        try:
            with zenoh.connect(self._endpoint, found_within_s=30.0, patience_s=20.0) as rig:
                return rig.run(request)
        except EstuneError as error:
            return error

    def call(self, what: str, *words: str) -> str:
        """Calls a method of the rig; why it refused, or nothing."""
        try:
            with zenoh.connect(self._endpoint, found_within_s=30.0) as rig:
                getattr(rig, what)(*words)
        except EstuneError as error:
            return str(error)
        return ""

    def has_its_gains(self) -> bool:
        """Whether the live gains are those of the start."""
        with zenoh.connect(self._endpoint, found_within_s=30.0) as rig:
            return rig.describe().gains == self.about.gains


@contextmanager
def served_rig(kind: str, address: str, folder: Path) -> Iterator[ServedRig]:
    """The served rig for the duration of the block."""
    file, log = folder / "rig.toml", folder / "rig.log"
    file.write_text(_toml(rig_tables(kind, address)), "utf-8")
    words = ("estune", "serve-hardware", str(file), "--listen", with_port("tcp/127.0.0.1:0"))
    with log.open("w") as text, child_process(*words, stderr=text, end_within_s=10.0) as process:
        endpoint = next_line(process).rpartition(" ")[2]
        yield ServedRig(endpoint, process.pid, log)
        process.terminate()


class RunningTrial:
    """A trial that a thread asks for."""

    def __init__(self, rig: ServedRig) -> None:
        self.request = rig.request()
        self._results: list[Result] = []
        self._thread = threading.Thread(target=lambda: self._results.append(rig.run(self.request)))
        self._thread.start()

    def result(self) -> Result | None:
        """What it came to; None where nothing came."""
        self._thread.join(90.0)
        return self._results[0] if self._results else None


def is_done(result: Result | None) -> bool:
    """Whether a trial was run to its end."""
    return isinstance(result, TrialRecord) and result.outcome is Outcome.DONE


def reason_of(result: Result | None) -> str:
    """Why a trial was not run to its end."""
    return result.reason if isinstance(result, TrialRecord) else str(result or "")


def until(holds: Any, within_s: float) -> bool:
    """Whether a condition holds in time."""
    deadline_s = time.monotonic() + within_s
    while not holds():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(0.02)
    return True
