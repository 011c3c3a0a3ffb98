"""Finished runs as their journals state them.

A run resumes by a replay of its trials through its tuner, which needs the tuner of that version.
The result of a finished run needs neither: its gains, phases, costs and intervals are stored.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any, NamedTuple, Never

from estune.core.comparison import InterleavedRepeats
from estune.core.gains import Gains
from estune.errors import EstuneError, JournalError
from estune.run import loop
from estune.run.journal import Journal, JournalEntry
from estune.run.phase import Phase
from estune.run.plan import Plan
from estune.run.planning import description_from_json, plan_from_json
from estune.run.results.summary import summarise
from estune.run.session import Session, new_session
from estune.run.tally import was_safe
from estune.run.tuning_run import TuningRun, adopt_first, read_kept_records
from estune.support.garbage import collection_paused
from estune.trial import Outcome
from estune.tuners import Observation, Point, SearchSpace, tuner_name, tuner_space

_REMEDY = (
    "this version's tuner would continue differently; read it with the version that made it, or "
    "export its trials"
)


def finished(run: TuningRun) -> dict[str, Any]:
    """Facts of a finished run for the journal, with which `load_finished` works."""
    session = run.session
    compared = session.choice, session.confirmation
    return {
        "status": "finished",
        "search_end": session.search_end,
        "intervals": summarise(session).intervals,
        "compared": [[g.as_tuple() for g in r.gains] if r else [] for r in compared],
    }


def is_stored(journal: Journal) -> bool:
    """Whether the journal has all facts of a finished run; those of early versions lack some."""
    return journal.fact("status") == "finished" and journal.fact("compared") is not None


@collection_paused()
def load_finished(journal: Journal) -> TuningRun:
    """A finished run from its journal alone.

    Raises:
        JournalError: the run is not finished, so that only its own version can resume it; or its
            plan or its rig cannot be read.
    """
    plan = _plan(journal.fact("plan"))
    tuning = loop.start(plan, description_from_json(journal.fact("rig")), journal)
    tuning.entries = [entry for entry in journal.entries() if entry.outcome is not None]
    tuning.session = _session(new_session(plan), tuning.entries, journal)
    tuning.intervals = tuple((n, low, high) for n, low, high in journal.fact("intervals") or ())
    if journal.fact("status") != "finished" or tuning.session.phase is not None:
        raise JournalError(f"{journal.folder}: the run was not finished, and {_REMEDY}")
    read_kept_records(tuning, journal)
    if tuning.first_record is not None:
        adopt_first(tuning, tuning.first_record)
    return tuning


def _plan(values: dict[str, Any]) -> Plan:
    """The plan of a run, whether there is still such a tuner or not."""
    try:
        return plan_from_json(values)
    except EstuneError:
        tuner = UnavailableTuner(tuner_name(values["tuner"]), tuner_space(values["tuner"]))
        # Approval needs a tuner with predictions; a finished run asks for none.
        return plan_from_json({**values, "ask_first": False}, tuner)


class _BestTrial(NamedTuple):
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


def _session(session: Session, entries: list[JournalEntry], journal: Journal) -> Session:
    """The session at the end of a run, from the phases of its trials."""
    done = Outcome.DONE  # compared first: a run may have 100 000 trials
    counted = [e for e in entries if e.outcome is done or (e.outcome and not e.outcome.is_void)]
    search = [e for e in counted if e.phase is Phase.SEARCH]
    repeated_from = max((number for number, _ in journal.fact("extensions") or ()), default=0)
    others = [e for e in counted if e.phase is not Phase.SEARCH and _counts(e, repeated_from)]
    excited = [e for e in others if e.phase is Phase.EXCITE]
    session = replace(
        session,
        tally=session.tally.after((e.phase, e.outcome, e.cost) for e in entries if e.outcome),
        search_trials=len(search),
        excitations=tuple(e.number for e in excited if e.outcome is not Outcome.DECLINED),
        excitation_refused=any(e.outcome is Outcome.DECLINED for e in excited),
        search_end=journal.fact("search_end") or f"the search took {len(search)} trials",
    )
    eta_max = session.eta_max
    safe = [e for e in search if was_safe(e, eta_max)]
    if safe:
        best = min(safe, key=attrgetter("cost"))
        point = session.plan.tuner.space.point_of(best.gains)
        state = session.tuner_state._replace(best_point=point, best_cost=best.cost)
        session = replace(session, tuner_state=state)
    choice, confirmation = journal.fact("compared") or ((), ())
    return replace(
        session,
        choice=_repeats(session, [e for e in others if e.phase is Phase.CHOOSE], choice),
        confirmation=_repeats(session, _confirming(session, others), confirmation),
    )


def _counts(entry: JournalEntry, repeated_from: int) -> bool:
    """Whether a trial counts at the end of a run: not one that confirmed before an extension."""
    return entry.number >= repeated_from or entry.phase in (Phase.BASELINE, Phase.EXCITE)


def _confirming(session: Session, entries: list[JournalEntry]) -> list[JournalEntry]:
    """Trials of the confirmation, with those of the baseline where it does not begin with one."""
    found = [e for e in entries if e.phase is Phase.CONFIRM]
    if not found or found[0].gains == session.plan.start:
        return found
    return [*(e for e in entries if e.phase is Phase.BASELINE), *found]


def _repeats(
    session: Session, entries: list[JournalEntry], compared: Sequence[Sequence[float]]
) -> InterleavedRepeats | None:
    """Interleaved repeats of the gains compared; in early versions of those that were tried."""
    gains = tuple(Gains(*g) for g in compared) or tuple(dict.fromkeys(e.gains for e in entries))
    if len(gains) < 2:
        return None
    eta_max = session.eta_max
    costs = tuple(
        tuple(e.cost if was_safe(e, eta_max) else math.inf for e in entries if e.gains == g)
        for g in gains
    )
    # A confirmation ends as soon as its interval is narrow: within a round, as a rule.
    return InterleavedRepeats(gains, min(map(len, costs)), costs)
