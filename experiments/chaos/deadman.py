"""Time until a reel is safe after the loss of its client.

The emulated hardware runs in its own process and in wall-clock time, its real-time loop in a
second, the rig's server in a third. A client in a fourth runs one long trial, with gains other
than the reel's own. During the trial the client is killed or frozen. Measured is the time until
the rig has ended the trial and runs its own gains again, by its log; and, from outside, until the
tension of the reel itself has left the level of the trial.

    python -m experiments.chaos.deadman rig|client ...
"""

import contextlib
import itertools
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from estune.hardware import HardwareRig, RigConfig
from estune.hardware.config import config_from
from estune.remote import zenoh
from estune.remote.zenoh.endpoints import with_port
from estune.trial import TrialRequest
from experiments.chaos.faults import LEASE_S
from experiments.chaos.motions import Log, LoggedMotion, LoggedRig
from experiments.chaos.processes import end, ready, started
from plants.emulator import RIG_FILE, EmulatedDriver
from plants.emulator.driver import emulated_hardware

LIMIT_S = LEASE_S + 0.1
LONG_S = 8.0
STEP_N = 10.0
LEFT_N = 1.0
"""Fall of the tension by which the reel has left the level of the trial."""

_WITHIN_S = 30.0


class Escape(NamedTuple):
    """Times from the loss of a client until the gains are restored, and the reel's level left."""

    restored_s: float
    left_s: float
    restored: bool


def configuration(address: str) -> RigConfig:
    """The emulated rig with a long trial; lateness on a busy machine does not stop it."""
    tables = tomllib.loads(RIG_FILE.read_text(encoding="utf-8"))
    tables["driver"]["settings"] = {"address": address}
    tables["guard"] |= {"late_in_a_row": 1_000_000, "gap_s": 10.0}
    tables["step"] |= {"duration_s": LONG_S, "step_N": STEP_N}
    tables["motion"] |= {"rate_N_s": 400.0, "settle_s": 0.02, "settle_N": 1.0}
    return config_from(tables, str(RIG_FILE))


def serve(endpoint: str, address: str, ledger: str) -> None:
    """Serves the hardware rig, and logs its motions."""
    with HardwareRig(configuration(address)) as hardware:
        rig = LoggedRig(hardware)
        with zenoh.serve(rig, endpoint, ledger=Path(ledger)) as server:
            rig.boot()
            server.wait()


def run_trial(endpoint: str, run: str) -> None:
    """Runs one long trial, with gains other than the rig's own."""
    with zenoh.connect(endpoint) as rig:
        about = rig.describe()
        gains = replace(about.gains, P=1.2 * about.gains.P)
        rig.run(TrialRequest(run, 0, gains, about.step))


@contextlib.contextmanager
def _process(folder: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    process = started("deadman", *arguments, errors=folder / "deadman.err")
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGCONT)
        end(process)


def escapes(folder: Path, signals: Sequence[int], times: int) -> dict[int, list[Escape]]:
    """Loses a number of clients by each signal, each during a trial."""
    endpoint, log = with_port("tcp/127.0.0.1:0"), Log()
    found: dict[int, list[Escape]] = {number: [] for number in signals}
    with (
        emulated_hardware({"electronics": {"watchdog_s": 1.0}}) as address,
        EmulatedDriver(address) as driver,
        _process(folder, "rig", endpoint, address, str(folder / "ledger")) as rig,
    ):
        if rig.stdout is None:
            raise AssertionError
        log.follow(rig.stdout)
        _await(log, "boot", "")
        for number, n in itertools.product(signals, range(times)):
            name = f"signal{number}run{n}"
            with _process(folder, "client", endpoint, name) as client:
                begun = _await(log, "begin", name)
                level_N = await_level(driver)
                time.sleep(0.2 * n / max(times - 1, 1))  # spread over the renewal interval
                lost_s = time.monotonic()
                client.send_signal(number)
                left_s = time_below(driver, level_N - LEFT_N) - lost_s
                ended = _await(log, "end", name)
                found[number].append(Escape(ended.at_s - lost_s, left_s, ended.live == begun.live))
        end(rig, signal.SIGINT)
    return found


def await_level(driver: EmulatedDriver) -> float:
    """Waits until the reel has followed the step; its tension then, N."""
    reached_N = 15.0 + 0.95 * STEP_N
    until_s = time.monotonic() + _WITHIN_S
    while (tension := driver.truth().tension_N) < reached_N:
        if time.monotonic() > until_s:
            sys.exit(f"the reel has not followed the step: {tension:.1f} N")
        time.sleep(0.002)
    time.sleep(0.3)
    return float(driver.truth().tension_N)


def time_below(driver: EmulatedDriver, level_N: float) -> float:
    """Monotonic time at which the reel's own tension has fallen below a level, s."""
    until_s = time.monotonic() + _WITHIN_S
    while driver.truth().tension_N > level_N:
        if time.monotonic() > until_s:
            return float("inf")
        time.sleep(0.001)
    return time.monotonic()


def _await(log: Log, what: str, trial_id: str) -> LoggedMotion:
    def matching(motions: tuple[LoggedMotion, ...]) -> list[LoggedMotion]:
        return [m for m in motions if m.what == what and m.trial_id.startswith(trial_id)]

    if not log.wait(lambda motions: bool(matching(motions)), _WITHIN_S):
        sys.exit(f"the rig has not logged {what!r} of {trial_id!r} within {_WITHIN_S:g} s")
    return matching(log.motions())[0]


if __name__ == "__main__":
    ready()
    with contextlib.suppress(KeyboardInterrupt):
        (serve if sys.argv[1] == "rig" else run_trial)(*sys.argv[2:])
