"""A run as it was, for a version whose tuner would have asked for other trials.

A run goes on by telling its trials again to its tuner, which works only while the tuner proposes
what it proposed then. To look at what a run came to needs no tuner: which gains were tried, chosen
and confirmed, and what each cost, is in its journal.
"""

import math
from dataclasses import replace

from estune import tuning
from estune.core.repeats import Repeats
from estune.errors import JournalError
from estune.journal import Entry, Journal
from estune.session import Phase, Plan, Session, begin, is_censored, is_unsafe
from estune.trial import Outcome, RigDescription
from estune.tuning import Tuning


def recalled(plan: Plan, description: RigDescription, journal: Journal) -> Tuning:
    """A finished run from its journal alone; what its tuner knew of the search is not recalled.

    Raises:
        JournalError: the run had not come to its end, so that only its own version can go on.
    """
    made = tuning.start(plan, description, journal)
    told = [entry for entry in journal.entries() if entry.outcome is not None]
    made.entries.extend(told)
    made.session = _session(begin(plan), told)
    if journal.fact("status") != "finished" or made.session.phase is not None:
        raise JournalError(
            f"{journal.folder}: the run was not finished, and this version's tuner would go on "
            "otherwise; read it with the version that made it, or export its trials"
        )
    for entry in told:
        tuning.keep(made, entry, journal.record(entry.trial_id))
    return made


def _session(session: Session, told: list[Entry]) -> Session:
    """Where a run stands after its trials, by their phases."""
    plan = session.plan
    costs = {phase: [e for e in told if e.phase is phase and _counts(e)] for phase in Phase}
    session = replace(
        session,
        number=len({e.number for e in told if _counts(e)}),
        baseline=tuple(e.cost for e in costs[Phase.BASELINE]),
        searched=len(costs[Phase.SEARCH]),
        search_end=f"the search took {len(costs[Phase.SEARCH])} trials",
    )
    safe = [e for e in costs[Phase.SEARCH] if not _censored(session, e)]
    if safe:
        best = min(safe, key=lambda e: e.cost)
        point = plan.tuner.space.point_of(best.gains)
        state = session.tuner_state._replace(best_point=point, best_cost=best.cost)
        session = replace(session, tuner_state=state)
    counted = [e for e in told if _counts(e)]
    return replace(
        session,
        unsafe=sum(is_unsafe(session, e.outcome, e.cost) for e in counted if e.outcome),
        declined=sum(e.outcome is Outcome.DECLINED for e in counted),
        choice=_repeats(session, costs[Phase.CHOOSE]),
        confirmation=_repeats(session, costs[Phase.CONFIRM]),
    )


def _repeats(session: Session, entries: list[Entry]) -> Repeats | None:
    """Repeats in turn, in the order in which their gains first came."""
    gains = tuple(dict.fromkeys(e.gains for e in entries))
    if len(gains) < 2:
        return None
    costs = tuple(
        tuple(math.inf if _censored(session, e) else e.cost for e in entries if e.gains == g)
        for g in gains
    )
    return Repeats(gains, max(map(len, costs)), costs)


def _counts(entry: Entry) -> bool:
    return entry.outcome is not None and not entry.outcome.is_void


def _censored(session: Session, entry: Entry) -> bool:
    return entry.outcome is None or is_censored(session, entry.outcome, entry.cost)
