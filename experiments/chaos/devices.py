"""Is a rig usable again without a hand after every fault of its serial board or CAN bus?

Command: `python -m experiments.chaos.devices`.
Target: no gains left wrong, and after every fault a trial that is done, without a clear.

`estune serve-hardware` serves an emulated reel behind a serial board, then behind an ODrive and a
gauge on CAN, and is started anew when it ends, as by its systemd unit. In each trial one fault of
the device occurs. Then the live gains are read and another trial is asked for: where the rig has
latched, which asks for a person's look at the sensor, the stop is cleared and counted.
"""

import random
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections import Counter
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from estune.errors import EstuneError, RigError
from estune.remote import zenoh
from estune.remote.zenoh.endpoints import with_port
from estune.support.child_process import child_process, next_line
from estune.trial import Outcome, TrialRecord, TrialRequest
from experiments.chaos.faulty_devices import KINDS
from experiments.results import Target, at_most, command_line, print_results
from plants.emulator import RIG_FILE
from plants.emulator.devices import GAUGE, CanDevices

USABLE_WITHIN_S = 60.0
_OWN_DRIVER = "[driver]"
_PATIENT = "answer_within_s = 0.05"
"""Of the drivers: the devices are programs on a machine that may be busy."""

_BUSY = {"gap_s = 0.015": "gap_s = 0.2", "late_in_a_row = 10": "late_in_a_row = 1000"}
"""Limits of the guard for the lateness of such a machine, as in the tests of hardware."""


def rig_file(kind: str, address: str) -> str:
    """The file of the emulated rig, with its device in place of the emulator's own."""
    if kind == "serial":
        table = f'use = "serial-board"\nsettings = {{ port = "{address}", {_PATIENT} }}\n'
    else:
        drive = (
            f'interface = "{address}", newton_metres_per_count = '
            f"{CanDevices.newton_metres_per_count}, "
            f"counts_per_turn = {CanDevices.counts_per_turn}, {_PATIENT}"
        )
        gauge = f'interface = "{address}", identifier = {GAUGE}, {_PATIENT}'
        table = (
            f'use = "odrive"\nsettings = {{ {drive} }}\n[driver.gauge]\n'
            f'use = "can-gauge"\nsettings = {{ {gauge} }}\n'
        )
    before, _, rest = RIG_FILE.read_text("utf-8").partition(_OWN_DRIVER)
    text = f"{before}{_OWN_DRIVER}\n{table}\n[{rest.partition(chr(10) + '[')[2]}"
    for usual, patient in _BUSY.items():
        text = text.replace(f"\n{usual}", f"\n{patient}")
    guard = tomllib.loads(text)["guard"]
    assert (guard["gap_s"], guard["late_in_a_row"]) == (0.2, 1000)  # noqa: S101  they were replaced
    return text


class RestartedRig:
    """`estune serve-hardware`, started anew whenever it ends.

    Attributes:
        starts: How often it was started.
    """

    def __init__(self, file: Path, endpoint: str) -> None:
        self.starts = 0
        self._command = ["serve-hardware", str(file), "--listen", endpoint]
        self._ended = threading.Event()
        self._log = file.with_suffix(".log").open("a", encoding="utf-8")
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.is_set():
            self.starts += 1
            with child_process("estune", *self._command, stderr=self._log) as process:
                while process.poll() is None and not self._ended.wait(0.1):
                    pass
                process.terminate()
                with suppress(subprocess.TimeoutExpired):
                    process.wait(10.0)

    def end(self) -> None:
        """Ends it for good."""
        self._ended.set()
        self._thread.join()
        self._log.close()


class PersistentClient:
    """Trials of a client that connects again after every error.

    Attributes:
        last: What the last trial of `until_done` came to.
    """

    def __init__(self, endpoint: str) -> None:
        self.endpoint = endpoint
        self.last: TrialRecord | EstuneError | None = None
        self._number = 0

    def run(self) -> TrialRecord | EstuneError:
        """The record of a new trial of the live gains, or why there is none."""
        self._number += 1
        try:
            with zenoh.connect(self.endpoint, found_within_s=30.0, patience_s=10.0) as rig:
                about = rig.describe()
                return rig.run(TrialRequest("devices", self._number, about.gains, about.step))
        except EstuneError as error:
            return error

    def until_done(self) -> tuple[bool, int]:
        """Whether a trial is done in time, and how often a latched stop was cleared for it."""
        cleared, ends_s = 0, time.monotonic() + USABLE_WITHIN_S
        while time.monotonic() < ends_s:
            result = self.last = self.run()
            if isinstance(result, TrialRecord) and result.outcome is Outcome.DONE:
                return True, cleared
            if "clear it" in str(result):
                cleared += 1
                with suppress(EstuneError), zenoh.connect(self.endpoint) as rig:
                    rig.clear()
            time.sleep(0.2)
        return False, cleared


def campaign(kind: str, count: int, seed: int, folder: Path) -> dict[str, Any]:
    """Figures of one kind of device."""
    rng = random.Random(seed)  # noqa: S311  for faults
    names = [name for _ in range(-(-count // len(KINDS[kind]))) for name in KINDS[kind]][:count]
    rng.shuffle(names)
    outcomes: Counter[str] = Counter()
    wrong = unusable = 0
    cleared: Counter[str] = Counter()
    with ExitStack() as opened:
        words = ("experiments.chaos.faulty_devices", kind, str(folder / "bus"))
        device = opened.enter_context(child_process(*words))
        file = folder / "rig.toml"
        file.write_text(rig_file(kind, next_line(device)), "utf-8")
        endpoint = with_port("tcp/127.0.0.1:0")
        service = RestartedRig(file, endpoint)
        opened.callback(service.end)
        trials = PersistentClient(endpoint)
        if not trials.until_done()[0]:
            said = file.with_suffix(".log").read_text("utf-8")[-1000:]
            raise RigError(f"the rig behind {kind} does not run: {trials.last}; its log: {said}")
        with zenoh.connect(endpoint) as rig:
            gains = rig.describe().gains
        first = service.starts
        for name in names:
            results: list[TrialRecord | EstuneError] = []
            thread = threading.Thread(target=lambda found=results: found.append(trials.run()))
            thread.start()
            time.sleep(rng.uniform(0.5, 1.2))
            assert device.stdin is not None  # noqa: S101  a pipe
            device.stdin.write(f"{name}\n")
            device.stdin.flush()
            thread.join()
            result = results[0]
            outcomes[result.outcome.value if isinstance(result, TrialRecord) else "error"] += 1
            done, clears = trials.until_done()
            unusable += not done
            cleared[name] += clears > 0
            with zenoh.connect(endpoint, found_within_s=30.0) as rig:
                wrong += rig.describe().gains != gains
            print(f"{kind}: {name}: {outcomes}", file=sys.stderr, flush=True)
        return {
            "faults": len(names),
            "gains_wrong": wrong,
            "unusable": unusable,
            "restarts": service.starts - first,
            "cleared_by_hand": sum(cleared.values()),
            "cleared_after": {name: n for name, n in sorted(cleared.items()) if n},
            "outcomes": dict(sorted(outcomes.items())),
        }


def main() -> int:
    """Runs the campaigns; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="each fault once")
    parser.add_argument("--faults", type=int, default=30, help="of each kind of device")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    count = len(KINDS["can"]) if options.quick else options.faults
    figures: dict[str, Any] = {}
    for kind in KINDS:
        with tempfile.TemporaryDirectory(prefix="estune-devices-") as folder:
            figures[kind] = campaign(kind, count, options.seed, Path(folder))
    targets: dict[str, Target] = {
        f"{kind}_{name}": at_most(figures[kind][name], 0)
        for kind in KINDS
        for name in ("gains_wrong", "unusable", "cleared_by_hand")
    }
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
