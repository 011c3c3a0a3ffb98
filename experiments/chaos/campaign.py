"""One campaign: tunings, one after the other, and faults all the while."""

import contextlib
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import NamedTuple

from experiments.chaos import faults
from experiments.chaos.client import INTERRUPTED, Errand
from experiments.chaos.faults import Fault, Kind
from experiments.chaos.processes import end, started
from experiments.chaos.stand import NAME, Stand

STUCK_S = 60.0
"""A client that is alive and has no trial run for so long, while nothing is wrong, is stuck."""

NAMED = {0, 2, 4, 5, 6, INTERRUPTED}
"""Exit codes of a client that knows what has happened."""

START = (0.4, 12.0, 0.01, 0.03)
TUNERS = ("least_squares_gradient", "otis")


class Absence(NamedTuple):
    """A time in which no client was alive, on the clock of the logs, s."""

    since_s: float
    until_s: float


@dataclass
class Diary:
    """What was done to the stand, and what came of it.

    Attributes:
        faults: How many faults of each kind.
        exits: How often a client ended with each exit code.
        absences: When there was no client.
        errands: What the clients were to do, in order.
        stuck: How often nothing went on though nothing was wrong.
        twins: How many twins were served.
        unnamed: What clients said that ended with an exit code nobody planned.
    """

    faults: Counter[str] = field(default_factory=Counter)
    exits: Counter[int] = field(default_factory=Counter)
    absences: list[Absence] = field(default_factory=list)
    errands: list[Errand] = field(default_factory=list)
    stuck: int = 0
    twins: int = 0
    unnamed: list[str] = field(default_factory=list)


class Campaign:
    """Runs tunings on a stand until enough faults and trials have come together."""

    def __init__(self, stand: Stand, schedule: list[Fault], search_trials: int, seed: int) -> None:
        self.diary = Diary()
        self._stand = stand
        self._faults = list(reversed(schedule))
        self._search_trials = search_trials
        self._random = Random(seed)  # noqa: S311  for start gains, not for secrets
        self._client: subprocess.Popen[bytes] | None = None
        self._alone_since_s = time.monotonic()

    def run(self, runs: int, say: Callable[[str], None]) -> None:
        """Does so many tunings, and as many more as it takes to spend all faults."""
        number = 0
        while number < runs or self._faults:
            left = max(runs - number, 1)
            self._tune(self._errand(number), -(-len(self._faults) // left))
            number += 1
            say(
                f"run {number}: {sum(self.diary.faults.values())} faults, "
                f"{self._stand.log.count('begin')} motions, exits {dict(self.diary.exits)}"
            )

    def _errand(self, number: int) -> Errand:
        factor = self._random.uniform(0.8, 1.25)
        return Errand(
            endpoint=(self._stand.near, self._stand.hub)[number % 2].endpoint,
            rig=NAME,
            folder=str(self._stand.folder / "runs"),
            run=f"run{number}",
            tuner=TUNERS[number // 2 % 2],
            start=(factor * START[0], factor * START[1], START[2], START[3]),
            trials=self._search_trials,
            plain=self._stand.plain,
            seed=number,
        )

    def _tune(self, errand: Errand, quota: int) -> None:
        self.diary.errands.append(errand)
        self._start_client(errand)
        while not self._is_done(errand):
            if quota == 0 or not self._faults:
                self._trials_pass(errand, 1)
            elif self._trials_pass(errand, self._faults[-1].after_trials):
                fault = self._faults.pop()
                time.sleep(fault.delay_s)
                self.diary.faults[fault.kind] += 1
                since_s = time.monotonic()
                self._befall(fault)
                self._note(fault, since_s)
                quota -= 1

    def _note(self, fault: Fault, since_s: float) -> None:
        """Keeps a line on a fault, for whoever has to find out what came of it."""
        with (self._stand.folder / "faults.txt").open("a", encoding="utf-8") as file:
            file.write(
                f"{since_s:.3f} to {time.monotonic():.3f} {fault.kind} ({fault.lasts_s:g} s)\n"
            )

    def _start_client(self, errand: Errand) -> None:
        self.diary.absences.append(Absence(self._alone_since_s, time.monotonic()))
        self._client = started("client", errand.dump(), errors=self._errors)

    @property
    def _errors(self) -> Path:
        return self._stand.folder / "client.err"

    @property
    def _alive(self) -> subprocess.Popen[bytes]:
        if self._client is None:
            raise AssertionError
        return self._client

    def _is_done(self, errand: Errand) -> bool:
        """Whether the run has come to its end; if its client has ended before, starts another."""
        client = self._client
        if client is None:
            return True
        if client.poll() is None:
            return False
        code = end(client)
        self._alone_since_s = time.monotonic()
        self.diary.exits[code] += 1
        if code not in NAMED and code != -signal.SIGKILL:
            self.diary.unnamed.append(self._errors.read_text(encoding="utf-8")[-3000:])
        if code == 0:
            self._client = None
        else:
            self._start_client(errand)
        return code == 0

    def _trials_pass(self, errand: Errand, count: int) -> bool:
        """Waits until so many more trials have ended; whether the run goes on after them."""
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

    # --- what befalls the stand ---

    def _befall(self, fault: Fault) -> None:
        client = self._alive
        match fault.kind:
            case Kind.CUT | Kind.LOSE:
                for wire in self._stand.wires:
                    wire.cut() if fault.kind is Kind.CUT else wire.lose_next_answer()
            case Kind.KILL_CLIENT | Kind.CTRL_C:
                killed = fault.kind is Kind.KILL_CLIENT
                end(client, signal.SIGKILL if killed else signal.SIGINT)
                self._alone_since_s = time.monotonic()
                time.sleep(fault.lasts_s)
            case Kind.KILL_RIG | Kind.RESTART:
                killed = fault.kind is Kind.KILL_RIG
                end(self._stand.rig, signal.SIGKILL if killed else signal.SIGINT)
                time.sleep(fault.lasts_s)
                self._stand.restart()
            case Kind.DOUBLE | Kind.LATE | Kind.AGAIN:
                tell(client, fault.kind.name.lower())
            case Kind.TWIN:
                self.diary.twins += not (self._stand.plain or self._stand.twin_is_kept_out())
            case _:
                self._last(fault)

    def _last(self, fault: Fault) -> None:
        """Brings about what lasts for a while."""
        since_s = time.monotonic()
        with self._state(fault.kind):
            time.sleep(fault.lasts_s)
        if fault.kind is Kind.STOP_CLIENT:
            self.diary.absences.append(Absence(since_s, time.monotonic()))

    def _state(self, kind: Kind) -> contextlib.AbstractContextManager[object]:
        stand = self._stand
        rival = f"rival{self.diary.faults[kind]}"
        states: dict[Kind, Callable[[], contextlib.AbstractContextManager[object]]] = {
            Kind.HANG: lambda: faults.stalled(stand.wires, "both"),
            Kind.HANG_THERE: lambda: faults.stalled(stand.wires, "there"),
            Kind.HANG_BACK: lambda: faults.stalled(stand.wires, "back"),
            Kind.STOP_CLIENT: lambda: faults.frozen(self._alive),
            Kind.STOP_RIG: lambda: faults.frozen(stand.rig),
            Kind.RIG_DISK: lambda: faults.disk_full(stand.rig),
            Kind.CLIENT_DISK: lambda: faults.disk_full(self._alive),
            Kind.NAMESAKE: stand.namesake,
            Kind.RIVAL: lambda: stand.rival(rival),
            Kind.SLOW: stand.slow,
        }
        return states[kind]()


def tell(client: subprocess.Popen[bytes], word: str) -> None:
    """Says a word to a client, if it is there to hear it."""
    if client.stdin:
        with contextlib.suppress(BrokenPipeError):
            client.stdin.write(f"{word}\n".encode())
            client.stdin.flush()
