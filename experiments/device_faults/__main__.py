"""Does a misbehaving device end a rig, move it once it has latched, or lose one of its trials?

Command: `python -m experiments.device_faults`.
Target: no process ended, no motion after a latch, no trial lost or twice, gains restored in all.

`estune serve-hardware` serves an emulated reel behind a serial board on a pseudo-terminal, then
behind an ODrive and a gauge on CAN frames. Each of 25 faults of the device occurs at rest, on the
way to a trial, in a trial, and on the way to a stop. Then the trial is asked for again, and a new
one; a latched rig is watched and cleared, and a trial must run to its end.
"""

import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from estune.trial import TrialRecord
from experiments.device_faults.devices import FAULTY
from experiments.device_faults.process import DeviceProcess, device_process
from experiments.device_faults.rig import (
    RAMP_s,
    Result,
    RunningTrial,
    ServedRig,
    SETTLE_s,
    STEP_AT_s,
    TRIAL_s,
    is_done,
    reason_of,
    served_rig,
    until,
)
from experiments.results import Target, at_least, at_most, command_line, print_results

USABLE_WITHIN_s = 60.0
WATCHED_s = 0.6
"""Time for which a latched rig is watched: longer than its way to the safe state."""
LATCHED = "clear it"


class DeviceFault(NamedTuple):
    """A fault of a device, of so many messages or, for none, of so many seconds."""

    name: str
    messages: int = 0
    seconds: float = 0.3


_ONCE = {
    "serial": ("not a number", "short message", "wrong checksum", "duplicate", "out of order"),
    "can": ("not a number", "infinity", "short message", "wrong identifier"),
}
_SILENCES_s = (0.01, 1.0, 5.0)
_LONG = {"no heartbeats": 1.5, "unplugged": 1.0}
_MINUTE = DeviceFault("silence", seconds=60.0)
NONE = DeviceFault("none")


def faults(kind: str) -> list[DeviceFault]:
    """The 25 faults of a device."""
    lasting = [DeviceFault(name, 0, _LONG.get(name, 0.3)) for name in FAULTY[kind].faults]
    once = [DeviceFault(name, 1) for name in _ONCE[kind]]
    return [*lasting, *once, *(DeviceFault("silence", 0, seconds) for seconds in _SILENCES_s)]


@dataclass(frozen=True)
class FaultRun:
    """What a fault came to; what must not happen is True where it has.

    Attributes:
        ended: Processes that ended.
        moved: Whether the motor had a current once the rig had latched.
        lost: Whether a trial that was asked for came to nothing.
        twice: Whether the trial came to something else when it was asked for again.
        gains_wrong: Whether the live gains were not restored.
        untold: Whether the rig latched, or a trial was not done, without the device in the reason.
        unusable: Whether no trial was done in time after the clear.
        latched: Whether the rig latched by the fault.
        reason: What the rig said.
    """

    device: str
    fault: str
    moment: str
    ended: int
    moved: bool
    lost: bool
    twice: bool
    gains_wrong: bool
    untold: bool
    unusable: bool
    latched: bool
    reason: str


def at_rest(rig: ServedRig, device: DeviceProcess) -> RunningTrial | None:
    """Without power."""
    rig.call("estop", "to rest")
    until(lambda: not device.has_current(), 5.0)
    time.sleep(RAMP_s)
    rig.call("clear")
    return None


def in_motion(rig: ServedRig, device: DeviceProcess) -> RunningTrial | None:
    """On the way to a trial's preload."""
    at_rest(rig, device)
    trial = RunningTrial(rig)
    until(device.has_current, 5.0)
    time.sleep(0.5 * SETTLE_s)
    return trial


def in_trial(rig: ServedRig, device: DeviceProcess) -> RunningTrial | None:
    """At the step of a trial."""
    del device
    trial = RunningTrial(rig)
    time.sleep(SETTLE_s + STEP_AT_s + 0.3 * TRIAL_s)
    return trial


def stopping(rig: ServedRig, device: DeviceProcess) -> RunningTrial | None:
    """On the way to the safe state of an emergency stop."""
    del device
    rig.call("estop", "a hand in the cable")
    return None


Moment = Callable[[ServedRig, DeviceProcess], RunningTrial | None]
MOMENTS: dict[str, Moment] = {
    "idle": at_rest,
    "in motion": in_motion,
    "in a trial": in_trial,
    "while stopping": stopping,
}

_WORDS = {
    "serial": ("board", "gauge", "encoder", "commands", "tty", "time stamp"),
    "can": ("ODrive", "gauge", "CAN", "encoder", "torque", "time stamp"),
}
"""What a reason names that comes from the device."""


def run(
    kind: str, fault: DeviceFault, moment: str, rig: ServedRig, device: DeviceProcess
) -> FaultRun:
    """One fault at one moment."""
    trial = MOMENTS[moment](rig, device)
    device.begin(fault.name, fault.messages)
    time.sleep(fault.seconds)
    device.end()
    if moment == "while stopping":
        time.sleep(RAMP_s)
    result = trial.result() if trial else None
    again = rig.run(trial.request) if trial else None
    told = reason_of(result)
    next_result = rig.run(rig.request())
    latched = LATCHED in reason_of(next_result)
    moved = latched and _moves(device)
    gains_wrong = not rig.has_its_gains()
    told = told or (reason_of(next_result) if latched else "")
    by_device = any(word in told for word in _WORDS[kind])
    by_hand = moment == "while stopping" and "a hand in the cable" in told
    rig.call("clear")
    unusable = not until(lambda: _runs(rig), USABLE_WITHIN_s)
    return FaultRun(
        device=kind,
        fault=f"{fault.name}, {'once' if fault.messages else f'{fault.seconds:g} s'}",
        moment=moment,
        ended=rig.ended(),
        moved=moved,
        lost=trial is not None and result is None,
        twice=trial is not None and not _same(result, again),
        gains_wrong=gains_wrong,
        untold=bool(told) and not (by_device or by_hand),
        unusable=unusable,
        latched=latched and not by_hand,
        reason=told,
    )


def _moves(device: DeviceProcess) -> bool:
    """Whether the motor of a latched rig has a current, its ramp to the safe state apart."""
    until(lambda: not device.has_current(), RAMP_s)
    return until(device.has_current, WATCHED_s)


def _runs(rig: ServedRig) -> bool:
    result = rig.run(rig.request())
    if LATCHED in reason_of(result):
        rig.call("clear")
    return is_done(result)


def _same(first: Result | None, again: Result | None) -> bool:
    """Whether a trial that was asked for again is the one that was run, or still none."""
    if isinstance(first, TrialRecord):
        return isinstance(again, TrialRecord) and again.started_at == first.started_at
    return not isinstance(again, TrialRecord)


def campaign(kind: str, cases: list[tuple[DeviceFault, str]], folder: Path) -> list[FaultRun]:
    """The faults of one device."""
    runs = []
    with (
        device_process(kind, str(folder / "bus")) as device,
        served_rig(kind, device.address, folder) as rig,
    ):
        if not until(lambda: _runs(rig), USABLE_WITHIN_s):
            sys.exit(f"the rig behind {kind} does not run: {rig.log.read_text()[-1000:]}")
        rig.ended()
        for fault, moment in cases:
            runs.append(run(kind, fault, moment, rig, device))
            print(runs[-1], file=sys.stderr, flush=True)
    return runs


COUNTED = ("ended", "moved", "lost", "twice", "gains_wrong", "untold", "unusable")


def figures_of(runs: list[FaultRun]) -> dict[str, Any]:
    """Figures of runs."""
    counts = {name: sum(int(asdict(run)[name]) for run in runs) for name in COUNTED}
    latched = [run for run in runs if run.latched]
    by_moment = Counter(f"{run.device} {run.moment}" for run in latched)
    without = sum(run.fault.startswith(NONE.name) for run in latched)
    return {
        "runs": len(runs),
        **counts,
        "latched_without_a_fault": without,
        "latched": dict(sorted(by_moment.items())),
    }


def main() -> int:
    """Runs the campaigns; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="a fault of each moment")
    parser.add_argument("--device", choices=tuple(FAULTY), help="one device only")
    options = parser.parse_args()
    runs: list[FaultRun] = []
    for kind in [options.device] if options.device else FAULTY:
        cases = [*product([*faults(kind), NONE], MOMENTS), (_MINUTE, "in a trial")]
        if options.quick:
            cases = [(faults(kind)[3 * n], moment) for n, moment in enumerate(MOMENTS)]
        with tempfile.TemporaryDirectory(prefix="estune-devices-") as folder:
            runs += campaign(kind, cases, Path(folder))
    figures = figures_of(runs)
    targets: dict[str, Target] = {name: at_most(figures[name], 0) for name in COUNTED}
    if not options.quick and options.device is None:
        targets["runs"] = at_least(figures["runs"], 200)
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
