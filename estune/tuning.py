"""The loop that joins a session to a rig: ask, run, score, commit, tell."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from estune.core.gains import Gains
from estune.errors import Interrupted, JournalError, RigError, UnsafeStart
from estune.journal import Entry, Journal
from estune.score import cost_of
from estune.session import (
    Phase,
    Plan,
    Session,
    begin,
    is_censored,
    next_request,
    told,
)
from estune.trial import Outcome, Rig, RigDescription, TrialRecord, TrialRequest

VOID_IN_A_ROW = 10
"""So many trials in a row that came to nothing end a run: something keeps stopping them."""


@dataclass(frozen=True, slots=True)
class Progress:
    """What a run shows after each trial.

    Attributes:
        session: Where the run stands now.
        entry: The trial just told.
        censored: Whether that trial was unsafe.
        record: Its record.
    """

    session: Session
    entry: Entry
    censored: bool
    record: TrialRecord


Watcher = Callable[[Progress], None]
"""Told of each trial after it was committed; must return quickly."""


class Stopped(KeyboardInterrupt):
    """The user interrupted a run.

    Attributes:
        description: The rig as it said it is after the stop, with the gains that are live.
        folder: The run on disk, to be resumed; None if it was not journalled.
    """

    def __init__(self, description: RigDescription, folder: Path | None) -> None:
        super().__init__(f"stopped; {description.name} runs its live gains {description.gains}")
        self.description = description
        self.folder = folder


@dataclass(slots=True)
class Tuning:
    """A run under way.

    Attributes:
        plan: What decides the run.
        description: The rig as it was when the run began.
        session: Where the run stands.
        entries: Every trial told so far; void ones too.
        journal: Where it is committed, or None.
        first: Record of the first baseline trial, the response before tuning.
        kept: Records of confirmation trials, by their gains: the responses after tuning.
    """

    plan: Plan
    description: RigDescription
    session: Session
    entries: list[Entry]
    journal: Journal | None
    first: TrialRecord | None
    kept: dict[Gains, TrialRecord]


def start(plan: Plan, description: RigDescription, journal: Journal | None) -> Tuning:
    """A run before its first trial.

    Raises:
        InvalidInput: the rig would refuse the plan's step.
    """
    description.limits.check(plan.step)
    return Tuning(plan, description, begin(plan), [], journal, None, {})


def replay(plan: Plan, description: RigDescription, journal: Journal) -> Tuning:
    """A run as its journal left it: every trial told is told again, none is run.

    Raises:
        JournalError: the journal's trials are not the ones this plan asks for.
    """
    tuning = start(plan, description, journal)
    for entry in journal.entries():
        request = next_request(tuning.session)
        asked = request and (request.trial_id, request.gains)
        if asked != (entry.trial_id, entry.gains):
            raise JournalError(
                f"{journal.folder}: trial {entry.trial_id} with {entry.gains} is not what the "
                f"plan asks for ({asked}); the journal is of another version or was changed"
            )
        if entry.outcome is not None:
            tuning.entries.append(entry)
            keep = tuning.session.phase is not Phase.SEARCH and not entry.outcome.is_void
            if keep and (tuning.first is None or tuning.session.phase is Phase.CONFIRM):
                _keep(tuning, entry.gains, journal.record(entry.trial_id))
            tuning.session = told(tuning.session, entry.outcome, entry.cost)
    return tuning


def run(tuning: Tuning, rig: Rig, watchers: Iterable[Watcher] = ()) -> None:
    """Runs the trials that are still missing, committing each before the next is asked for.

    `tuning` is kept up to date throughout, so that a run that is interrupted can be looked at.

    Raises:
        UnsafeStart: the start gains are unsafe.
        RigError: the rig cannot be reached, or a trial was void too often; the run can be resumed.
        Interrupted: a trial was cut off on a rig that moves: to resume the run is to say that
            somebody has seen to it.
        JournalError: a trial could not be committed; the run can be resumed.
        Stopped: the user interrupted it; the rig is back at its live gains.
    """
    watchers = tuple(watchers)
    void_in_a_row = 0
    try:
        request = next_request(tuning.session)
        _commit(tuning, None, request)
        while request is not None:
            record = rig.run(request)
            request = _tell(tuning, request, record, watchers)
            void_in_a_row = void_in_a_row + 1 if record.outcome.is_void else 0
            if record.outcome.is_void:
                _check_void(tuning, record, void_in_a_row)
    except KeyboardInterrupt:
        folder = tuning.journal.folder if tuning.journal else None
        raise Stopped(rig.abort(), folder) from None
    if tuning.session.failure:
        raise UnsafeStart(tuning.session.failure)


def _check_void(tuning: Tuning, record: TrialRecord, in_a_row: int) -> None:
    """Stops a run whose next trial must not be asked for unasked."""
    folder = tuning.journal.folder if tuning.journal else None
    go_on = f"go on with: estune resume {folder}" if folder else "tune again"
    what = f"trial {record.trial_id} on rig {record.rig}"
    if record.outcome is Outcome.INTERRUPTED and not tuning.description.simulated:
        raise Interrupted(f"{what} was cut off ({record.reason}); see to the rig, then {go_on}")
    if in_a_row >= VOID_IN_A_ROW:
        raise RigError(
            f"{what} came to nothing, as did {in_a_row - 1} before it ({record.reason}); "
            f"see what stops them, then {go_on}"
        )


def _tell(
    tuning: Tuning, request: TrialRequest, record: TrialRecord, watchers: tuple[Watcher, ...]
) -> TrialRequest | None:
    """Scores and commits one trial, moves the session on, and gives the next request."""
    plan, before = tuning.plan, tuning.session
    cost = cost_of(record, plan.step, plan.cost, tuning.description.newtons_per_ampere)
    phase = before.phase or Phase.CONFIRM
    censored = is_censored(before, record.outcome, cost)
    entry = Entry(
        *(request.number, request.attempt, request.trial_id, phase, request.gains),
        outcome=record.outcome,
        reason=record.reason,
        cost=cost,
    )
    tuning.session = told(before, record.outcome, cost)
    following = next_request(tuning.session)
    _commit(tuning, (request, record, cost), following)
    tuning.entries.append(entry)
    if phase is Phase.CONFIRM or tuning.first is None:
        _keep(tuning, request.gains, record)
    for watcher in watchers:
        watcher(Progress(tuning.session, entry, censored, record))
    return following


def _commit(
    tuning: Tuning,
    done: tuple[TrialRequest, TrialRecord, float] | None,
    asked: TrialRequest | None,
) -> None:
    phase = tuning.session.phase
    if tuning.journal is not None and (done is not None or asked is not None):
        tuning.journal.commit(done, None if asked is None or phase is None else (asked, phase))


def _keep(tuning: Tuning, gains: Gains, record: TrialRecord) -> None:
    if tuning.first is None:
        tuning.first = record
    else:
        tuning.kept[gains] = record
