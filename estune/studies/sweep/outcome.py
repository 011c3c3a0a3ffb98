"""What a cell came to: the gains found, how surely, and whether they may be used."""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from estune.core.gains import GAIN_NAMES, Gains
from estune.core.quantities import FloatArray
from estune.run.result import RunEnding, TuneResult
from estune.run.session import Phase, is_unsafe
from estune.studies.law.tuned import TunedGains
from estune.studies.sweep.cell import Cell
from estune.tuners.convergence import ConvergenceEstimate, ModelBasedTuner

SETTLED = 0.05
"""A search has come to its end where no more than this share of the cost is left to gain."""

TRACE = ("search", *GAIN_NAMES, "cost", "unsafe")
"""Columns of a trace: whether it is a search trial, its gains, its cost, whether it was unsafe."""

_NORMAL_95 = 1.959964
"""Half the width of a 95 % interval, in standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class CellOutcome:
    """What became of one cell.

    Attributes:
        cell: The cell.
        ending: How its tuning ended; `failed` where it could not be run.
        message: How it ended, in a sentence.
        gains: The gains to use; the start's where nothing beat them, None where it failed.
        cost: Their mean cost; nan where there is none.
        cost_error: Its standard error.
        start_cost: Mean cost of the start gains.
        log_errors: Standard errors of (ln P, ln I, ln D, ln tau_F), or None where the tuner gives
            none; infinite for a gain along which the cost is flat up to its bounds.
        remaining: Share of the cost left to gain when the search ended, by the tuner's own word or
            as the cost still fell; infinite where nobody can tell.
        duration_s: How long it took, s.
        trace: Its trials in order, columns as in `TRACE`, shape (trials, 7).
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
    trace: FloatArray = field(default_factory=lambda: np.empty((0, len(TRACE))))

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
        """Whether the search had come to its end."""
        return self.remaining <= SETTLED

    @property
    def excluded(self) -> str:
        """Why a law leaves it out; empty where it does not."""
        if self.failed or not self.safe:
            return self.message
        if self.converged:
            return ""
        known = math.isfinite(self.remaining)
        left = f"{100.0 * self.remaining:.1f} % of the cost" if known else "nobody knows how much"
        return (
            f"the search had not come to its end: {left} may be left to gain (limit "
            f"{100.0 * SETTLED:g} %); give it more trials"
        )

    def tuned(self) -> TunedGains | None:
        """What it brings to a law over length; None where it could not be run."""
        if self.gains is None:
            return None
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


FAILED: Literal["failed"] = "failed"


def failed(cell: Cell, why: str, duration_s: float = 0.0) -> CellOutcome:
    """A cell that could not be run."""
    return CellOutcome(cell, FAILED, why, duration_s=duration_s)


def unsafe(cell: Cell, start: Gains, why: str, duration_s: float) -> CellOutcome:
    """A cell whose start gains are unsafe."""
    return CellOutcome(cell, str(RunEnding.UNSAFE_START), why, gains=start, duration_s=duration_s)


def finished(cell: Cell, result: TuneResult, duration_s: float) -> CellOutcome:
    """A cell whose tuning came to an end."""
    outlook, trace = _outlook(result), trace_of(result)
    if outlook is not None:
        left = outlook.remaining
    elif (
        isinstance(result.plan.tuner, ModelBasedTuner) or result.ending is RunEnding.NO_IMPROVEMENT
    ):
        left = math.inf
    else:
        left = _still_falling(trace)
    return CellOutcome(
        cell,
        str(result.ending),
        result.message,
        gains=result.gains,
        cost=result.verdict.cost,
        cost_error=result.verdict.cost_error,
        start_cost=result.verdict.start_cost,
        log_errors=None if outlook is None else _log_errors(result, outlook),
        remaining=left,
        duration_s=duration_s,
        trace=trace,
    )


def trace_of(result: TuneResult) -> FloatArray:
    """The trials that said something, shape (trials, 7)."""
    session = result.session
    rows = [
        (
            *(e.phase is Phase.SEARCH, *e.gains.as_tuple(), e.cost),
            is_unsafe(session, e.outcome, e.cost),
        )
        for e in result.entries
        if e.outcome is not None and not e.outcome.is_void
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, len(TRACE))


def _outlook(result: TuneResult) -> ConvergenceEstimate | None:
    """What the tuner itself makes of its search; None where it says nothing."""
    tuner = result.plan.tuner
    return (
        tuner.outlook(result.session.tuner_state) if isinstance(tuner, ModelBasedTuner) else None
    )


def _still_falling(trace: FloatArray) -> float:
    """How much the cost still fell, as a share, from the second third of the search to the last.

    For tuners that do not say what is left to gain. A fall within two standard errors is none.
    """
    safe = trace[(trace[:, 0] == 1.0) & (trace[:, -1] == 0.0), -2]
    thirds = np.array_split(safe, 3)
    before, after = thirds[1], thirds[2]
    if min(before.size, after.size) < 2:
        return math.inf
    fall = float(before.mean() - after.mean())
    error = math.sqrt(before.var(ddof=1) / before.size + after.var(ddof=1) / after.size)
    return max(0.0, fall / float(after.mean())) if fall > 2.0 * error else 0.0


def _log_errors(result: TuneResult, outlook: ConvergenceEstimate) -> tuple[float, ...] | None:
    """Standard errors of the logarithms of P, I, D and tau_F from the tuner's intervals.

    A gain whose interval reaches to both its bounds, or that was not tuned, is not known at all.
    None where the tuner searches the standard form.
    """
    space = result.plan.tuner.space
    if space.form != "parallel":
        return None
    errors = dict.fromkeys(GAIN_NAMES, math.inf)
    for name, (low, high), least, most in zip(
        space.names, outlook.intervals, space.low, space.high, strict=True
    ):
        if low > least * (1.0 + 1e-9) or high < most * (1.0 - 1e-9):
            errors[name] = math.log(high / low) / (2.0 * _NORMAL_95)
    return tuple(errors.values())
