"""Summary of a run: gains, improvement, intervals."""

import math
from dataclasses import dataclass, replace
from statistics import fmean, variance

from estune.core.comparison import Change, InterleavedRepeats, compare_costs
from estune.core.gains import Gains
from estune.run.plan import Plan
from estune.run.session import Session


@dataclass(frozen=True, slots=True)
class RunSummary:
    """Summary of a run.

    Attributes:
        gains: The gains to use: the tuned ones, or the initial ones without an improvement.
        cost: Their mean cost over the repeats.
        cost_error: Standard error of `cost`; zero without repeats.
        start_cost: Mean cost of the initial gains, from the confirmation if there was one.
        start_cost_error: Standard error of `start_cost`.
        change: Relative change of the cost from the initial to the tuned gains, with its 95 %
            confidence interval, from interleaved repeats; None if they were not compared.
        intervals: 95 % confidence interval of the optimum of each tuned parameter, by the tuner's
            cost model: name, lower and upper end in the parameter's unit. May be empty.
        unsafe: Unsafe trials of the run.
        declined: Declined trials of the run.
        improved: Whether the interval of the change lies below zero, or the initial gains break a
            limit that the tuned ones keep.
        message: The conclusion in a sentence.
        complete: Whether the run is complete; otherwise `gains` are the initial ones.
    """

    gains: Gains
    cost: float
    cost_error: float
    start_cost: float
    start_cost_error: float
    change: Change | None
    intervals: tuple[tuple[str, float, float], ...]
    unsafe: int
    declined: int
    improved: bool
    message: str
    complete: bool


def summarise(session: Session) -> RunSummary:
    """Summary of a run, complete or not."""
    plan, repeats = session.plan, session.confirmation
    complete = session.phase is None and not session.failure
    compared = repeats if complete and repeats is not None and len(repeats.safe) == 2 else None
    change = None if compared is None else compare_costs(compared.costs[0], compared.costs[1])
    improved = change is not None and change.is_decrease
    start_costs = session.baseline if compared is None else compared.costs[0]
    start = _mean(start_costs)
    best = _mean(compared.costs[1]) if compared is not None and improved else start
    return RunSummary(
        gains=compared.gains[1] if compared is not None and improved else plan.start,
        cost=best[0],
        cost_error=best[1],
        start_cost=start[0],
        start_cost_error=start[1],
        change=change,
        intervals=_intervals(session),
        unsafe=session.unsafe,
        declined=session.declined,
        improved=improved,
        message=_message(session, repeats, change)
        if complete
        else session.failure
        or f"stopped after {session.number} trials, before any gains were confirmed",
        complete=complete,
    )


def not_robust_summary(summary: RunSummary, plan: Plan, fault: str) -> RunSummary:
    """The summary of a run that improved the cost by gains that are not robust."""
    return replace(
        summary,
        gains=plan.start,
        cost=summary.start_cost,
        cost_error=summary.start_cost_error,
        improved=False,
        message=f"the tuned gains are not robust: {fault}; keep the initial gains",
    )


def within_limits_summary(summary: RunSummary, session: Session, broken: str) -> RunSummary:
    """The summary of a run whose initial gains break a limit that the confirmed ones keep."""
    repeats = session.confirmation
    assert repeats is not None  # noqa: S101  confirmed gains were repeated
    cost, error = _mean(repeats.costs[1])
    return replace(
        summary,
        gains=repeats.gains[1],
        cost=cost,
        cost_error=error,
        improved=True,
        message=f"the initial gains have {broken}, the tuned ones keep the limits; they change "
        f"the cost by {summary.change}; {session.search_end}",
    )


def _message(session: Session, repeats: InterleavedRepeats | None, change: Change | None) -> str:
    """The conclusion of a complete run."""
    if repeats is None:
        reason = (
            "all candidate gains were unsafe when repeated"
            if session.choice is not None and session.choice.best is None
            else "the search returned to the initial gains"
        )
        return f"{reason}; keep the initial gains; {session.search_end}"
    if change is None:
        which = "tuned" if repeats.safe == (0,) else "initial"
        reason = f"the {which} gains were unsafe when repeated: check the rig"
        return f"{reason}; nothing was confirmed; {session.search_end}"
    if change.is_decrease:
        start, cost = (fmean(costs) for costs in repeats.costs)
        return f"the cost fell from {start:.3g} to {cost:.3g}, {change}; {session.search_end}"
    return (
        f"no significant improvement: the best gains change the cost by {change}; "
        f"keep the initial gains; {session.search_end}"
    )


def _intervals(session: Session) -> tuple[tuple[str, float, float], ...]:
    convergence = session.plan.convergence(session.tuner_state)
    if convergence is None:
        return ()
    names = session.plan.tuner.space.names
    return tuple((n, *ends) for n, ends in zip(names, convergence.intervals, strict=True))


def _mean(costs: tuple[float, ...]) -> tuple[float, float]:
    """Mean and its standard error."""
    if not costs:
        return math.nan, 0.0
    return fmean(costs), math.sqrt(variance(costs) / len(costs)) if len(costs) > 1 else 0.0
