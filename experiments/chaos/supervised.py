"""The daemon between faults: killed, frozen, stopped, cut off from its rig, its disk full.

A daemon process (`estune daemon`) tunes the stand's rig over a wire, again and again: what it
finds is accepted or rejected, checked for a while, and reverted. What is promised is counted from
the rig's own log, from the daemon's store and from its journals.
"""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

from estune.core.gains import GAIN_NAMES, Gains
from estune.daemon.store import RUNS, DaemonStore
from estune.daemon.supervisor_state import SupervisorMode
from estune.errors import EstuneError
from estune.remote.messages.daemon import DaemonStatus
from estune.remote.zenoh.daemon_service import DaemonClient
from estune.remote.zenoh.zenoh_session import with_port
from estune.run import loop
from estune.run.journal import Journal
from estune.run.plan import description_from_json, plan_from_json
from experiments.chaos.faults import DURATIONS_S, disk_full, frozen, stalled
from experiments.chaos.processes import NO_THREADS, end
from experiments.chaos.rig import truth
from experiments.chaos.stand import NAME, Stand

STUCK_S = 60.0
CHECKS = 4
NONE = (*("run_twice", "other_gains", "other_proposals", "stuck", "died", "not_home"),)
"""What must not happen at all."""

WORDS = {
    "faults": "faults",
    "trials": "trials told to the daemon",
    "motions": "trials begun on the rig",
    "tunings": "tunings begun",
    "accepted": "gains accepted",
    "interrupted": "trials cut short, and told to be",
    "run_twice": "trials begun more than once",
    "other_gains": "times gains were live that were neither the rig's own nor accepted",
    "other_proposals": "proposals other than those of an undisturbed run",
    "stuck": "times nothing went on though nothing was wrong",
    "died": "times the daemon ended by itself",
    "not_home": "ends in good order without the home gains on the rig",
}

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


class Blow(StrEnum):
    """What can befall a daemon."""

    KILL = "daemon killed"
    FREEZE = "daemon frozen"
    END = "daemon stopped in good order"
    CUT = "connections cut"
    HANG = "the network hangs"
    DISK = "the daemon's disk is full"
    RIG = "rig killed"


class Fault(NamedTuple):
    """One of them, for how long, after how many more trials, and how long after the last."""

    blow: Blow
    lasts_s: float
    after_trials: int
    delay_s: float


@dataclass
class Told:
    """What came of it while it lasted.

    Attributes:
        faults: How many of each kind.
        stuck: How often nothing went on though nothing was wrong.
        died: How often the daemon ended by itself.
        not_home: How often it ended in good order with other gains live than the home ones.
    """

    faults: Counter[str] = field(default_factory=Counter)
    stuck: int = 0
    died: int = 0
    not_home: int = 0


def schedule(count: int, seed: int) -> list[Fault]:
    """So many faults, each kind as often as any other, in an order drawn at random."""
    random = Random(seed)  # noqa: S311  for faults, not for secrets
    blows = [blow for _ in range(-(-count // len(Blow))) for blow in Blow]
    random.shuffle(blows)
    return [
        Fault(
            *(blow, random.choice(DURATIONS_S)),
            *(random.choice((0, 1, 3, 8, 20)), random.uniform(0.0, 0.1)),
        )
        for blow in blows[:count]
    ]


class Supervised:
    """A daemon on a stand, started again whenever it has ended."""

    def __init__(self, stand: Stand, seed: int) -> None:
        self.told = Told()
        self.state = stand.folder / "estune-state"
        self._stand = stand
        self._random = Random(seed)  # noqa: S311  for verdicts, not for secrets
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
                [sys.executable, "-m", "estune.cli", "daemon", str(self._file)],
                stdout=subprocess.DEVNULL,
                stderr=errors,
                env=os.environ | NO_THREADS,
            )

    def go_on(self, trials: int) -> None:
        """Lets it do so many more trials, deciding whatever there is to decide."""
        log = self._stand.log
        seen, seen_s = log.count("end"), time.monotonic()
        enough = seen + trials
        while (now := log.count("end")) < enough or self._process.poll() is not None:
            if self._process.poll() is not None:
                self.told.died += 1
                self._process = self._started()
            if now != seen:
                seen, seen_s = now, time.monotonic()
            elif time.monotonic() - seen_s > STUCK_S:
                self.told.stuck += 1
                return
            # Not to be reached just now, or the disk is full: asked again.
            with contextlib.suppress(EstuneError):
                self._decide()
            time.sleep(0.02)

    def _decide(self) -> None:
        with DaemonClient(self._endpoint, timeout_s=1.0) as client:
            status = client.status(NAME)
            verb = self._verb(status)
            if verb:
                client.command(NAME, verb, "chaos")

    def _verb(self, status: DaemonStatus) -> Any:
        """What somebody would say to it now, who wants it to tune again and again."""
        match status.mode:
            case SupervisorMode.PAUSED:
                return "resume"
            case SupervisorMode.HOLDING:
                return self._random.choice(("accept", "reject"))
            case SupervisorMode.WATCHING if status.checks >= self._checks + CHECKS:
                self._checks = status.checks
                return "revert"
        return ""

    def suffer(self, fault: Fault) -> None:
        """Has a fault befall it."""
        self.told.faults[fault.blow] += 1
        process, wires = self._process, [self._stand.near]
        match fault.blow:
            case Blow.KILL:
                end(process, signal.SIGKILL)
                time.sleep(fault.lasts_s)
                self._process = self._started()
            case Blow.END:
                self.stop()
                self._process = self._started()
            case Blow.CUT:
                wires[0].cut()
            case Blow.RIG:
                end(self._stand.rig, signal.SIGKILL)
                time.sleep(fault.lasts_s)
                self._stand.restart()
            case Blow.FREEZE | Blow.HANG | Blow.DISK:
                lasting = {
                    Blow.FREEZE: lambda: frozen(process),
                    Blow.HANG: lambda: stalled(wires, "both"),
                    Blow.DISK: lambda: disk_full(process),
                }
                with lasting[fault.blow]():
                    time.sleep(fault.lasts_s)

    def stop(self) -> None:
        """Ends it in good order, and looks which gains are live."""
        code = end(self._process, signal.SIGTERM)
        with contextlib.closing(DaemonStore.open(self.state / NAME, NAME)) as store:
            home = store.gains().get(store.life.home)
        live = self._stand.log.motions()[-1].live
        # It may end before it has met the rig.
        self.told.not_home += code == 0 and home is not None and live != home.as_tuple()

    def close(self) -> None:
        """Ends it, whatever it does."""
        end(self._process)


def runs(state: Path) -> Iterator[Journal]:
    """The journals of its tunings, one after the other."""
    for folder in sorted((state / NAME / RUNS).iterdir()):
        with Journal.open(folder) as journal:
            yield journal


def judge(stand: Stand, daemon: Supervised) -> dict[str, Any]:
    """Counts, once no process runs any more."""
    motions = stand.log.motions()
    begun = Counter(motion.trial_id for motion in motions if motion.what == "begin")
    with contextlib.closing(DaemonStore.open(daemon.state / NAME, NAME)) as store:
        history, checks = store.gain_history(-1), store.checks(-1)
    agreed = {
        tuple(row[name] for name in GAIN_NAMES)
        for row in history
        if row["name"] in ("original", "accepted")
    }
    other = told = interrupted = tunings = 0
    for journal in runs(daemon.state):
        outcomes = [(entry, entry.outcome) for entry in journal.entries()]
        entries = [(entry, outcome) for entry, outcome in outcomes if outcome is not None]
        found = {e.number: (e.gains, e.cost) for e, outcome in entries if not outcome.is_void}
        expected = undisturbed(journal)
        tunings += 1
        told += len(entries)
        interrupted += len(entries) - len(found)
        other += sum(expected.get(number) != result for number, result in found.items())
    return {
        "faults": sum(daemon.told.faults.values()),
        "faults_by_kind": dict(sorted(daemon.told.faults.items())),
        "trials": told + len(checks),
        "motions": sum(begun.values()),
        "tunings": tunings,
        "accepted": sum(row["name"] == "accepted" for row in history),
        "interrupted": interrupted,
        "run_twice": sum(times > 1 for times in begun.values()),
        "other_gains": sum(motion.live not in agreed for motion in motions),
        "other_proposals": other,
        "stuck": daemon.told.stuck,
        "died": daemon.told.died,
        "not_home": daemon.told.not_home,
    }


def undisturbed(journal: Journal) -> dict[int, tuple[Gains, float]]:
    """The same tuning on a rig that nothing happens to."""
    plan = plan_from_json(journal.fact("plan"))
    run = loop.start(plan, description_from_json(journal.fact("rig")), None)
    loop.run(run, truth(NAME))
    return {entry.number: (entry.gains, entry.cost) for entry in run.entries}


def conduct(count: int, seed: int, pace: float, folder: Path) -> dict[str, Any]:
    """One campaign, and all there is to say of it."""
    with Stand(folder, plain=False, pace=pace) as stand:
        daemon = Supervised(stand, seed)
        try:
            daemon.go_on(1)
            for fault in schedule(count, seed):
                daemon.go_on(fault.after_trials)
                time.sleep(fault.delay_s)
                daemon.suffer(fault)
            daemon.go_on(1)
            daemon.stop()
        finally:
            daemon.close()
        return judge(stand, daemon)
