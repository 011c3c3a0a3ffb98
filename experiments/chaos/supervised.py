"""The daemon under faults: killed, frozen, stopped, disconnected from its rig, its disk full.

A daemon process (`estune daemon`) tunes the stand's rig over a wire, repeatedly: its candidates
are accepted or rejected, checked for a while, and reverted. Violations are counted from the rig's
own log, from the daemon's store and from its journals.
"""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from random import Random
from typing import Any

from estune.core.gains import GAIN_NAMES, Gains
from estune.daemon.store import RUNS, DaemonStore
from estune.daemon.supervisor_state import SupervisorMode
from estune.errors import EstuneError
from estune.remote.messages.daemon import DaemonStatus
from estune.remote.zenoh.daemon_service import DaemonClient
from estune.remote.zenoh.endpoints import with_port
from estune.run import loop
from estune.run.journal import Journal
from estune.run.planning import description_from_json, plan_from_json
from experiments.chaos.faults import Durations, Fault, disk_full, frozen, schedule, stalled
from experiments.chaos.processes import NO_THREADS, end
from experiments.chaos.rig import reference_rig
from experiments.chaos.stand import NAME, Stand

STUCK_S = 60.0
CHECKS = 4
PAUSES_TRIALS = (0, 1, 3, 8, 20)
NONE = (*("run_twice", "other_gains", "other_proposals", "stuck", "died", "not_home"),)
"""Counts that must be zero."""

CONFIG = """
stop_within_s = 10.0
[service]
listen = "{listen}"
[[rig]]
name = "{name}"
target = "{target}"
accept = "ask"
answer_within_s = 1.0
look_every_s = 0.2
retry_first_s = 0.1
retry_max_s = 0.5
tuning = {{trials = 20, repeats = 3}}
watch = {{every_s = 0.05, baseline_checks = 3, rest_s = 0.0}}
"""


class DaemonFault(StrEnum):
    """Kind of a fault of the daemon."""

    KILL = "daemon killed"
    FREEZE = "daemon frozen"
    END = "daemon stopped properly"
    CUT = "connections cut"
    HANG = "the network hangs"
    DISK = "the daemon's disk is full"
    RIG = "rig killed"


@dataclass
class DaemonDiary:
    """Course of a campaign, counted as in `count_violations`; faults by kind."""

    faults: Counter[str] = field(default_factory=Counter)
    stuck: int = 0
    died: int = 0
    not_home: int = 0


class SupervisedStand:
    """A daemon on a stand, restarted whenever it has ended."""

    def __init__(self, stand: Stand, seed: int) -> None:
        self.diary = DaemonDiary()
        self.state = stand.folder / "estune-state"
        self._stand = stand
        self._random = Random(seed)  # noqa: S311  for decisions, not for secrets
        self._endpoint = with_port("tcp/127.0.0.1:0")
        self._file = stand.folder / "daemon.toml"
        target = stand.near.endpoint
        text = CONFIG.format(listen=self._endpoint, name=NAME, target=target)
        self._file.write_text(text, encoding="utf-8")
        self._checks = 0
        self._process = self._started()

    def _started(self) -> subprocess.Popen[bytes]:
        with (self._stand.folder / "daemon.err").open("ab") as errors:
            return subprocess.Popen(  # noqa: S603  our own interpreter and module
                [sys.executable, "-m", "estune", "daemon", str(self._file)],
                stdout=subprocess.DEVNULL,
                stderr=errors,
                env=os.environ | NO_THREADS,
            )

    def await_trials(self, count: int) -> None:
        """Waits for a number of trials, and answers the daemon's requests meanwhile."""
        log = self._stand.log
        seen, seen_s = log.count("end"), time.monotonic()
        enough = seen + count
        while (now := log.count("end")) < enough or self._process.poll() is not None:
            if self._process.poll() is not None:
                self.diary.died += 1
                self._process = self._started()
            if now != seen:
                seen, seen_s = now, time.monotonic()
            elif time.monotonic() - seen_s > STUCK_S:
                self.diary.stuck += 1
                return
            # Unreachable just now, or the disk is full: tried again.
            with contextlib.suppress(EstuneError):
                self._decide()
            time.sleep(0.02)

    def _decide(self) -> None:
        with DaemonClient(self._endpoint, timeout_s=1.0) as client:
            verb = self._verb(client.status(NAME))
            if verb:
                client.command(NAME, verb, "chaos")

    def _verb(self, status: DaemonStatus) -> Any:
        """Command of an operator who wants the daemon to tune repeatedly."""
        match status.mode:
            case SupervisorMode.PAUSED:
                return "resume"
            case SupervisorMode.HOLDING:
                return self._random.choice(("accept", "reject"))
            case SupervisorMode.WATCHING if status.checks >= self._checks + CHECKS:
                self._checks = status.checks
                return "revert"
        return ""

    def cause(self, fault: Fault) -> None:
        """Causes a fault."""
        self.diary.faults[fault.kind] += 1
        process, wires = self._process, [self._stand.near]
        match fault.kind:
            case DaemonFault.KILL:
                end(process, signal.SIGKILL)
                time.sleep(fault.lasts_s)
                self._process = self._started()
            case DaemonFault.END:
                self.stop()
                self._process = self._started()
            case DaemonFault.CUT:
                wires[0].cut()
            case DaemonFault.RIG:
                end(self._stand.rig, signal.SIGKILL)
                time.sleep(fault.lasts_s)
                self._stand.restart()
            case DaemonFault.FREEZE | DaemonFault.HANG | DaemonFault.DISK:
                lasting: dict[str, Callable[[], contextlib.AbstractContextManager[None]]] = {
                    DaemonFault.FREEZE: lambda: frozen(process),
                    DaemonFault.HANG: lambda: stalled(wires, "both"),
                    DaemonFault.DISK: lambda: disk_full(process),
                }
                with lasting[fault.kind]():
                    time.sleep(fault.lasts_s)

    def stop(self) -> None:
        """Ends the daemon properly, and checks the live gains."""
        code = end(self._process, signal.SIGTERM)
        with contextlib.closing(DaemonStore.open(self.state / NAME, NAME)) as store:
            nominal = store.gains().get(store.state.home)
        live = self._stand.log.motions()[-1].live
        # It may end before it has reached the rig.
        self.diary.not_home += code == 0 and nominal is not None and live != nominal.as_tuple()

    def close(self) -> None:
        """Kills the daemon."""
        end(self._process)


def runs(state: Path) -> Iterator[Journal]:
    """The journals of the daemon's tunings."""
    for folder in sorted((state / NAME / RUNS).iterdir()):
        with Journal.open(folder) as journal:
            yield journal


def count_violations(stand: Stand, daemon: SupervisedStand) -> dict[str, Any]:
    """Counts by name, once no process runs any more.

    Trials reported to the daemon, motions: trials started on the rig, tunings started, gains
    accepted; trials interrupted, and reported as such, trials started more than once, times gains
    were live that were neither the rig's own nor accepted, proposals that differ from the
    undisturbed run; times no trial ran without a fault, times the daemon ended by itself, proper
    ends without the nominal gains on the rig.
    """
    motions = stand.log.motions()
    begun = Counter(motion.trial_id for motion in motions if motion.what == "begin")
    with contextlib.closing(DaemonStore.open(daemon.state / NAME, NAME)) as store:
        history, checks = store.gain_history(-1), store.checks(-1)
    agreed = {
        tuple(row[name] for name in GAIN_NAMES)
        for row in history
        if row["name"] in ("original", "accepted")
    }
    other = finished = interrupted = tunings = 0
    for journal in runs(daemon.state):
        outcomes = [(entry, entry.outcome) for entry in journal.entries()]
        entries = [(entry, outcome) for entry, outcome in outcomes if outcome is not None]
        actual = {e.number: (e.gains, e.cost) for e, outcome in entries if not outcome.is_void}
        expected = undisturbed(journal)
        tunings += 1
        finished += len(entries)
        interrupted += len(entries) - len(actual)
        other += sum(expected.get(number) != result for number, result in actual.items())
    diary = daemon.diary
    return {
        "faults": sum(diary.faults.values()),
        "faults_by_kind": dict(sorted(diary.faults.items())),
        "trials": finished + len(checks),
        "motions": sum(begun.values()),
        "tunings": tunings,
        "accepted": sum(row["name"] == "accepted" for row in history),
        "interrupted": interrupted,
        "run_twice": sum(times > 1 for times in begun.values()),
        "other_gains": sum(motion.live not in agreed for motion in motions),
        "other_proposals": other,
        "stuck": diary.stuck,
        "died": diary.died,
        "not_home": diary.not_home,
    }


def undisturbed(journal: Journal) -> dict[int, tuple[Gains, float]]:
    """The same tuning without faults."""
    plan = plan_from_json(journal.fact("plan"))
    run = loop.start(plan, description_from_json(journal.fact("rig")), None)
    loop.run(run, reference_rig(NAME))
    return {entry.number: (entry.gains, entry.cost) for entry in run.entries}


def run_campaign(
    count: int, seed: int, pace: float, folder: Path, durations: Durations
) -> dict[str, Any]:
    """Figures of one campaign."""
    with Stand(folder, pace) as stand:
        daemon = SupervisedStand(stand, seed)
        try:
            daemon.await_trials(1)
            for fault in schedule(list(DaemonFault), PAUSES_TRIALS, count, seed, durations):
                daemon.await_trials(fault.after_trials)
                time.sleep(fault.delay_s)
                daemon.cause(fault)
            daemon.await_trials(1)
            daemon.stop()
        finally:
            daemon.close()
        return count_violations(stand, daemon)
