"""Tuning runs of one rig: started, continued after a restart, and decided."""

import logging
import math
from typing import NamedTuple

from estune import api
from estune.core.comparison import Change
from estune.core.control_chart import ChartState
from estune.core.gains import Gains
from estune.daemon.config import RigTable, plan_settings
from estune.daemon.store import RUNS, DaemonStore, now
from estune.errors import EstuneError, RigError
from estune.run import loop
from estune.run.journal import FILE_NAME, Journal
from estune.run.limit_verdict import LimitState
from estune.run.planning import (
    description_from_json,
    description_to_json,
    make_plan,
    plan_from_json,
    plan_to_json,
)
from estune.run.results.summary import summarise
from estune.run.robustness import Verdict, verdict_on
from estune.run.tuning_run import TuningRun
from estune.trial import RigDescription

_log = logging.getLogger(__name__)


class RunDecision(NamedTuple):
    """Result of a complete run.

    Attributes:
        better: Gains with a statistically significant improvement; None if there are none.
        start_chart: Control chart for the initial gains; None where repeats were unsafe or one.
        chart: Control chart for the better gains.
    """

    better: Gains | None
    sentence: str
    start_chart: ChartState | None
    chart: ChartState | None


class TuningRuns:
    """Tuning runs of one rig, each in a folder of its own."""

    def __init__(self, store: DaemonStore, settings: RigTable) -> None:
        self._store = store
        self._settings = settings

    @property
    def name(self) -> str:
        """Name of the current or last run; empty if there was none."""
        return str(self._store.fact("run") or "")

    def counts(self) -> tuple[int, int]:
        """Trials of the current or last run, and the most it may have; zeros where it has none."""
        if not self.name:
            return 0, 0
        try:
            with Journal.open(self._store.folder / RUNS / self.name) as journal:
                plan = plan_from_json(journal.fact("plan"))
                outcomes = [(e.number, e.outcome) for e in journal.entries()]
        except EstuneError as error:  # told where the run is continued
            _log.warning("run %s cannot be read: %s", self.name, error)
            return 0, 0
        done = [number for number, outcome in outcomes if outcome and not outcome.is_void]
        return max(done, default=-1) + 1, plan.max_trials

    def open(self, rig: RigDescription) -> TuningRun:
        """The current run, continued from its journal with its own plan, or a new one.

        Raises:
            JournalError: its journal cannot be read or written.
            InvalidInput: the settings do not suit the rig.
        """
        folder = self._store.folder / RUNS / self.name
        if self.name and self._store.fact("open_run") and (folder / FILE_NAME).exists():
            journal = Journal.open(folder, write=True)
            try:
                return _replay(journal, rig)
            except RigError as error:  # the rig has changed since: a run stays on one rig
                journal.close()
                _log.warning("run %s is not continued: %s", self.name, error)
            except BaseException:
                journal.close()
                raise
        return self._start(rig)

    def end(self) -> None:
        """Stores that the current run is over."""
        self._store.set_fact("open_run", "")
        self._store.set_fact("run_ended_at", now())

    def decide(self, run: TuningRun) -> RunDecision:
        """Whether the best gains of a complete run are better than the initial ones."""
        session, settings = run.session, self._settings.tuning
        repeats = session.confirmation

        def chart(costs: tuple[float, ...], *others: tuple[float, ...]) -> ChartState | None:
            safe = [other for other in others if math.inf not in other]
            if math.inf in costs or max(map(len, (costs, *safe))) < 2:
                return None
            return self._settings.watch.chart.begin(costs, *safe)

        if repeats is None:
            return RunDecision(None, summarise(session).message, chart(session.baseline), None)
        start, best = repeats.costs
        if len(repeats.safe) < 2:
            start_chart = chart((*session.baseline, *start))
            return RunDecision(None, summarise(session).message, start_chart, None)
        change = repeats.change(settings.confidence)
        start_chart = chart(start, best)
        better, sentence = self._judged(verdict_on(run, change), change)
        if not better:
            return RunDecision(None, sentence, start_chart, None)
        return RunDecision(repeats.gains[1], sentence, start_chart, chart(best, start))

    def _judged(self, verdict: Verdict, change: Change) -> tuple[bool, str]:
        """Whether confirmed gains may be used, and why or why not."""
        limits = verdict.limits
        if verdict.fault:
            return False, f"not robust: {verdict.fault}; cost {change}"
        if limits.state is LimitState.BROKEN:
            return False, f"{limits.reason}; cost {change}"
        if verdict.broken:
            return (
                True,
                f"within the limits; the initial gains have {verdict.broken}: cost {change}",
            )
        if not change.high < -self._settings.tuning.improvement_min:
            return False, f"no significant improvement: cost {change}"
        said = f"better than the initial gains: cost {change}"
        return True, f"{said}; limits not shown: {limits.reason}" if limits.reason else said

    def _start(self, rig: RigDescription) -> TuningRun:
        count = int(self._store.fact("runs") or 0) + 1
        name = f"{self._store.identity}-{count:03d}"
        plan = make_plan(rig, name, start=rig.gains, **plan_settings(self._settings, rig))
        with self._store.transaction():
            self._store.set_fact("runs", count)
            self._store.set_fact("run", name)
            self._store.set_fact("open_run", name)
        facts = {
            "plan": plan_to_json(plan),
            "rig": description_to_json(rig),
            "target": self._settings.target,
            "rig_name": rig.name,
            "created_at": now(),
            "status": "running",
        }
        return loop.start(plan, rig, Journal.create(self._store.folder / RUNS / name, facts))


def _replay(journal: Journal, rig: RigDescription) -> TuningRun:
    plan = plan_from_json(journal.fact("plan"))
    then = description_from_json(journal.fact("rig"))
    api.check_same_rig(then, rig)
    return loop.replay(plan, then, journal)
