"""The loop that joins a session to a rig: ask, run, score, commit, tell."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal, NamedTuple

from estune.errors import Interrupted, InvalidInput, JournalError, RigError, UnsafeStart
from estune.run.journal import Journal, JournalEntry
from estune.run.session import (
    Phase,
    Plan,
    Session,
    after_trial,
    forecast,
    is_unsafe,
    new_session,
    next_request,
)
from estune.trial import Outcome, Rig, RigDescription, TrialRecord, TrialRequest, empty_record
from estune.trial.scoring import constraint_margin, cost_of
from estune.tuners.interface import CostPrediction

VOID_IN_A_ROW = 10
"""So many trials in a row that came to nothing end a run: something keeps stopping them."""


@dataclass(frozen=True, slots=True)
class Progress:
    """What a run shows after each trial.

    Attributes:
        session: Where the run stands now.
        entry: The trial just told.
        unsafe: Whether that trial was unsafe.
        record: Its record.
    """

    session: Session
    entry: JournalEntry
    unsafe: bool
    record: TrialRecord


ProgressListener = Callable[[Progress], None]
"""Told of each trial after it was committed; must return quickly."""


class ApprovalRequest(NamedTuple):
    """What somebody is asked before gains are tried beyond what is known to be safe.

    Attributes:
        request: The trial that would be run.
        expected: What the tuner expects of it.
        eta_max: The cost above which it would count as unsafe.
    """

    request: TrialRequest
    expected: CostPrediction
    eta_max: float


Answer = Literal["yes", "no", "always"]
"""`always` is yes, and to whatever else would be asked until the run ends or is stopped."""

ApprovalCallback = Callable[[ApprovalRequest], Answer]
"""Asked before the trial of a question; may take its time."""


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
class TuningRun:
    """A run under way.

    Attributes:
        plan: What decides the run.
        description: The rig as it was when the run began.
        session: Where the run stands.
        entries: Every trial told so far; void ones too.
        journal: Where it is committed, or None.
        first: Record of the first baseline trial, the response before tuning.
        found: Record of the last trial that confirmed the gains found, the response after it.
        intervals: What the tuner knew of the gains at the end of a run that is only looked at, as
            in `estune.run.summary.RunSummary`; None where the tuner itself is there to be asked.
    """

    plan: Plan
    description: RigDescription
    session: Session
    entries: list[JournalEntry]
    journal: Journal | None
    first: TrialRecord | None
    found: TrialRecord | None
    intervals: tuple[tuple[str, float, float], ...] | None = None


def start(plan: Plan, description: RigDescription, journal: Journal | None) -> TuningRun:
    """A run before its first trial.

    Raises:
        InvalidInput: the rig would refuse the plan's step.
    """
    description.limits.check(plan.step)
    return TuningRun(plan, description, new_session(plan), [], journal, None, None)


def replay(plan: Plan, description: RigDescription, journal: Journal) -> TuningRun:
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
            record = journal.record(entry.trial_id)
            tuning.entries.append(entry)
            keep(tuning, entry, record)
            margin = constraint_margin(record, description)
            tuning.session = after_trial(tuning.session, entry.outcome, entry.cost, margin)
    return tuning


def run(
    tuning: TuningRun,
    rig: Rig,
    watchers: Iterable[ProgressListener] = (),
    ask: ApprovalCallback | None = None,
) -> None:
    """Runs the trials that are still missing, committing each before the next is asked for.

    `tuning` is kept up to date throughout, so that a run that is interrupted can be looked at.

    Args:
        tuning: The run.
        rig: Where its trials are run.
        watchers: Told of each trial.
        ask: Asked where the plan wants somebody to agree. A trial that is declined is not run, and
            is committed as such, so that the run goes on from it like from any other.

    Raises:
        InvalidInput: the plan wants somebody to agree, and there is nobody to be asked.
        UnsafeStart: the start gains are unsafe.
        RigError: the rig cannot be reached, or a trial was void too often; the run can be resumed.
        Interrupted: a trial was cut off on a rig that moves: to resume the run is to say that
            somebody has seen to it.
        JournalError: a trial could not be committed; the run can be resumed.
        Stopped: the user interrupted it; the rig is back at its live gains.
    """
    if tuning.plan.ask_first and ask is None:
        raise InvalidInput(
            f"run {tuning.plan.run} asks before it leaves what is known to be safe, and there is "
            "nobody to ask: give it somebody (ask=, or --ask at a terminal)"
        )
    watchers = tuple(watchers)
    void_in_a_row = 0
    try:
        request = next_request(tuning.session)
        _commit(tuning, None, request)
        while request is not None:
            question = _question(tuning, request) if ask else None
            answer = ask(question) if ask and question else "yes"
            if answer == "always":
                ask = None
            record = rig.run(request) if answer != "no" else _declined(tuning, request)
            request = _record_trial(tuning, request, record, watchers)
            void_in_a_row = void_in_a_row + 1 if record.outcome.is_void else 0
            if record.outcome.is_void:
                _check_void(tuning, record, void_in_a_row)
    except KeyboardInterrupt:
        folder = tuning.journal.folder if tuning.journal else None
        raise Stopped(rig.abort(), folder) from None
    if tuning.session.failure:
        raise UnsafeStart(tuning.session.failure)


def _question(tuning: TuningRun, request: TrialRequest) -> ApprovalRequest | None:
    """What is to be asked before the next trial; None where nothing is."""
    expected = forecast(tuning.session) if tuning.plan.ask_first else None
    if expected is None or expected.explored:
        return None
    return ApprovalRequest(request, expected, tuning.session.eta_max)


def _declined(tuning: TuningRun, request: TrialRequest) -> TrialRecord:
    outcome = Outcome.DECLINED
    at = datetime.now(UTC).isoformat(timespec="milliseconds")
    return empty_record(request, tuning.description, outcome, outcome.sentence, at)


def _check_void(tuning: TuningRun, record: TrialRecord, in_a_row: int) -> None:
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


def _record_trial(
    tuning: TuningRun,
    request: TrialRequest,
    record: TrialRecord,
    watchers: tuple[ProgressListener, ...],
) -> TrialRequest | None:
    """Scores and commits one trial, moves the session on, and gives the next request."""
    plan, before = tuning.plan, tuning.session
    cost = cost_of(record, plan.step, plan.cost, tuning.description.newtons_per_ampere)
    phase = before.phase or Phase.CONFIRM
    entry = JournalEntry(
        *(request.number, request.attempt, request.trial_id, phase, request.gains),
        outcome=record.outcome,
        reason=record.reason,
        cost=cost,
    )
    margin = constraint_margin(record, tuning.description)
    tuning.session = after_trial(before, record.outcome, cost, margin)
    following = next_request(tuning.session)
    _commit(tuning, (request, record, cost), following)
    tuning.entries.append(entry)
    keep(tuning, entry, record)
    unsafe = is_unsafe(before, record.outcome, cost)
    for watcher in watchers:
        watcher(Progress(tuning.session, entry, unsafe, record))
    return following


def _commit(
    tuning: TuningRun,
    done: tuple[TrialRequest, TrialRecord, float] | None,
    asked: TrialRequest | None,
) -> None:
    phase = tuning.session.phase
    if tuning.journal is not None and (done is not None or asked is not None):
        tuning.journal.commit(done, None if asked is None or phase is None else (asked, phase))


def keep(tuning: TuningRun, entry: JournalEntry, record: TrialRecord) -> None:
    """Keeps the first trial with the start, and the last that confirmed the gains found."""
    if record.outcome.is_void:
        return
    if tuning.first is None:
        tuning.first = record
    elif entry.phase is Phase.CONFIRM and entry.gains != tuning.plan.start:
        tuning.found = record
