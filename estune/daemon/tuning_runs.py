"""The tuning runs of one rig: begun, gone on with after a restart, and decided."""

import logging
import math
from typing import NamedTuple

from estune import api
from estune.core.comparison import Change, compare_costs
from estune.core.control_chart import ChartState
from estune.core.gains import Gains
from estune.daemon.config import RigTable, plan_settings
from estune.daemon.store import RUNS, DaemonStore, now
from estune.errors import RigError
from estune.run import loop
from estune.run.journal import FILE_NAME, Journal
from estune.run.loop import TuningRun
from estune.run.plan import (
    description_from_json,
    description_to_json,
    make_plan,
    plan_from_json,
    plan_to_json,
)
from estune.run.summary import summarise
from estune.trial import RigDescription

_log = logging.getLogger(__name__)


class Decision(NamedTuple):
    """What a run came to.

    Attributes:
        better: The gains that are better beyond doubt; None to keep the start.
        sentence: Why, in words.
        change: How much the cost changed, if it could be compared.
        start_chart: A control chart for the start, if there can be one.
        chart: One for the better gains.
    """

    better: Gains | None
    sentence: str
    change: Change | None
    start_chart: ChartState | None
    chart: ChartState | None


class TuningRuns:
    """The tuning runs of one rig, in a folder of its own each."""

    def __init__(self, store: DaemonStore, settings: RigTable) -> None:
        self._store = store
        self._settings = settings

    @property
    def name(self) -> str:
        """The run under way, or the last; empty if there was none."""
        return str(self._store.fact("run") or "")

    def open(self, rig: RigDescription) -> TuningRun:
        """The run under way as its journal left it, or a new one.

        A run goes on with the plan it was begun with, and on the rig it was begun on only.

        Raises:
            JournalError: its journal cannot be read or written.
            InvalidInput: the settings do not suit the rig.
        """
        folder = self._store.folder / RUNS / self.name
        if self.name and self._store.fact("open_run") and (folder / FILE_NAME).exists():
            journal = Journal.open(folder, write=True)
            try:
                return self._replayed(journal, rig)
            except RigError as error:  # begun on the rig as it no longer is; left as it is
                journal.close()
                _log.warning("run %s is not gone on with: %s", self.name, error)
            except BaseException:
                journal.close()
                raise
        return self._begun(rig)

    def end(self) -> None:
        """Notes that the run under way is over."""
        self._store.put("open_run", "")
        self._store.put("run_ended_at", now())

    def _replayed(self, journal: Journal, rig: RigDescription) -> TuningRun:
        plan = plan_from_json(journal.fact("plan"))
        then = description_from_json(journal.fact("rig"))
        api.check_same_rig(then, rig)
        return loop.replay(plan, then, journal)

    def _begun(self, rig: RigDescription) -> TuningRun:
        count = int(self._store.fact("runs") or 0) + 1
        name = f"{self._store.identity}-{count:03d}"
        plan = make_plan(rig, name, start=rig.gains, **plan_settings(self._settings, rig))
        with self._store.writing():
            self._store.put("runs", count)
            self._store.put("run", name)
            self._store.put("open_run", name)
        facts = {
            "plan": plan_to_json(plan),
            "rig": description_to_json(rig),
            "target": self._settings.target,
            "rig_name": rig.name,
            "created_at": now(),
            "status": "running",
        }
        return loop.start(plan, rig, Journal.create(self._store.folder / RUNS / name, facts))

    def decide(self, run: TuningRun) -> Decision:
        """Whether the best gains found are better than the start, by a run that is complete."""
        session, settings = run.session, self._settings.tuning
        repeats = session.confirmation

        def chart(costs: tuple[float, ...], *others: tuple[float, ...]) -> ChartState | None:
            safe = [other for other in others if math.inf not in other]
            return None if math.inf in costs else self._settings.watch.chart.begin(costs, *safe)

        if repeats is None:
            return Decision(None, summarise(session).message, None, chart(session.baseline), None)
        start, found = repeats.costs
        if len(repeats.safe) < 2:
            known = (*session.baseline, *start)
            return Decision(None, summarise(session).message, None, chart(known), None)
        seen = compare_costs(start, found, settings.confidence)
        charts = chart(start, found), chart(found, start)
        if seen.high < -settings.improvement_min:
            return Decision(repeats.gains[1], f"better than the start: cost {seen}", seen, *charts)
        sentence = f"no better than the start beyond doubt: cost {seen}"
        return Decision(None, sentence, seen, charts[0], None)
