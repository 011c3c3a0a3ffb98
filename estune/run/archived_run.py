"""A run as it was, whatever has become of its tuner since.

A run goes on by telling its trials again to its tuner, which works only while the tuner proposes
what it proposed then. To look at what a run came to needs no tuner: which gains were tried, chosen
and confirmed, and what each cost, is in its journal, and what the tuner knew at its end beside it.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Never

from estune.core.repeats import InterleavedRepeats
from estune.errors import JournalError
from estune.run import loop
from estune.run.journal import Journal, JournalEntry
from estune.run.loop import TuningRun
from estune.run.plan import description_from_json, plan_from_json
from estune.run.session import Phase, Session, is_censored, is_unsafe, new_session
from estune.run.summary import summarise
from estune.trial import Outcome
from estune.tuners import Observation, Point, SearchSpace, tuner_name, tuner_space

OTHERWISE = (
    "this version's tuner would go on otherwise; read it with the version that made it, or export "
    "its trials"
)


def finished(run: TuningRun) -> dict[str, Any]:
    """What is noted of a run that came to its end, for those who look at it later."""
    return {
        "status": "finished",
        "search_end": run.session.search_end,
        "intervals": summarise(run.session).intervals,
    }


def load_finished(journal: Journal) -> TuningRun:
    """A finished run from its journal alone.

    Raises:
        JournalError: the run had not come to its end, so that only its own version can go on; or
            its plan or its rig cannot be read.
    """
    values = journal.fact("plan")
    # Nobody is asked in a run that is over, for which a tuner would have to look ahead.
    plan = plan_from_json({**values, "ask_first": False}, _bygone(values["tuner"]))
    made = loop.start(plan, description_from_json(journal.fact("rig")), journal)
    told = [entry for entry in journal.entries() if entry.outcome is not None]
    made.entries.extend(told)
    made.session = _session(new_session(plan), told, journal.fact("search_end"))
    made.intervals = tuple((n, low, high) for n, low, high in journal.fact("intervals") or ())
    if journal.fact("status") != "finished" or made.session.phase is not None:
        raise JournalError(f"{journal.folder}: the run was not finished, and {OTHERWISE}")
    for entry in told:
        loop.keep(made, entry, journal.record(entry.trial_id))
    return made


class BygoneState(NamedTuple):
    """The best safe trial there was."""

    best_point: Point
    best_cost: float | None


@dataclass(frozen=True, slots=True)
class UnavailableTuner:
    """A tuner of another version, of which name and search space are left.

    Attributes:
        name: What it was called.
        space: What it tuned.
    """

    name: str
    space: SearchSpace

    def start(self) -> BygoneState:
        """The state before the first trial."""
        return BygoneState(self.space.start, None)

    def ask(self, state: BygoneState) -> Never:  # noqa: ARG002  it is a tuner to the eye alone
        """Nothing any more.

        Raises:
            JournalError: always.
        """
        raise JournalError(f"tuner {self.name} is of another version, and {OTHERWISE}")

    def tell(self, state: BygoneState, observation: Observation) -> Never:  # noqa: ARG002  as above
        """Takes nothing in any more.

        Raises:
            JournalError: always.
        """
        self.ask(state)

    def recommend(self, state: BygoneState) -> Point:
        """The best safe point tried."""
        return state.best_point


def _bygone(settings: dict[str, Any]) -> UnavailableTuner:
    """What is left of a stored tuner."""
    return UnavailableTuner(tuner_name(settings), tuner_space(settings))


def _session(session: Session, told: list[JournalEntry], search_end: str | None) -> Session:
    """Where a run stands after its trials, by their phases."""
    plan = session.plan
    costs = {phase: [e for e in told if e.phase is phase and _counts(e)] for phase in Phase}
    session = replace(
        session,
        number=len({e.number for e in told if _counts(e)}),
        baseline=tuple(e.cost for e in costs[Phase.BASELINE]),
        searched=len(costs[Phase.SEARCH]),
        search_end=search_end or f"the search took {len(costs[Phase.SEARCH])} trials",
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


def _repeats(session: Session, entries: list[JournalEntry]) -> InterleavedRepeats | None:
    """Repeats in turn, in the order in which their gains first came."""
    gains = tuple(dict.fromkeys(e.gains for e in entries))
    if len(gains) < 2:
        return None
    costs = tuple(
        tuple(math.inf if _censored(session, e) else e.cost for e in entries if e.gains == g)
        for g in gains
    )
    return InterleavedRepeats(gains, max(map(len, costs)), costs)


def _counts(entry: JournalEntry) -> bool:
    return entry.outcome is not None and not entry.outcome.is_void


def _censored(session: Session, entry: JournalEntry) -> bool:
    return entry.outcome is None or is_censored(session, entry.outcome, entry.cost)
