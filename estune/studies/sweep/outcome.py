"""Outcome of a cell: the gains found, their uncertainty, and whether they may be used."""

import math
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from estune.core.gains import GAIN_NAMES, Gains
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.run.ending import RunEnding
from estune.run.phase import Phase
from estune.run.tally import was_unsafe
from estune.studies.law.tuned import TunedGains
from estune.studies.sweep.cells import Cell
from estune.support.sqlite import FileKind, SqliteFile
from estune.tuners.interface import ConvergenceEstimate, PredictingTuner

if TYPE_CHECKING:
    from estune.run.results.result import TuneResult

CONVERGED_BELOW = 0.05
"""A search has converged if it may improve the cost by no more than this share of it."""

FAILED: Literal["failed"] = "failed"
"""Ending of a cell that could not be run."""

TRACE = ("search", *GAIN_NAMES, "cost", "unsafe")
"""Columns of a trace; search and unsafe are 0 or 1."""

KIND = FileKind(
    "a sweep's file",
    (
        """
CREATE TABLE cell (
    key TEXT PRIMARY KEY, label TEXT NOT NULL, ending TEXT NOT NULL, message TEXT NOT NULL,
    facts TEXT NOT NULL, trace BLOB NOT NULL, finished_at TEXT NOT NULL
) WITHOUT ROWID
""",
    ),
    "run the sweep again",
    lock_name="sweep.lock",
)
"""The file of a sweep; `estune.studies.sweep.store` writes it."""

_NORMAL_95 = 1.959964
"""Half the width of a 95 % interval of a normal distribution, in standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class CellOutcome:
    """Outcome of one cell.

    Attributes:
        ending: How its tuning ended; `failed` where it could not be run.
        gains: The gains to use; the initial ones where no others were better, None if it failed.
        cost: Their mean cost; nan without trials.
        start_cost: Mean cost of the initial gains.
        log_errors: Standard errors of (ln P, ln I, ln D, ln tau_F), or None where the tuner gives
            none; infinite for a gain along which the cost is flat up to its bounds.
        remaining: Remaining improvement when the search ended, relative to the cost; infinite
            where it is unknown.
        trace_source: Its trace, or the file of the sweep that holds it.
    """

    cell: Cell
    ending: str
    message: str
    gains: Gains | None = None
    cost: float = math.nan
    cost_error: float = math.nan
    start_cost: float = math.nan
    log_errors: tuple[float, ...] | None = None
    remaining: float = math.inf
    duration_s: float = 0.0
    trials: int = 0
    unsafe_trials: int = 0
    trace_source: FloatArray | Path = field(default_factory=lambda: np.empty((0, len(TRACE))))

    @property
    def trace(self) -> FloatArray:
        """Its trials in order, columns as in `TRACE`, shape (trials, 7); read when it is used."""
        return next(read_traces([self]))

    @property
    def failed(self) -> bool:
        """Whether it could not be run; a later call of the sweep tries again."""
        return self.ending == FAILED

    @property
    def safe(self) -> bool:
        """Whether its gains are safe to run."""
        return not self.failed and self.ending != RunEnding.UNSAFE_START

    @property
    def converged(self) -> bool:
        """Whether the search had converged."""
        return self.remaining <= CONVERGED_BELOW

    @property
    def excluded(self) -> str:
        """Why a law excludes it; empty where it does not."""
        if self.failed or not self.safe:
            return self.message
        if self.converged:
            return ""
        percent = f"{100.0 * self.remaining:.1f} %"
        share = percent if math.isfinite(self.remaining) else "an unknown share"
        return (
            f"the search did not converge: the remaining improvement is {share} of the cost "
            f"(limit {100.0 * CONVERGED_BELOW:g} %); give it more trials"
        )

    def tuned(self) -> TunedGains:
        """Its data point of a law over length.

        Raises:
            InvalidInput: it could not be run, and has no gains.
        """
        if self.gains is None:
            raise InvalidInput(f"{self.cell.label} has no gains: {self.message}")
        return TunedGains(
            label=self.cell.label,
            length_m=self.cell.length_m,
            tension_N=self.cell.tension_N,
            gains=self.gains,
            log_errors=self.log_errors,
            cost=self.cost,
            cost_error=self.cost_error,
            safe=self.safe,
            converged=self.converged,
        )


def read_traces(outcomes: Iterable[CellOutcome]) -> Iterator[FloatArray]:
    """The traces of outcomes, one after the other, so that few are in memory at once.

    Raises:
        JournalError: the file of the sweep cannot be read.
    """
    with ExitStack() as stack:
        files: dict[Path, SqliteFile] = {}
        for outcome in outcomes:
            source = outcome.trace_source
            if not isinstance(source, Path):
                yield source
                continue
            if source not in files:
                files[source] = stack.enter_context(SqliteFile.open_reader(source, KIND))
            ((data,),) = files[source].rows(
                "SELECT trace FROM cell WHERE key = ?", outcome.cell.key
            )
            yield np.frombuffer(data, "<f8").reshape(-1, len(TRACE))


def failed(cell: Cell, why: str, duration_s: float = 0.0) -> CellOutcome:
    """Outcome of a cell that could not be run."""
    return CellOutcome(cell, FAILED, why, duration_s=duration_s)


def unsafe(cell: Cell, start: Gains, why: str, duration_s: float) -> CellOutcome:
    """Outcome of a cell whose initial gains are unsafe."""
    return CellOutcome(cell, str(RunEnding.UNSAFE_START), why, gains=start, duration_s=duration_s)


def finished(cell: Cell, result: "TuneResult", duration_s: float) -> CellOutcome:
    """Outcome of a cell whose tuning ended by itself."""
    trace, tuner = _trace(result), result.plan.tuner
    estimate = None
    if isinstance(tuner, PredictingTuner):
        estimate = tuner.convergence(result.session.tuner_state)
        remaining = math.inf if estimate is None else estimate.remaining_improvement
    elif result.ending is RunEnding.NO_IMPROVEMENT:
        remaining = math.inf
    else:
        remaining = _late_decrease(trace)
    return CellOutcome(
        cell,
        str(result.ending),
        result.message,
        gains=result.gains,
        cost=result.verdict.cost,
        cost_error=result.verdict.cost_error,
        start_cost=result.verdict.start_cost,
        log_errors=None if estimate is None else _log_errors(result, estimate),
        remaining=remaining,
        duration_s=duration_s,
        trials=len(trace),
        unsafe_trials=int(trace[:, -1].sum()),
        trace_source=trace,
    )


def _trace(result: "TuneResult") -> FloatArray:
    """The trials that are not void, shape (trials, 7)."""
    eta_max = result.session.eta_max
    rows = [
        (e.phase is Phase.SEARCH, *e.gain_values, e.cost, was_unsafe(e, eta_max))
        for e in result.entries
        if e.outcome is not None and not e.outcome.is_void
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, len(TRACE))


def _late_decrease(trace: FloatArray) -> float:
    """Relative decrease of the cost from the second to the last third of the search.

    It stands in for the remaining improvement of tuners without a model. A decrease within two
    standard errors counts as zero.
    """
    safe = trace[(trace[:, 0] == 1.0) & (trace[:, -1] == 0.0), -2]
    _, before, after = np.array_split(safe, 3)
    if min(before.size, after.size) < 2:
        return math.inf
    decrease = float(before.mean() - after.mean())
    error = math.sqrt(before.var(ddof=1) / before.size + after.var(ddof=1) / after.size)
    return max(0.0, decrease / float(after.mean())) if decrease > 2.0 * error else 0.0


def _log_errors(result: "TuneResult", estimate: ConvergenceEstimate) -> tuple[float, ...] | None:
    """Standard errors of ln P, ln I, ln D and ln tau_F from the tuner's intervals.

    Infinite for a gain that was not tuned or whose interval spans all of its range; None where
    the tuner searches the standard form.
    """
    space = result.plan.tuner.space
    if space.form != "parallel":
        return None
    errors = dict.fromkeys(GAIN_NAMES, math.inf)
    for name, (low, high), least, most in zip(
        space.names, estimate.intervals, space.low, space.high, strict=True
    ):
        if low > least * (1.0 + 1e-9) or high < most * (1.0 - 1e-9):
            errors[name] = math.log(high / low) / (2.0 * _NORMAL_95)
    return tuple(errors.values())
