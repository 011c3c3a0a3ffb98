"""Check trials of the gains that are live, held to a control chart."""

import math
import time
from datetime import UTC, datetime
from typing import NamedTuple

from estune.core.control_chart import ChartSignal, ChartState
from estune.core.gains import Gains
from estune.daemon.config import RigTable
from estune.daemon.store import DaemonStore
from estune.daemon.supervisor_state import GainSet
from estune.errors import Interrupted
from estune.run.session import UNSAFE_RATIO
from estune.trial import Outcome, Rig, RigDescription, TrialRecord, TrialRequest
from estune.trial.scoring import cost_of


class CheckTrialResult(NamedTuple):
    """What a check trial came to.

    Attributes:
        record: Its record.
        cost: Its cost; infinite where it was unsafe, nan where it was void.
        sign: What the chart says; None where it was void.
    """

    record: TrialRecord
    cost: float
    sign: ChartSignal | None


class CheckTrials:
    """The check trials of one rig. The charts of gain sets are kept in the store, by name."""

    def __init__(self, store: DaemonStore, settings: RigTable) -> None:
        self._store = store
        self._settings = settings
        self._chart = settings.watch.chart
        self._due_s: float | None = None

    def chart(self, name: GainSet) -> ChartState | None:
        """The chart of a gain set, if it has one."""
        kept = (self._store.fact("charts") or {}).get(name.value)
        return ChartState(*kept) if kept else None

    def set_charts(self, charts: dict[GainSet, ChartState | None]) -> None:
        """Keeps charts in place of all there were."""
        self._store.put("charts", {n.value: list(c) for n, c in charts.items() if c is not None})
        self._due_s = None

    def drift(self, name: GainSet) -> float | None:
        """How far the smoothed cost is off, as a share of the chart's limit."""
        state = self.chart(name)
        return None if state is None else state.smoothed / self._chart.limit

    def wait_s(self, name: GainSet) -> float:
        """Time until the next check trial."""
        state, every_s = self.chart(name), self._settings.watch.every_s
        if state is None or state.suspect or state.known < self._settings.watch.baseline_checks:
            return 0.0
        if self._due_s is None:
            # Only once by the time of day, which may jump; within the process by a clock that
            # does not.
            self._due_s = time.monotonic() + min(
                every_s, max(0.0, every_s - self._age_of_last_s())
            )
        return max(0.0, self._due_s - time.monotonic())

    @property
    def is_cooldown_over(self) -> bool:
        """Whether the last tuning is long enough ago for a drift to start the next."""
        ended = self._store.fact("run_ended_at")
        return ended is None or not 0.0 <= _age_s(ended) < self._settings.watch.rest_s

    def run(
        self, rig: Rig, about: RigDescription, name: GainSet, gains: Gains
    ) -> CheckTrialResult:
        """Runs one check trial, and keeps what it came to.

        Raises:
            RigError: the rig cannot be asked.
            Interrupted: it was cut off on a rig that moves.
            JournalError: it cannot be kept; the same trial is asked for again.
        """
        state = self.chart(name)
        assert state is not None, name  # noqa: S101  the keeper looked
        step, cost = self._settings.step.of(about), self._settings.cost.of(about)
        number, attempt = self._store.next_check()
        request = TrialRequest(f"{self._store.identity}-check", number, gains, step, attempt)
        self._store.ask_check(request)
        record = rig.run(request)
        if record.outcome.is_void:
            self._store.tell_check(request, record, math.nan, None)
            if record.outcome is Outcome.INTERRUPTED and not about.simulated:
                raise Interrupted(
                    f"check trial {record.trial_id} was cut off ({record.reason}); "
                    "see to the rig, then resume"
                )
            return CheckTrialResult(record, math.nan, None)
        eta = cost_of(record, step, cost, about.newtons_per_ampere)
        eta_max = self._settings.tuning.eta_max or UNSAFE_RATIO * math.exp(state.mean)
        eta = eta if math.isfinite(eta) and eta <= eta_max else math.inf
        told, sign = self._chart.update(state, eta)
        with self._store.writing():
            charts = self._store.fact("charts")
            self._store.put("charts", {**charts, name.value: list(told)})
            self._store.tell_check(request, record, eta, sign)
        self._due_s = time.monotonic() + self._settings.watch.every_s
        return CheckTrialResult(record, eta, sign)

    def _age_of_last_s(self) -> float:
        told = [check.told_at for check in self._store.checks(1) if check.told_at]
        return _age_s(told[0]) if told else math.inf


def _age_s(at: str) -> float:
    """Time passed since, by the time of day; below zero if that was set back."""
    return (datetime.now(UTC) - datetime.fromisoformat(at)).total_seconds()
