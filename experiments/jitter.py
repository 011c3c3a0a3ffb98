"""How well does the real-time loop keep its time, and how soon is a reel safe?

Command: `python -m experiments.jitter`.
Target: current off 100 ms after the lease of a killed or frozen supervisor has ended.

The loop holds the emulated reel at 632 Hz, first on an otherwise idle machine, then with every
other core busy. Two times of each sample are counted from its instant: to its beginning, and to
the current command, within which the guard acts. Then the rig is stopped by hand, and the program
that supervises it is killed and frozen; the time until the hardware loses its current is measured.
At last the reel is held through the drivers of the serial board and of the ODrive with a gauge.
"""

import argparse
import os
import signal
import statistics
import sys
import time
import tomllib
from typing import Any, NamedTuple

from estune.hardware import HardwareRig, RigConfig
from estune.hardware.config import config_from
from estune.hardware.shared_memory import BIN_s, Timing, quantile_s
from estune.support.child_process import child_process, next_line
from estune.trial import TrialRequest
from experiments.busy import busy
from experiments.results import Target, at_most, command_line, print_results
from plants.emulator import RIG_FILE, EmulatedDriver
from plants.emulator.devices import GAUGE, CanDevices
from plants.emulator.driver import emulated_hardware

SHARES = (0.5, 0.99, 0.999, 0.9999)
LEASE_ms = 1000.0
SAFE_WITHIN_ms = LEASE_ms + 100.0
_GIVE_UP_s = 20.0


DEVICES = {
    "packets": lambda address: {
        "use": "plants.emulator:EmulatedDriver",
        "settings": {"address": address},
    },
    "serial": lambda address: {
        "use": "serial-board",
        "settings": {"port": address, "answer_within_s": ANSWER_s},
    },
    "can": lambda address: {
        "use": "odrive",
        "settings": {
            "interface": address,
            "newton_metres_per_count": CanDevices.newton_metres_per_count,
            "counts_per_turn": CanDevices.counts_per_turn,
            "answer_within_s": ANSWER_s,
            "write_within_s": 10.0,
        },
        "gauge": {
            "use": "can-gauge",
            "settings": {
                "interface": address,
                "identifier": GAUGE,
                "answer_within_s": ANSWER_s,
            },
        },
    },
}
"""Table [driver] of the emulated reel at an address, by the device that it is behind."""
ANSWER_s = 1.0
"""Patience with the emulated devices: on a busy machine they wait for their turn, too."""


def configuration(address: str, device: str = "packets") -> RigConfig:
    """The emulated rig at an address; late samples are counted, but do not stop it."""
    tables = tomllib.loads(RIG_FILE.read_text(encoding="utf-8"))
    tables["driver"] = DEVICES[device](address)
    tables["guard"] |= {"late_in_a_row": 1_000_000, "gap_s": 10.0}
    tables["safe"] |= {"state": "ramp", "ramp_s": 0.0}
    tables["step"] |= {"duration_s": 0.35}  # a trial only serves to hold the reel
    tables["motion"] |= {"rate_N_s": 400.0, "settle_s": 0.0, "settle_N": 5.0}
    return config_from(tables, str(RIG_FILE))


class LoopCondition(NamedTuple):
    """Timing of the loop under one load."""

    name: str
    timing: Timing
    seconds: float

    def figures(self) -> dict[str, float]:
        """Figures by name."""
        period_us = 1e6 / 632.0
        made: dict[str, float] = {
            "samples": self.timing.samples,
            "late": self.timing.late,
            "missed": self.timing.missed,
            "held_Hz": self.timing.samples / self.seconds,
        }
        for what in ("lateness", "turnaround"):
            counts = getattr(self.timing, what)
            for share in SHARES:
                made[f"{what}_{100 * share:g}_us"] = 1e6 * quantile_s(counts, share)
            made[f"{what}_max_us"] = 1e6 * quantile_s(counts, 1.0)
        counts = self.timing.turnaround
        within = counts[: int(period_us / (1e6 * BIN_s))].sum()
        made["commanded_within_period"] = float(within / counts.sum())
        return {f"{self.name}_{key}": value for key, value in made.items()}


def drivers(seconds: float) -> list[LoopCondition]:
    """Timing of the loop with each driver on an otherwise idle machine."""
    found = []
    for device in ("serial", "can"):
        settings = {"electronics": {"watchdog_s": 1.0}, "device": device}
        with (
            emulated_hardware(settings) as address,
            HardwareRig(configuration(address, device)) as rig,
        ):
            hold(rig)
            found.append(LoopCondition(device, *observe(rig, seconds)))
    return found


def observe(rig: HardwareRig, seconds: float) -> tuple[Timing, float]:
    """Timing of the loop over so many seconds, and their exact number."""
    before, began_s = rig.timing(), time.monotonic()
    time.sleep(seconds)
    return rig.timing().since(before), time.monotonic() - began_s


def hold(rig: HardwareRig, number: int = 0) -> None:
    """Brings the reel under control, by a trial."""
    description = rig.describe()
    rig.run(TrialRequest("jitter", number, description.gains, description.step))


def until_dead_ms(driver: EmulatedDriver, began_s: float) -> float:
    """Time from then until the hardware has no current, ms."""
    while driver.truth().current_A != 0.0:
        if time.monotonic() - began_s > _GIVE_UP_s:
            sys.exit("the reel has not lost its current")
        time.sleep(2e-4)
    return 1e3 * (time.monotonic() - began_s)


def stopped_by_hand_ms(rig: HardwareRig, driver: EmulatedDriver, times: int) -> list[float]:
    """Times from an emergency stop to the loss of the hardware's current, ms."""
    times_ms = []
    for number in range(1, times + 1):
        hold(rig, number)
        began = time.monotonic()
        rig.estop("measurement of its delay")
        times_ms.append(until_dead_ms(driver, began))
        rig.clear()
    return times_ms


def supervisor_lost_ms(address: str, driver: EmulatedDriver, number: int) -> float:
    """Time from a signal to the supervising program to the loss of the current, ms."""
    with child_process("experiments.jitter", "--supervise", address) as process:
        next_line(process)
        process.send_signal(number)
        return until_dead_ms(driver, time.monotonic())


def supervise(address: str) -> None:
    """Holds the reel until standard input is closed."""
    with HardwareRig(configuration(address)) as rig:
        hold(rig)
        print("held", flush=True)
        sys.stdin.read()


def measure(seconds: float, times: int) -> tuple[list[LoopCondition], dict[str, Any]]:
    """Measures everything; the timing of the loop by load, and the other figures."""
    others = len(os.sched_getaffinity(0)) - 1
    with (
        emulated_hardware({"electronics": {"watchdog_s": 1.0}}) as address,
        EmulatedDriver(address) as driver,
    ):
        with HardwareRig(configuration(address)) as rig:
            hold(rig)
            conditions = [LoopCondition("idle", *observe(rig, seconds))]
            with busy(others):
                conditions.append(LoopCondition("loaded", *observe(rig, seconds)))
            stops = stopped_by_hand_ms(rig, driver, times)
        repeats = range(max(times // 5, 1))
        killed, frozen = (
            max(supervisor_lost_ms(address, driver, number) for _ in repeats)
            for number in (signal.SIGKILL, signal.SIGSTOP)
        )
    conditions += drivers(seconds)
    figures: dict[str, Any] = {
        "seconds": seconds,
        "busy_cores": others,
        "not_granted": list(rig.notes),
        "estop_median_ms": statistics.median(stops),
        "estop_max_ms": max(stops),
        "supervisor_killed_max_ms": killed,
        "supervisor_frozen_max_ms": frozen,
    }
    return conditions, figures


def targets(figures: dict[str, Any]) -> dict[str, Target]:
    """Targets of the experiment."""
    return {
        name: at_most(figures[name], SAFE_WITHIN_ms)
        for name in ("supervisor_killed_max_ms", "supervisor_frozen_max_ms")
    }


def main() -> int:
    """Measures, and prints the tables or, with --json, the figures; the exit code."""
    parser = command_line(__doc__, quick="2 s for each load")
    parser.add_argument("--seconds", type=float, default=600.0, help="for each load")
    parser.add_argument("--supervise", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.supervise:
        supervise(arguments.supervise)
        return 0
    seconds, times = (2.0, 3) if arguments.quick else (arguments.seconds, 50)
    conditions, figures = measure(seconds, times)
    for condition in conditions:
        figures |= condition.figures()
    return print_results(figures, targets(figures), as_json=arguments.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
