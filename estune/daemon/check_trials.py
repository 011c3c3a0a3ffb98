"""Check trials of the nominal gains, evaluated by a control chart."""

import math
import time
from typing import NamedTuple

from estune.core.control_chart import ChartSignal, ChartState
from estune.core.gains import Gains
from estune.daemon.config import RigTable
from estune.daemon.store import DaemonStore, age_s
from estune.daemon.supervisor_state import GainSet
from estune.errors import Interrupted
from estune.run.failed_trials import cut_off, needs_operator
from estune.run.tally import UNSAFE_RATIO
from estune.trial import Rig, RigDescription, TrialRecord, TrialRequest
from estune.trial.scoring import cost_of


def check_cut_off(record: TrialRecord, description: RigDescription) -> None:
    """Has an operator look at a rig that moves, after a trial that was cut off on it.

    Raises:
        Interrupted: that is so.
    """
    if needs_operator(record, description):
        raise Interrupted(cut_off(record), "resume")


class CheckTrialResult(NamedTuple):
    """Result of a check trial.

    Attributes:
        cost: Its cost; infinite where it was unsafe, NaN where it was void.
    """

    record: TrialRecord
    cost: float
    signal: ChartSignal | None


class CheckTrials:
    """Check trials of one rig. The store keeps a control chart for each gain set."""

    def __init__(self, store: DaemonStore, settings: RigTable) -> None:
        self._store = store
        self._settings = settings
        self._chart = settings.watch.chart
        self._due_s: float | None = None

    def chart(self, name: GainSet) -> ChartState | None:
        """Control chart of a gain set, if it has one."""
        stored = (self._store.fact("charts") or {}).get(name.value)
        return ChartState(*stored) if stored else None

    def set_charts(self, charts: dict[GainSet, ChartState | None]) -> None:
        """Replaces all charts."""
        stored = {name.value: list(c) for name, c in charts.items() if c is not None}
        self._store.set_fact("charts", stored)
        self._due_s = None

    def drift(self, name: GainSet) -> float | None:
        """Deviation of the smoothed cost, as a fraction of the chart's limit."""
        state = self.chart(name)
        return None if state is None else state.smoothed / self._chart.limit

    def _alarm_costs(self, state: ChartState) -> tuple[float, float]:
        spread = self._chart.repeatability(state) * math.sqrt(1.0 + 1.0 / state.known)
        half = self._chart.outlier_limit * spread
        return math.exp(state.mean - half), math.exp(state.mean + half)

    def wait_s(self, name: GainSet) -> float:
        """Time until the next check trial."""
        state, every_s = self.chart(name), self._settings.watch.every_s
        if state is None or state.suspect or state.known < self._settings.watch.baseline_checks:
            return 0.0
        if self._due_s is None:
            # The time of day, which may jump, counts once; later the process's own clock does.
            remaining_s = max(0.0, every_s - self._age_of_last_s())
            self._due_s = time.monotonic() + min(every_s, remaining_s)
        return max(0.0, self._due_s - time.monotonic())

    @property
    def is_cooldown_over(self) -> bool:
        """Whether the last tuning is long enough ago for a drift to start the next."""
        ended = self._store.fact("run_ended_at")
        return ended is None or not 0.0 <= age_s(ended) < self._settings.watch.rest_s

    def run(
        self, rig: Rig, description: RigDescription, name: GainSet, gains: Gains
    ) -> CheckTrialResult:
        """Runs one check trial of a gain set that has a chart, and stores its result.

        Raises:
            RigError: the rig cannot be reached.
            Interrupted: the trial was cut off on a real rig.
            JournalError: the result cannot be stored; the same trial is requested again.
        """
        state = self.chart(name)
        assert state is not None, name  # noqa: S101  checked by the supervisor
        step, cost = self._settings.step.of(description), self._settings.cost.of(description)
        number, attempt = self._store.next_check()
        request = TrialRequest(f"{self._store.identity}-check", number, gains, step, attempt)
        self._store.begin_check(request)
        record = rig.run(request)
        alarm = self._alarm_costs(state)
        if record.outcome.is_void:
            self._store.finish_check(request, record, math.nan, None, alarm)
            check_cut_off(record, description)
            return CheckTrialResult(record, math.nan, None)
        eta = cost_of(record, step, cost, description.newtons_per_ampere)
        eta_max = self._settings.tuning.search["eta_max"] or UNSAFE_RATIO * math.exp(state.mean)
        eta = eta if math.isfinite(eta) and eta <= eta_max else math.inf
        updated, signal = self._chart.update(state, eta)
        with self._store.transaction():
            charts = self._store.fact("charts")
            self._store.set_fact("charts", {**charts, name.value: list(updated)})
            self._store.finish_check(request, record, eta, signal, alarm)
        self._due_s = time.monotonic() + self._settings.watch.every_s
        return CheckTrialResult(record, eta, signal)

    def _age_of_last_s(self) -> float:
        finished = [check.told_at for check in self._store.checks(1) if check.told_at]
        return age_s(finished[0]) if finished else math.inf
