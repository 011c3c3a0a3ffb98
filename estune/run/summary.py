"""What a run came to: the gains to use, and what they gain, with what is known of either."""

import math
from dataclasses import dataclass
from statistics import fmean, variance

from estune.core.comparison import Change, compare_costs
from estune.core.gains import Gains
from estune.core.repeats import InterleavedRepeats
from estune.run.session import Session


@dataclass(frozen=True, slots=True)
class RunSummary:
    """What a run came to.

    Attributes:
        gains: The gains to use: the ones found, or the start where they did not beat it.
        cost: Their mean cost over the repeats.
        cost_error: Standard error of that mean; zero without repeats.
        start_cost: Mean cost of the start gains, over the repeats beside those of the gains found
            where there are such.
        start_cost_error: Standard error of that mean.
        change: By how much the cost of the gains found differs from the start's, with its 95 %
            interval, from repeats of the two in turn; None where they were not compared.
        intervals: 95 % interval of the optimum of each tuned parameter, by the tuner's own model:
            name, lower and upper end in the parameter's unit. Empty where it has none.
        unsafe: Unsafe trials of the run.
        declined: Trials that were declined.
        improved: Whether the interval of the change lies below zero.
        message: The verdict in a sentence.
        complete: Whether the run came to its end; otherwise `gains` are the start.
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
    """What the run came to, so far as it went."""
    plan, repeats = session.plan, session.confirmation
    complete = session.phase is None and not session.failure
    compared = repeats if complete and repeats is not None and len(repeats.safe) == 2 else None
    found = None if compared is None else compare_costs(compared.costs[0], compared.costs[1])
    improved = found is not None and found.is_decrease
    start_costs = session.baseline if compared is None else compared.costs[0]
    start = _mean(start_costs)
    best = _mean(compared.costs[1]) if compared is not None and improved else start
    return RunSummary(
        gains=compared.gains[1] if compared is not None and improved else plan.start,
        cost=best[0],
        cost_error=best[1],
        start_cost=start[0],
        start_cost_error=start[1],
        change=found,
        intervals=_intervals(session),
        unsafe=session.unsafe,
        declined=session.declined,
        improved=improved,
        message=_message(session, repeats, found) if complete else _unfinished(session),
        complete=complete,
    )


def _message(session: Session, repeats: InterleavedRepeats | None, found: Change | None) -> str:
    """How a run ended that came to its end."""
    if repeats is None:
        said = (
            "every set of gains there was to choose from was unsafe when it was repeated"
            if session.choice is not None and session.choice.best is None
            else "the search came back to the start"
        )
        return f"{said}; keep the start; {session.search_end}"
    if found is None:
        which = "gains found" if repeats.safe == (0,) else "start gains"
        said = f"the {which} were unsafe when they were repeated: see to the rig"
        return f"{said}; nothing was confirmed; {session.search_end}"
    if found.is_decrease:
        start, cost = (fmean(costs) for costs in repeats.costs)
        return f"the cost fell from {start:.3g} to {cost:.3g}, {found}; {session.search_end}"
    return (
        f"no significant improvement: the gains found cost {found} against the start; "
        f"keep the start; {session.search_end}"
    )


def _unfinished(session: Session) -> str:
    """Why there is nothing to go by."""
    return (
        session.failure
        or f"stopped after {session.number} trials, before any gains were confirmed"
    )


def _intervals(session: Session) -> tuple[tuple[str, float, float], ...]:
    outlook = session.plan.outlook(session.tuner_state)
    if outlook is None:
        return ()
    names = session.plan.tuner.space.names
    return tuple((n, *ends) for n, ends in zip(names, outlook.intervals, strict=True))


def _mean(costs: tuple[float, ...]) -> tuple[float, float]:
    """Mean and its standard error."""
    if not costs:
        return math.nan, 0.0
    return fmean(costs), math.sqrt(variance(costs) / len(costs)) if len(costs) > 1 else 0.0
