"""One campaign: consecutive tunings under continuous faults."""

import contextlib
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import NamedTuple

from experiments.chaos import faults
from experiments.chaos.client import INTERRUPTED, Errand
from experiments.chaos.faults import Fault, LinkFault
from experiments.chaos.processes import end, started
from experiments.chaos.stand import NAME, Stand

STUCK_S = 60.0
"""Longest time without a trial of a live client while there is no fault."""

NAMED = {0, 2, 4, 5, 6, INTERRUPTED}
"""Documented exit codes of a client."""

START = (0.4, 12.0, 0.01, 0.03)
TUNERS = ("least_squares_gradient", "otis")


class Absence(NamedTuple):
    """A time without a client, on the clock of the logs, s."""

    since_s: float
    until_s: float


@dataclass
class Diary:
    """Course of a campaign.

    Attributes:
        faults: Number of faults of each kind.
        exits: Number of clients with each exit code.
        absences: Times without a client.
        errands: Tasks of the clients, in order.
        given_up: Runs whose client ended with an error, although nobody had ended it.
        stuck: Number of times no trial ran without a fault.
        twins: Number of twins that were served.
        unnamed: Error output of clients with an undocumented exit code.
    """

    faults: Counter[str] = field(default_factory=Counter)
    exits: Counter[int] = field(default_factory=Counter)
    absences: list[Absence] = field(default_factory=list)
    errands: list[Errand] = field(default_factory=list)
    given_up: set[str] = field(default_factory=set)
    stuck: int = 0
    twins: int = 0
    unnamed: list[str] = field(default_factory=list)


class Campaign:
    """Runs tunings on a stand until all faults and enough trials have occurred."""

    def __init__(
        self, stand: Stand, schedule: list[Fault], search_trials: int, seed: int, name: str = "run"
    ) -> None:
        self.diary = Diary()
        self._stand, self._name = stand, name
        self._faults = list(reversed(schedule))
        self._search_trials = search_trials
        self._random = Random(seed)  # noqa: S311  for initial gains, not for secrets
        self._client: subprocess.Popen[bytes] | None = None
        self._alone_since_s = time.monotonic()
        self._errors = stand.folder / "client.err"

    def run(self, runs: int, report: Callable[[str], None]) -> None:
        """Performs a number of tunings, and more until all faults have occurred."""
        number = 0
        while number < runs or self._faults:
            runs_left = max(runs - number, 1)
            self._tune(self._errand(number), -(-len(self._faults) // runs_left))
            number += 1
            report(
                f"run {number}: {sum(self.diary.faults.values())} faults, "
                f"{self._stand.log.count('begin')} motions, exits {dict(self.diary.exits)}"
            )

    def _errand(self, number: int) -> Errand:
        factor = self._random.uniform(0.8, 1.25)
        return Errand(
            endpoint=(self._stand.near, self._stand.hub)[number % 2].endpoint,
            rig=NAME,
            folder=str(self._stand.folder / "runs"),
            run=f"{self._name}{number}",
            tuner=TUNERS[number // 2 % 2],
            start=(factor * START[0], factor * START[1], START[2], START[3]),
            trials=self._search_trials,
            seed=number,
        )

    def _tune(self, errand: Errand, quota: int) -> None:
        self.diary.errands.append(errand)
        self._start_client(errand)
        while not self._is_done(errand):
            if quota == 0 or not self._faults:
                self._await_trials(errand, 1)
            elif self._await_trials(errand, self._faults[-1].after_trials):
                fault = self._faults.pop()
                time.sleep(fault.delay_s)
                self.diary.faults[fault.kind] += 1
                since_s = time.monotonic()
                self._cause(fault)
                with (self._stand.folder / "faults.txt").open("a", encoding="utf-8") as file:
                    span = f"{since_s:.3f} to {time.monotonic():.3f}"
                    file.write(f"{span} {fault.kind} ({fault.lasts_s:g} s)\n")
                quota -= 1

    def _start_client(self, errand: Errand) -> None:
        self.diary.absences.append(Absence(self._alone_since_s, time.monotonic()))
        self._client = started("client", errand.dump(), errors=self._errors)

    @property
    def _live_client(self) -> subprocess.Popen[bytes]:
        if self._client is None:
            raise AssertionError
        return self._client

    def _is_done(self, errand: Errand) -> bool:
        """Whether the run has ended; replaces a client that has ended before."""
        client = self._client
        if client is None:
            return True
        if client.poll() is None:
            return False
        code = end(client)
        self._alone_since_s = time.monotonic()
        self.diary.exits[code] += 1
        if code not in (0, INTERRUPTED, -signal.SIGKILL):
            self.diary.given_up.add(errand.run)
        if code not in NAMED and code != -signal.SIGKILL:
            self.diary.unnamed.append(self._errors.read_text(encoding="utf-8")[-3000:])
        if code == 0:
            self._client = None
        else:
            self._start_client(errand)
        return code == 0

    def _await_trials(self, errand: Errand, count: int) -> bool:
        """Waits for a number of trials; returns whether the run continues after them."""
        log = self._stand.log
        seen = log.count("end")
        enough, seen_s = seen + count, time.monotonic()
        while not self._is_done(errand):
            now = log.count("end")
            if now >= enough:
                return True
            if now != seen:
                seen, seen_s = now, time.monotonic()
            elif time.monotonic() - seen_s > STUCK_S:
                self.diary.stuck += 1
                return True
            time.sleep(0.01)
        return False

    # --- faults ---

    def _cause(self, fault: Fault) -> None:
        client, stand = self._live_client, self._stand
        match fault.kind:
            case LinkFault.CUT | LinkFault.LOSE:
                for wire in stand.wires:
                    wire.cut() if fault.kind is LinkFault.CUT else wire.lose_next_answer()
            case LinkFault.KILL_CLIENT | LinkFault.CTRL_C:
                killed = fault.kind is LinkFault.KILL_CLIENT
                end(client, signal.SIGKILL if killed else signal.SIGINT)
                self._alone_since_s = time.monotonic()
                time.sleep(fault.lasts_s)
            case LinkFault.KILL_RIG | LinkFault.RESTART:
                killed = fault.kind is LinkFault.KILL_RIG
                end(stand.rig, signal.SIGKILL if killed else signal.SIGINT)
                time.sleep(fault.lasts_s)
                stand.restart()
            case LinkFault.DOUBLE | LinkFault.LATE | LinkFault.AGAIN if client.stdin:
                with contextlib.suppress(BrokenPipeError):
                    client.stdin.write(f"{fault.kind.name.lower()}\n".encode())
                    client.stdin.flush()
            case LinkFault.TWIN:
                self.diary.twins += not stand.is_twin_refused()
            case _:
                since_s = time.monotonic()
                with self._lasting(fault.kind):
                    time.sleep(fault.lasts_s)
                if fault.kind is LinkFault.STOP_CLIENT:
                    self.diary.absences.append(Absence(since_s, time.monotonic()))

    def _lasting(self, kind: str) -> contextlib.AbstractContextManager[object]:
        """The state during a fault that lasts."""
        stand = self._stand
        rival = f"rival{self.diary.faults[kind]}"
        states: dict[str, Callable[[], contextlib.AbstractContextManager[object]]] = {
            LinkFault.HANG: lambda: faults.stalled(stand.wires, "both"),
            LinkFault.OUTAGE: lambda: faults.stalled(stand.wires, "both"),
            LinkFault.HANG_THERE: lambda: faults.stalled(stand.wires, "there"),
            LinkFault.HANG_BACK: lambda: faults.stalled(stand.wires, "back"),
            LinkFault.STOP_CLIENT: lambda: faults.frozen(self._live_client),
            LinkFault.STOP_RIG: lambda: faults.frozen(stand.rig),
            LinkFault.RIG_DISK: lambda: faults.disk_full(stand.rig),
            LinkFault.CLIENT_DISK: lambda: faults.disk_full(self._live_client),
            LinkFault.NAMESAKE: stand.namesake,
            LinkFault.RIVAL: lambda: stand.rival(rival),
            LinkFault.SLOW: stand.slow,
            LinkFault.FLOOD: stand.flood,
        }
        return states[kind]()
