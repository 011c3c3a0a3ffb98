"""A run's journal on the board: trials, curves, what comes next, and the result."""

import math
import shlex
import shutil
import time
from collections import Counter, deque
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np

from estune import api
from estune.core.comparison import repeatability
from estune.core.gains import GAIN_NAMES
from estune.core.quantities import FloatArray
from estune.errors import EstuneError
from estune.run import loop, snapshot
from estune.run.journal import Journal, JournalEntry, being_written
from estune.run.phase import Phase
from estune.run.planning import description_from_json, plan_from_json
from estune.run.session import UNSAFE_RATIO, Session, is_safe, predict_next
from estune.support.quantity_text import axis_label
from estune.trial import Outcome, RigDescription, TrialRecord
from estune.tuners import tuner_space
from estune.web.board import Board
from estune.web.reader import Reader

HISTORY_MAX = 4000
"""Trials of the past that a page is sent: of more, the best and the worst of each stretch."""
REPLAYED_MAX = 500
"""Trials without a snapshot up to which the tuner's own state is restored."""
POINTS_MAX = 1500
"""Points of a curve."""
LATEST_S = 1.0
"""Least time between two records that are read; what is faster is seen in the live samples."""
_PHASES = tuple(Phase)
_OF_ONE_RUN = ("result", "expected", "curve.start", "curve.best", "curve.latest", "curve.tuned")
_TIMES = 20
"""Trials whose durations give the time left."""


class RunReader(Reader):
    """Follows a journal ten times a second; only new trials are read.

    Args:
        board: The board.
        folder: The run.
        predict: Whether to restore the tuner's state, for what it expects; not in a process that
            has other work.
    """

    source = "run"
    every_s = 0.1

    def __init__(self, board: Board, folder: Path, *, predict: bool = True) -> None:
        super().__init__(board)
        self._folder = folder
        self._predict = predict
        self._journal: Journal | None = None
        self._rig: RigDescription | None = None
        self._tuning: loop.TuningRun | None = None
        self._plan: dict[str, Any] = {}
        self._entries: list[JournalEntry] = []
        self._baseline: list[float] = []
        self._unsafe = self._counted = self._rows = 0
        self._best: JournalEntry | None = None
        self._status = ""
        self._changes = self._latest = 0
        self._latest_at_s = -math.inf
        self._seen_s: deque[float] = deque(maxlen=_TIMES)

    def read(self) -> None:
        """Reads what has been added to the journal."""
        journal, is_first = self._journal, self._journal is None
        if journal is not None and journal.changes() == self._changes:
            self._show_latest(journal)
            if self._status != "running" or being_written(self._folder):
                return
        if journal is None:
            journal = self._journal = Journal.open(self._folder)
            self._entries, self._baseline, self._best = [], [], None
            self._unsafe = self._counted = self._latest = 0
            self._tuning = None
            self._plan = journal.fact("plan")
            self._rig = description_from_json(journal.fact("rig"))
            for name in _OF_ONE_RUN:  # a board may have shown another run before
                self.board.put(name, None)
            self._show_plan(journal, self._rig)
        self._changes = journal.changes()
        listed = journal.entries(skip=len(self._entries))
        added = [entry for entry in listed if entry.outcome is not None]
        pending = next((entry for entry in listed if entry.outcome is None), None)
        status = self._present_status(journal)
        if not is_first and not added and status == self._status:
            return
        self._status = status
        self._count(added)
        if added and not is_first:
            self._seen_s.append(time.monotonic())
        self._show_trials(journal, added, restart=is_first)
        self._show_latest(journal)
        self._show_state(pending)
        if self._predict:
            self._show_expectations(journal)
        if status == "finished":
            self._show_result()

    def release(self) -> None:
        """Closes the journal."""
        journal, self._journal = self._journal, None
        if journal is not None:
            journal.close()

    def _present_status(self, journal: Journal) -> str:
        status = str(journal.fact("status"))
        if status == "running" and not being_written(self._folder):
            again = f"continue with: estune resume {shlex.quote(str(self._folder))}"
            trial_bytes = journal.size_bytes() / max(1, len(self._entries))
            is_full = shutil.disk_usage(self._folder).free < trial_bytes
            full = "the disk is full; make room and " if is_full else ""
            return f"interrupted: its process has ended; {full}{again}"
        return status

    def _count(self, added: Sequence[JournalEntry]) -> None:
        self._entries += added
        self._baseline += [
            entry.cost
            for entry in added
            if entry.phase is Phase.BASELINE and entry.outcome is Outcome.DONE
        ]
        eta_max = self._eta_max
        kinds = Counter(_kind(entry, eta_max) for entry in added)
        self._counted += kinds[DONE] + kinds[UNSAFE]
        self._unsafe += kinds[UNSAFE]

    def _show_plan(self, journal: Journal, rig: RigDescription) -> None:
        plan, space = self._plan, tuner_space(self._plan["tuner"])
        self.board.put(
            "run",
            {
                "name": plan["run"],
                "folder": str(self._folder),
                "rig": rig.name,
                "measurement": rig.measurement,
                "command": rig.command,
                "command_limits": [rig.controller.output_min_N, rig.controller.output_max_N],
                "per_ampere": rig.newtons_per_ampere,
                "step_at_s": plan["step"]["step_at_s"],
                "duration_s": plan["step"]["duration_s"],
                "start": [plan["start"][name] for name in GAIN_NAMES],
                "bounds": {
                    name: [low, high]
                    for name, low, high in zip(space.names, space.low, space.high, strict=True)
                },
                "trials_max": plan["trials"],
                "repeats": plan["repeats"],
                "created_at": journal.fact("created_at"),
                "phases": [phase.value for phase in _PHASES],
                "gains": list(GAIN_NAMES),
                "gain_labels": [
                    axis_label(name.removesuffix("_s").replace("_", " "), unit)
                    for name, unit in rig.gain_units.items()
                ],
            },
        )

    @property
    def _eta_max(self) -> float:
        if self._plan.get("eta_max") is not None:
            return float(self._plan["eta_max"])
        return UNSAFE_RATIO * fmean(self._baseline) if self._baseline else math.inf

    def _show_trials(
        self, journal: Journal, added: Sequence[JournalEntry], *, restart: bool
    ) -> None:
        eta_max = self._eta_max
        safe = [e for e in added if e.outcome and is_safe(e.phase, e.outcome, e.cost, eta_max)]
        if self._rows + len(added) > 2 * HISTORY_MAX:  # a page may be open for days
            added, restart = self._entries, True
        shown = _thinned(added) if restart else added
        self._rows = len(shown) + (0 if restart else self._rows)
        rows = [
            (e.number, e.cost, _kind(e, eta_max), _PHASES.index(e.phase), *e.gain_values)
            for e in shown
        ]
        self.board.extend("trials", rows, restart=restart)
        if restart and self._entries:
            self._put_curve(journal, "start", self._entries[0])
        searched = [e for e in safe if e.phase in (Phase.BASELINE, Phase.SEARCH)]
        best = min((*searched, *([self._best] if self._best else ())), key=_cost, default=None)
        if best is not None and best is not self._best:
            self._best = best
            self._put_curve(journal, "best", best)

    def _show_latest(self, journal: Journal) -> None:
        """Shows the latest trial, of fast ones only some."""
        now_s = time.monotonic()
        number = len(self._entries)
        if number > self._latest and now_s - self._latest_at_s >= LATEST_S:
            self._latest, self._latest_at_s = number, now_s
            self._put_curve(journal, "latest", self._entries[-1])

    def _put_curve(self, journal: Journal, name: str, entry: JournalEntry) -> None:
        with suppress(EstuneError):  # the run keeps its latest records only
            assert self._rig is not None  # noqa: S101  read with the journal
            record = journal.record(entry.trial_id)
            self.board.put(f"curve.{name}", curve(record, self._rig) | {"number": entry.number})

    def _show_state(self, pending: JournalEntry | None) -> None:
        best, baseline = self._best, self._baseline
        gaps = [later - before for before, later in pairwise(self._seen_s)]
        self.board.put(
            "state",
            {
                "status": self._status,
                "phase": pending.phase.value if pending else "",
                "done": self._counted,
                "left": self._left(pending),
                "trial_s": median(gaps) if gaps else None,
                "unsafe": self._unsafe,
                "eta_max": self._eta_max,
                "start_cost": fmean(baseline) if baseline else None,
                "repeatability": repeatability((tuple(baseline),)) if len(baseline) > 1 else None,
                "best": best and {"number": best.number, "cost": best.cost},
                "best_gains": best and list(best.gain_values),
                "next": list(pending.gain_values) if pending else None,
            },
        )

    def _left(self, pending: JournalEntry | None) -> int:
        """Expected number of trials to come."""
        if pending is None:
            return 0
        if self._tuning is not None:
            return max(self._tuning.session.trials_left, 1)
        most: int = self._plan["trials"] + 5 * self._plan["repeats"]
        return max(1, most - self._counted)

    def _show_expectations(self, journal: Journal) -> None:
        """Expectations of the tuner: remaining improvement, intervals, and the next cost."""
        try:
            if self._tuning is None:
                self._tuning = self._restored(journal)
            tuning = self._tuning
            if tuning is None:
                return
            for entry in self._entries[len(tuning.entries) :]:
                tuning.session = loop.session_after(tuning, entry, journal)
                tuning.entries.append(entry)
        except EstuneError:  # of another version, or of a tuner that is not installed here
            self._predict, self._tuning = False, None
        else:
            self.board.put("expected", _expected(tuning.session))

    def _restored(self, journal: Journal) -> loop.TuningRun | None:
        plan = plan_from_json(self._plan)
        assert self._rig is not None  # noqa: S101  read with the journal
        replayed, _ = snapshot.read(journal, plan, self._entries)
        if len(self._entries) - replayed > REPLAYED_MAX:
            self._predict = False
            return None
        return loop.replay(plan, self._rig, journal)

    def _show_result(self) -> None:
        try:
            result = api.load(self._folder)
        except EstuneError as error:  # its trials can be shown all the same
            shown = {
                "heading": str(error),
                "good": False,
                "tuned": False,
                "rows": [],
                "remarks": [],
            }
            self.board.put("result", shown)
            return
        self.board.put(
            "result",
            {
                "heading": result.heading(),
                "good": result.ending.good,
                "tuned": result.success,
                "rows": [list(row) for row in result.rows()],
                "remarks": list(result.remarks()),
            },
        )
        if result.tuned_record is not None and result.success:
            self.board.put("curve.tuned", curve(result.tuned_record, result.rig))


DONE, UNSAFE, VOID = 0, 1, 2


def _kind(entry: JournalEntry, eta_max: float) -> int:
    if entry.outcome is None or entry.outcome.is_void or entry.outcome is Outcome.DECLINED:
        return VOID
    return DONE if is_safe(entry.phase, entry.outcome, entry.cost, eta_max) else UNSAFE


def _cost(entry: JournalEntry) -> float:
    return entry.cost


def _thinned(entries: Sequence[JournalEntry]) -> Sequence[JournalEntry]:
    """At most about `HISTORY_MAX` trials: the best and worst of each stretch, and the last."""
    if len(entries) <= HISTORY_MAX:
        return entries
    size = math.ceil(2 * len(entries) / HISTORY_MAX)
    kept: list[JournalEntry] = []
    for begin in range(0, len(entries), size):
        stretch = sorted(entries[begin : begin + size], key=_rank)
        kept += sorted({stretch[0], stretch[-1]})
    return kept if kept[-1] == entries[-1] else [*kept, entries[-1]]


def _rank(entry: JournalEntry) -> float:
    return entry.cost if math.isfinite(entry.cost) else math.inf


def _expected(session: Session) -> dict[str, Any]:
    estimate = session.plan.convergence(session.tuner_state)
    prediction = predict_next(session)
    names = session.plan.tuner.space.names
    return {
        "remaining": estimate and estimate.remaining_improvement,
        "intervals": dict(zip(names, estimate.intervals, strict=True)) if estimate else {},
        "next_cost": prediction and [prediction.low, prediction.cost, prediction.high],
        "explored": prediction and prediction.explored,
    }


def curve(record: TrialRecord, rig: RigDescription) -> dict[str, Any]:
    """Time, setpoint, measurement and command of a record, thinned to `POINTS_MAX`."""
    every = max(1, math.ceil(record.time_s.size / POINTS_MAX))
    columns = {
        "t": record.time_s,
        "r": record.setpoint_N,
        "y": record.tension_N,
        "u": record.current_A * rig.newtons_per_ampere,
    }
    return {name: _rounded(column[::every]) for name, column in columns.items()}


def _rounded(values: FloatArray) -> list[float]:
    """Values with six digits of the largest."""
    largest = float(np.abs(values[np.isfinite(values)]).max(initial=1e-300))
    return list(np.round(values, 5 - math.floor(math.log10(largest))).tolist())
