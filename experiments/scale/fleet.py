"""A daemon with many rigs: what it costs, how long all tune, and what an overload does to it.

The rigs are simulated reels in real time, in processes of their own behind a Zenoh router, all on
this machine. Each is tuned in trials of a second, 26 in the full form, and then held.
Programs that compute may run beside it while all tune: then the time until all is well after their
end is measured, too. In a process of its own, `python -m experiments.scale.fleet ROUTER NAME...`
serves rigs.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import plants
from estune.errors import EstuneError
from estune.remote import zenoh
from estune.remote.messages.daemon import DaemonStatus
from estune.remote.zenoh.daemon_service import DaemonClient
from estune.remote.zenoh.endpoints import with_port
from estune.support.child_process import child_process, next_line
from estune.trial import TrialRequest
from experiments.busy import busy

TUNER = "safe_bayesian"
"""The tuner; the default one computes 2.5 times as long for a trial."""

SEARCH_TRIALS, REPEATS = 16, 2
OTHER_TRIALS = 10
"""Trials of a tuning beside those of the search: baseline and confirmation."""

HOLD_S = 20.0
BUSY_S = 30.0
WITHIN_S = 400.0
RIGS_PER_PROCESS = 50
LIMITS = {
    "leases_lost": 0.0,
    "hold_leases_lost": 0.0,
    "slowness": 1.5,
    "status_s": 0.5,
    "rss_MB": 400.0,
    "hold_cores": 0.4,
}
_DAEMON = """
state = "state"
[service]
listen = "{listen}"
routers = ["{router}"]
"""
_RIG = f"""
[[rig]]
name = "{{name}}"
target = "{{router}}"
accept = "ask"
[rig.tuning]
tuner = "{{tuner}}"
trials = {{trials}}
repeats = {REPEATS}
tolerance = 0.0
"""
_CLOCK_Hz = os.sysconf("SC_CLK_TCK")


class Usage(NamedTuple):
    """Resources used by a process so far: CPU time, s; memory, MB; threads."""

    cpu_s: float
    rss_MB: float
    threads: int
    at_s: float


def usage(pid: int) -> Usage:
    """Usage of a process, by the kernel's own account."""
    fields = Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()
    pages = int(Path(f"/proc/{pid}/statm").read_text("utf-8").split()[1])
    threads = len(list(Path(f"/proc/{pid}/task").iterdir()))
    cpu_s = (int(fields[11]) + int(fields[12])) / _CLOCK_Hz
    return Usage(cpu_s, pages * 4096 / 1e6, threads, time.monotonic())


class Fleet(NamedTuple):
    """A daemon with rigs behind a router: ids of the processes, endpoint and log of the daemon."""

    daemon: int
    rigs: tuple[int, ...]
    router: int
    endpoint: str
    log: Path

    def leases_lost(self) -> int:
        """Number of leases that the daemon has lost so far."""
        return self.log.read_text("utf-8").count("no renewal arrived")


def _cpu_s(*pids: int) -> float:
    return sum(usage(pid).cpu_s for pid in pids)


class FleetCosts(NamedTuple):
    """Costs of a daemon with so many rigs; cores are CPU time over time.

    `limit` is the slowness at which rigs and router alone would take all cores: no daemon, were it
    free of cost, tunes them faster on this machine.
    """

    rigs: int
    all_tuned_s: float
    slowness: float
    limit: float
    daemon_ms_per_trial: float
    rigs_ms_per_trial: float
    router_ms_per_trial: float
    tune_cores: float
    hold_cores: float
    threads: int
    rss_MB: float
    status_s: float
    leases_lost: int
    hold_leases_lost: int
    recovered_s: float


def serve_rigs(router: str, names: list[str]) -> None:
    """Serves simulated reels in real time, until standard input is closed."""
    with ExitStack() as opened:
        for seed, name in enumerate(names):
            rig = plants.reference_reel().rig(name=name, seed=seed, pace=1.0)
            opened.enter_context(zenoh.serve(rig, routers=[router]))
        quick = plants.reference_reel().rig()
        quick.run(TrialRequest("compiled", 0, quick.describe().gains, quick.describe().step))
        print("serving", flush=True)
        sys.stdin.read()


@contextmanager
def started(*arguments: str, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A program of ours that has printed its first line; killed at the end."""
    with child_process(*arguments, **options) as process:
        next_line(process)
        yield process


@contextmanager
def fleet(rigs: int, tuner: str, folder: Path, trials: int) -> Iterator[Fleet]:
    """A daemon that begins to tune rigs behind a router."""
    names = [f"rig{number:03d}" for number in range(rigs)]
    router, listen = (with_port("tcp/127.0.0.1:0") for _ in range(2))
    tables = "".join(
        _RIG.format(name=name, router=router, tuner=tuner, trials=trials) for name in names
    )
    config = folder / "daemon.toml"
    config.write_text(_DAEMON.format(listen=listen, router=router) + tables, "utf-8")
    with ExitStack() as opened:
        routing = opened.enter_context(started("experiments.chaos.others", "router", router))
        quiet, some = {"stderr": subprocess.DEVNULL}, RIGS_PER_PROCESS
        served = [
            opened.enter_context(
                started("experiments.scale.fleet", router, *names[first:][:some], **quiet)
            )
            for first in range(0, rigs, some)
        ]
        log = opened.enter_context((folder / "log").open("w"))
        arguments = "estune", "daemon", str(config), "--log-format", "json"
        daemon = opened.enter_context(started(*arguments, stderr=log))
        ids = tuple(process.pid for process in served)
        yield Fleet(daemon.pid, ids, routing.pid, listen, folder / "log")


def measure(
    rigs: int,
    tuner: str = TUNER,
    hold_s: float = HOLD_S,
    *,
    busy: int = 0,
    trials: int = SEARCH_TRIALS,
) -> FleetCosts:
    """Tunes so many rigs with so many search trials, and holds them beside `busy` programs."""
    with (
        tempfile.TemporaryDirectory() as name,
        fleet(rigs, tuner, Path(name), trials) as found,
        DaemonClient(found.endpoint) as client,
    ):
        served_before = _cpu_s(*found.rigs), _cpu_s(found.router)
        before = usage(found.daemon)
        watch = _Watch(client, before.at_s)
        recovered_s = _disturb(watch, busy) if busy else 0.0
        watch.until(lambda statuses: all(s.mode in ("holding", "watching") for s in statuses))
        tuned, lost = usage(found.daemon), found.leases_lost()
        rigs_cpu_s = _cpu_s(*found.rigs) - served_before[0]
        router_cpu_s = _cpu_s(found.router) - served_before[1]
        watch.for_s(hold_s)
        held, all_lost = usage(found.daemon), found.leases_lost()
    tuned_s, held_s = tuned.at_s - before.at_s, held.at_s - tuned.at_s
    each = trials + OTHER_TRIALS  # of a second each
    ms_per_trial = 1e3 / (rigs * each)
    return FleetCosts(
        rigs=rigs,
        all_tuned_s=tuned_s,
        slowness=tuned_s / each,
        limit=max(1.0, (rigs_cpu_s + router_cpu_s) / (len(os.sched_getaffinity(0)) * each)),
        daemon_ms_per_trial=(tuned.cpu_s - before.cpu_s) * ms_per_trial,
        rigs_ms_per_trial=rigs_cpu_s * ms_per_trial,
        router_ms_per_trial=router_cpu_s * ms_per_trial,
        tune_cores=(tuned.cpu_s - before.cpu_s) / tuned_s,
        hold_cores=(held.cpu_s - tuned.cpu_s) / held_s,
        threads=tuned.threads,
        rss_MB=max(tuned.rss_MB, held.rss_MB),
        status_s=statistics.median(watch.times_s),
        leases_lost=all_lost,
        hold_leases_lost=all_lost - lost,
        recovered_s=recovered_s,
    )


class _Watch:
    """Asks for the status of all rigs each second, and measures how long the answer takes."""

    def __init__(self, client: DaemonClient, began_s: float) -> None:
        self.times_s: list[float] = []
        self._client = client
        self._ends_s = began_s + WITHIN_S

    def until(self, condition: Any) -> None:
        """Asks until the statuses meet a condition."""
        while not condition(statuses := self.statuses()):
            if time.monotonic() > self._ends_s:
                modes = sorted({f"{s.mode} ({s.trouble or s.sentence})" for s in statuses})
                raise EstuneError(f"not within {WITHIN_S:g} s: {'; '.join(modes)}")
            time.sleep(1.0)

    def for_s(self, seconds: float) -> None:
        """Asks for a time."""
        until_s = time.monotonic() + seconds
        self.until(lambda _: time.monotonic() > until_s)

    def statuses(self) -> list[DaemonStatus]:
        """Status of all rigs."""
        asked_s = time.monotonic()
        statuses = self._client.statuses()
        self.times_s.append(time.monotonic() - asked_s)
        return statuses


def _disturb(watch: _Watch, programs: int) -> float:
    """Lets programs compute for a while, and returns the time from their end to recovery, s."""
    watch.until(lambda statuses: all(s.mode == "tuning" for s in statuses))
    with busy(programs):
        watch.for_s(BUSY_S)
    ended_s = time.monotonic()
    watch.until(lambda statuses: not any(s.trouble or s.paused for s in statuses))
    return time.monotonic() - ended_s


if __name__ == "__main__":
    serve_rigs(sys.argv[1], sys.argv[2:])
