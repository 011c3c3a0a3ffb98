"""The run that a page shows, by its journal alone: trials, curves, what comes next, the result."""

import math
import shlex
import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from estune import api
from estune.core.comparison import repeatability
from estune.core.gains import GAIN_NAMES
from estune.errors import EstuneError
from estune.run import loop, snapshot
from estune.run.journal import Journal, JournalEntry, being_written
from estune.run.planning import description_from_json, plan_from_json
from estune.run.session import Session, predict_next
from estune.run.tally import Tally
from estune.run.tuning_run import TuningRun
from estune.trial import RigDescription
from estune.tuners import tuner_space
from estune.web import history
from estune.web.board import Board
from estune.web.reader import Reader
from estune.web.result_view import LivePrediction, shown_result

REPLAYED_MAX = 500
"""Trials without a snapshot up to which the tuner's own state is restored."""
LATEST_S = 1.0
"""Least time between two records that are read; what is faster is seen in the live samples."""
_OF_ONE_RUN = (
    *("run", "state", "result", "expected", "predicted.run"),
    *(f"curve.{name}" for name in ("start", "best", "latest", "tuned")),
)
_TIMES = 20
"""Trials whose ends give the time that one takes."""


class RunReader(Reader):
    """Follows a journal ten times a second; only new trials are read.

    Args:
        choose: The run to show now, or None; a run, to show that one alone.
        predict: Whether to restore the tuner's state, for what it expects; not in a process that
            has other work.
    """

    source = "run"
    every_s = 0.1

    def __init__(
        self, board: Board, choose: Path | Callable[[], Path | None], *, predict: bool = True
    ) -> None:
        super().__init__(board)
        self._choose = (lambda: choose) if isinstance(choose, Path) else choose
        self._predict = predict
        self._run: _FollowedRun | None = None
        self._is_blank = True

    def read(self) -> None:
        """Reads what has been added to the run, or begins with another."""
        folder = self._choose()
        run = self._run
        if run is not None and run.folder != folder:
            self.release()
            run = None
        if run is None and not self._is_blank:
            for name in _OF_ONE_RUN:
                self.board.put(name, None)
            self.board.extend("trials", [], restart=True)
            self._is_blank = True
        if folder is None:
            return
        if run is None:
            run = self._run = _FollowedRun(self.board, folder, predict=self._predict)
            self._is_blank = False
        run.read()

    def release(self) -> None:
        """Closes the journal."""
        run, self._run = self._run, None
        if run is not None:
            run.journal.close()


class _FollowedRun:
    def __init__(self, board: Board, folder: Path, *, predict: bool) -> None:
        self.folder = folder
        self.journal = Journal.open(folder)
        self._board = board
        self._predict = predict
        self._plan: dict[str, Any] = self.journal.fact("plan")
        self._rig = description_from_json(self.journal.fact("rig"))
        self._tally = Tally(self._plan.get("eta_max"))
        self._entries: list[JournalEntry] = []
        self._rows = self._latest = 0
        self._latest_at_s = -LATEST_S
        self._tuning: TuningRun | None = None
        self._live: LivePrediction | None = None
        self._status = ""
        self._changes = -1

    def read(self) -> None:
        """Reads what has been added since the last time."""
        if self._live is not None:
            self._live.update()
        changes, is_first = self.journal.changes(), not self._status
        if is_first:
            self._board.put("run", _about(self.folder, self.journal, self._plan, self._rig))
        elif changes == self._changes:
            self._show_latest()
            if self._status != "running" or being_written(self.folder):
                return
        self._changes = changes
        listed = self.journal.entries(skip=len(self._entries))
        added = [entry for entry in listed if entry.outcome is not None]
        pending = next((entry for entry in listed if entry.outcome is None), None)
        status = self._present_status()
        if not is_first and not added and status == self._status:
            return
        self._status = status
        self._entries += added
        before = self._tally.best
        self._tally = self._tally.after((e.phase, e.outcome, e.cost) for e in added if e.outcome)
        self._show_trials(added, restart=is_first)
        best = self._tally.best
        if best is not None and best != before:
            self._put_curve("best", {entry.number: entry for entry in added}[best[1]])
        self._show_latest()
        self._follow_session()
        self._show_state(pending)
        if status == "finished":
            self._show_result()

    def _present_status(self) -> str:
        status = str(self.journal.fact("status"))
        if status == "running" and not being_written(self.folder):
            again = f"continue with: estune resume {shlex.quote(str(self.folder))}"
            trial_bytes = self.journal.size_bytes() / max(1, len(self._entries))
            is_full = shutil.disk_usage(self.folder).free < trial_bytes
            full = "the disk is full; make room and " if is_full else ""
            return f"interrupted: its process has ended; {full}{again}"
        return status

    def _show_trials(self, added: Sequence[JournalEntry], *, restart: bool) -> None:
        eta_max = self._tally.eta_max
        if self._rows + len(added) > 2 * history.HISTORY_MAX:  # a page may be open for days
            added, restart = self._entries, True
        shown = history.thinned(added) if restart else added
        self._rows = len(shown) + (0 if restart else self._rows)
        self._board.extend("trials", [history.row(e, eta_max) for e in shown], restart=restart)
        if added and len(self._entries) == len(added):
            self._put_curve("start", added[0])

    def _show_latest(self) -> None:
        """Shows the latest trial, of fast ones only some."""
        now_s, number = time.monotonic(), len(self._entries)
        if number > self._latest and now_s - self._latest_at_s >= LATEST_S:
            self._latest, self._latest_at_s = number, now_s
            self._put_curve("latest", self._entries[-1])

    def _put_curve(self, name: str, entry: JournalEntry) -> None:
        with suppress(EstuneError):  # the run keeps its latest records only
            shown = history.curve(self.journal.record(entry.trial_id), self._rig)
            self._board.put(f"curve.{name}", shown | {"number": entry.number})

    def _show_state(self, pending: JournalEntry | None) -> None:
        tally, session = self._tally, self._session
        ended = self.journal.ended_at(_TIMES)
        begun = self.journal.fact("created_at")
        taken_s = (ended[-1] - ended[0]).total_seconds() if len(ended) > 1 else None
        left = None if session is None else session.most_left
        self._board.put(
            "state",
            {
                "status": self._status,
                "phase": pending.phase.value if pending else "",
                "done": tally.number,
                "left": left,
                "at_most": session is not None and session.is_open,
                "trial_s": taken_s and taken_s / (len(ended) - 1),
                "ended_at": ended[-1].isoformat() if ended else begun,
                "unsafe": tally.unsafe,
                "eta_max": tally.eta_max,
                "start_cost": tally.start_cost,
                "repeatability": repeatability((tally.baseline,))
                if len(tally.baseline) > 1
                else None,
                "best": tally.best and {"number": tally.best[1], "cost": tally.best[0]},
                "next": list(pending.gain_values) if pending else None,
                "text": _search_text(self._board.get("expected"), pending),
            },
        )

    @property
    def _session(self) -> Session | None:
        return None if self._tuning is None else self._tuning.session

    def _follow_session(self) -> None:
        """Follows the session of a run under way, for what its tuner expects."""
        if self._status == "finished" or not self._predict:
            self._tuning = None
            return
        try:
            if self._tuning is None:
                self._tuning = self._restored()
            tuning = self._tuning
            if tuning is None:
                return
            for entry in self._entries[len(tuning.entries) :]:
                tuning.session = loop.session_after(tuning, entry, self.journal)
                tuning.entries.append(entry)
        except EstuneError:  # of another version, or of a tuner that is not installed here
            self._predict, self._tuning = False, None
        else:
            self._board.put("expected", _expected(tuning.session))

    def _restored(self) -> TuningRun | None:
        plan = plan_from_json(self._plan)
        replayed, _ = snapshot.read(self.journal, plan, self._entries)
        if len(self._entries) - replayed > REPLAYED_MAX:
            self._predict = False
            return None
        return loop.replay(plan, self._rig, self.journal)

    def _show_result(self) -> None:
        intervals = {n: (low, high) for n, low, high in self.journal.fact("intervals") or ()}
        self._board.put("expected", {"remaining": None, "intervals": intervals, "next_cost": None})
        try:
            result = api.load(self.folder)
        except EstuneError as error:  # its trials can be shown all the same
            self._board.put("result", {"heading": str(error), "rows": [], "remarks": []})
            return
        self._board.put("result", shown_result(result))
        self._live = LivePrediction(self._board, result)
        if result.tuned_record is not None and result.success:
            self._board.put("curve.tuned", history.curve(result.tuned_record, result.rig))


def _about(
    folder: Path, journal: Journal, plan: dict[str, Any], rig: RigDescription
) -> dict[str, Any]:
    """Facts of a run that do not change."""
    space = tuner_space(plan["tuner"])
    return {
        "name": plan["run"],
        "folder": str(folder),
        "rig": rig.name,
        "measurement": rig.measurement,
        "command": rig.command,
        "command_limits": [rig.controller.output_min_N, rig.controller.output_max_N],
        "per_ampere": rig.newtons_per_ampere,
        "step_at_s": plan["step"]["step_at_s"],
        "duration_s": plan["step"]["duration_s"],
        "bounds": {
            name: [low, high]
            for name, low, high in zip(space.names, space.low, space.high, strict=True)
        },
        "created_at": journal.fact("created_at"),
        "gains": list(GAIN_NAMES),
        "gain_labels": history.gain_labels(rig),
    }


def _search_text(expected: dict[str, Any] | None, pending: JournalEntry | None) -> str:
    """What is expected of the search, in sentences."""
    known = expected or {"remaining": None, "next_cost": None}
    parts = [f"Phase: {pending.phase}."] if pending else []
    if known["remaining"] is not None:
        share = f"{100.0 * known['remaining']:.2g} %"
        parts.append(f"At most {share} of the cost is expected to be left to gain.")
    if pending:
        gains = ", ".join(f"{value:.4g}" for value in pending.gain_values)
        parts.append(f"The next trial runs P, I, D, filter = {gains}.")
    if pending and known["next_cost"]:
        low, _, high = (math.inf if x is None else x for x in known["next_cost"])
        if math.isfinite(high):  # else nothing is expected
            parts.append(f"Its cost is expected between {low:.3g} and {high:.3g}.")
    return " ".join(
        (*parts, "Grey: the noise about the best cost, and the interval of each gain's optimum.")
    )


def _expected(session: Session) -> dict[str, Any]:
    estimate = session.plan.convergence(session.tuner_state)
    prediction = predict_next(session)
    names = session.plan.tuner.space.names
    return {
        "remaining": estimate and estimate.remaining_improvement,
        "intervals": dict(zip(names, estimate.intervals, strict=True)) if estimate else {},
        "next_cost": prediction and [prediction.low, prediction.cost, prediction.high],
    }
