"""Finished runs whose tuner is of another version.

A run resumes by a replay of its trials through its tuner, which needs the tuner of that version.
The result of a finished run needs no tuner: its gains, phases, costs and intervals are stored.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Never

from estune.core.comparison import InterleavedRepeats
from estune.errors import JournalError
from estune.run import loop
from estune.run.journal import Journal, JournalEntry
from estune.run.loop import TuningRun
from estune.run.planning import description_from_json, plan_from_json
from estune.run.session import Phase, Session, is_censored, is_unsafe, new_session
from estune.run.summary import summarise
from estune.trial import Outcome
from estune.tuners import Observation, Point, SearchSpace, tuner_name, tuner_space

_REMEDY = (
    "this version's tuner would continue differently; read it with the version that made it, or "
    "export its trials"
)


def finished(run: TuningRun) -> dict[str, Any]:
    """Facts of a finished run for the journal, with which `load_finished` works."""
    return {
        "status": "finished",
        "search_end": run.session.search_end,
        "intervals": summarise(run.session).intervals,
    }


def load_finished(journal: Journal) -> TuningRun:
    """A finished run from its journal alone.

    Raises:
        JournalError: the run is not finished, so that only its own version can resume it; or its
            plan or its rig cannot be read.
    """
    values = journal.fact("plan")
    tuner = UnavailableTuner(tuner_name(values["tuner"]), tuner_space(values["tuner"]))
    # Approval needs a tuner with predictions; a finished run asks for none.
    plan = plan_from_json({**values, "ask_first": False}, tuner)
    tuning = loop.start(plan, description_from_json(journal.fact("rig")), journal)
    entries = [entry for entry in journal.entries() if entry.outcome is not None]
    tuning.entries.extend(entries)
    tuning.session = _session(new_session(plan), entries, journal.fact("search_end"))
    tuning.intervals = tuple((n, low, high) for n, low, high in journal.fact("intervals") or ())
    if journal.fact("status") != "finished" or tuning.session.phase is not None:
        raise JournalError(f"{journal.folder}: the run was not finished, and {_REMEDY}")
    loop.read_kept_records(tuning, journal)
    return tuning


class _BestTrial(NamedTuple):
    """The best safe trial."""

    best_point: Point
    best_cost: float | None


@dataclass(frozen=True, slots=True)
class UnavailableTuner:
    """A tuner of another version: its name and search space, without its methods."""

    name: str
    space: SearchSpace

    def start(self) -> _BestTrial:
        """The state before the first trial."""
        return _BestTrial(self.space.start, None)

    def ask(self, state: _BestTrial) -> Never:  # noqa: ARG002  interface of Tuner
        """Raises JournalError."""
        raise JournalError(f"tuner {self.name} is of another version, and {_REMEDY}")

    def tell(self, state: _BestTrial, observation: Observation) -> Never:  # noqa: ARG002  as above
        """Raises JournalError."""
        self.ask(state)

    def recommend(self, state: _BestTrial) -> Point:
        """The best safe point."""
        return state.best_point


def _session(session: Session, entries: list[JournalEntry], search_end: str | None) -> Session:
    """The session at the end of a run, from the phases of its trials."""
    plan = session.plan
    costs = {phase: [e for e in entries if e.phase is phase and _counts(e)] for phase in Phase}
    session = replace(
        session,
        number=len({e.number for e in entries if _counts(e)}),
        baseline=tuple(e.cost for e in costs[Phase.BASELINE]),
        search_trials=len(costs[Phase.SEARCH]),
        search_end=search_end or f"the search took {len(costs[Phase.SEARCH])} trials",
    )
    safe = [e for e in costs[Phase.SEARCH] if not _censored(session, e)]
    if safe:
        best = min(safe, key=lambda e: e.cost)
        point = plan.tuner.space.point_of(best.gains)
        state = session.tuner_state._replace(best_point=point, best_cost=best.cost)
        session = replace(session, tuner_state=state)
    counted = [e for e in entries if _counts(e)]
    return replace(
        session,
        unsafe=sum(is_unsafe(session, e.outcome, e.cost) for e in counted if e.outcome),
        declined=sum(e.outcome is Outcome.DECLINED for e in counted),
        choice=_repeats(session, costs[Phase.CHOOSE]),
        confirmation=_repeats(session, costs[Phase.CONFIRM]),
    )


def _repeats(session: Session, entries: list[JournalEntry]) -> InterleavedRepeats | None:
    """Interleaved repeats, in the order in which their gains first came."""
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
