"""The loop of a tuning run: request, trial, cost, commit, next state."""

import math
import shlex
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from estune.errors import Interrupted, InvalidInput, JournalError, RigError, UnsafeStart
from estune.run import snapshot
from estune.run.approval import ApprovalCallback, approval_request
from estune.run.failed_trials import cut_off, declined, needs_operator, run_trial
from estune.run.first_trial import BACKWARDS, check_answer, moved_backwards
from estune.run.journal import CompletedTrial, Journal, JournalEntry
from estune.run.phase import Phase
from estune.run.plan import Plan
from estune.run.recorded import with_recorded
from estune.run.session import (
    Session,
    after_trial,
    extended_search,
    new_session,
    next_request,
    with_excitation,
)
from estune.run.showing_limits import showing_limits
from estune.run.start import first_record_fault
from estune.run.tally import is_unsafe
from estune.run.trial_quality import check_noise
from estune.run.tuning_run import TuningRun, adopt_first, keep_record, read_kept_records
from estune.support.blas import one_blas_thread
from estune.trial import Outcome, Rig, RigDescription, TrialRecord, TrialRequest
from estune.trial.applied_gains import applied_fault
from estune.trial.loop_records import loop_signals
from estune.trial.record_checks import request_fault
from estune.trial.scoring import constraint_margin, cost_of, unscored

CONSECUTIVE_VOID_MAX = 10
"""Consecutive void trials that end a run."""


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a run after a trial."""

    session: Session
    entry: JournalEntry
    unsafe: bool
    record: TrialRecord


ProgressListener = Callable[[Progress], None]
"""Callback after each committed trial; must not block."""


class Stopped(KeyboardInterrupt):
    """The user interrupted a run.

    Attributes:
        description: Description of the rig after the stop, with its live gains.
        folder: The run on disk, to be resumed; None without a journal.
        again: How to continue; empty where nothing can be.
    """

    def __init__(
        self, description: RigDescription, folder: Path | None, again: str | None = None
    ) -> None:
        live = description.gains_text(description.gains)
        super().__init__(f"stopped; {description.name} runs its live gains {live}")
        self.description = description
        self.folder = folder
        self.again = again or (f"estune resume {shlex.quote(str(folder))}" if folder else "")


def start(plan: Plan, description: RigDescription, journal: Journal | None) -> TuningRun:
    """A run before its first trial.

    Raises:
        InvalidInput: the rig would refuse the plan's step.
    """
    description.limits.check(plan.step)
    return TuningRun(plan, description, new_session(plan), [], journal, None, None)


@one_blas_thread()
def replay(plan: Plan, description: RigDescription, journal: Journal) -> TuningRun:
    """A run restored from its journal: its trials after the last snapshot are replayed.

    Raises:
        JournalError: the journal's trials differ from the ones this plan requests.
    """
    tuning = start(plan, description, journal)
    entries = list(journal.entries())
    tuning.entries = [entry for entry in entries if entry.outcome is not None]
    extensions = journal.fact("extensions") or []
    if not extensions:  # a snapshot is of one plan
        replayed, session = snapshot.read(journal, plan, tuning.entries)
        tuning.session, entries = session or tuning.session, entries[replayed:]
    for entry in entries:
        _extend_where_due(tuning, extensions)
        recorded = entry.trial_id, entry.gain_values
        requested = _requested(tuning.session)
        if requested is None:
            tuning.session = _shown_so_far(tuning, entry.number)
            requested = _requested(tuning.session)
        # The last digits of a fit differ between processors: the trial that ran is what counts.
        if requested != recorded:
            tuning.session = with_recorded(tuning.session, entry.gains)
            requested = _requested(tuning.session)
        if requested != recorded:
            raise JournalError(
                f"{journal.folder}: trial {entry.trial_id} with {entry.gains} is not what the "
                f"plan asks for ({requested}); the journal is of another version or was changed"
            )
        tuning.session = session_after(tuning, entry, journal)
    _extend_where_due(tuning, extensions)
    read_kept_records(tuning, journal)
    if tuning.first_record is not None:
        adopt_first(tuning, tuning.first_record)
    return tuning


def _shown_so_far(tuning: TuningRun, number: int) -> Session:
    """The session of a confirmed run with one more trial, by the trials before one."""
    assert tuning.journal is not None  # noqa: S101  its trials are replayed
    before = [entry for entry in tuning.entries if entry.number < number]
    known = TuningRun(
        tuning.plan, tuning.description, tuning.session, before, tuning.journal, None, None
    )
    read_kept_records(known, tuning.journal)
    return showing_limits(known)


def extend(tuning: TuningRun, trials: int) -> None:
    """Gives a run a greater number of search trials, and notes it in its journal.

    Raises:
        InvalidInput: the search took as many trials already, or the run cannot go on.
    """
    session, run = tuning.session, tuning.plan.run
    if session.failure:
        raise InvalidInput(f"run {run} cannot go on: {session.failure}")
    if trials <= session.search_trials:
        raise InvalidInput(
            f"trials is {trials}; the search of run {run} took {session.search_trials}: give more"
        )
    # The repeats are of gains chosen from this search: more of it could change the choice.
    if session.showing or session.phase in (Phase.CHOOSE, Phase.CONFIRM):
        raise InvalidInput(
            f"run {run} is confirming its gains; resume it without trials first, so that it ends"
        )
    if tuning.journal is not None:
        earlier = tuning.journal.fact("extensions") or []
        tuning.journal.note(extensions=[*earlier, [session.number, trials]], status="running")
    _set_trials(tuning, trials)


def _extend_where_due(tuning: TuningRun, extensions: Iterable[tuple[int, int]]) -> None:
    for number, trials in extensions:
        if number == tuning.session.number and not tuning.session.attempt:
            _set_trials(tuning, trials)


def _set_trials(tuning: TuningRun, trials: int) -> None:
    tuning.session = extended_search(tuning.session, trials)
    tuning.plan = tuning.session.plan


def _requested(session: Session) -> tuple[str, tuple[float, ...]] | None:
    """Trial and gains that the session asks for next."""
    request = next_request(session)
    return None if request is None else (request.trial_id, request.gains.as_tuple())


def session_after(tuning: TuningRun, entry: JournalEntry, journal: Journal) -> Session:
    """The session after a trial of the journal; the same if the trial is under way."""
    if entry.outcome is None:
        return tuning.session
    if tuning.plan.needs_records:
        record = journal.record(entry.trial_id)
        if not tuning.session.baseline:
            adopt_first(tuning, record)
        margin = constraint_margin(record, tuning.description)
        return _advanced(tuning, record, entry.cost, margin, entry.reason)
    told = entry.outcome, entry.cost, entry.margin
    return after_trial(tuning.session, *told, reason=entry.reason)


@one_blas_thread()
def run(
    tuning: TuningRun,
    rig: Rig,
    listeners: Iterable[ProgressListener] = (),
    ask: ApprovalCallback | None = None,
) -> None:
    """Runs the missing trials and commits each before the next one is requested.

    `tuning` is up to date throughout, also after an exception.

    Args:
        listeners: Called after each trial.
        ask: Approval callback, where the plan requires one. A declined trial is not run but
            committed as declined, and the run continues.

    Raises:
        InvalidInput: the plan requires approval, and there is no callback; or noise makes up too
            much of the cost.
        UnsafeStart: the initial gains are unsafe.
        RigError: the rig cannot be reached, or too many trials were void; the run can be resumed.
        Interrupted: a trial was interrupted on a rig that moves; to resume the run is to confirm
            that an operator has checked the rig.
        JournalError: a trial could not be committed; the run can be resumed.
        Stopped: the user interrupted it; the rig is back at its live gains.
    """
    if tuning.plan.ask_first and ask is None:
        raise InvalidInput(
            f"run {tuning.plan.run} needs approval of gains outside the region shown to be safe; "
            "give it an approval callback (ask=, or --ask at a terminal)"
        )
    listeners = tuple(listeners)
    consecutive_void = 0
    try:
        request = next_request(tuning.session)
        _commit(tuning, None, request)
        while request is not None:
            _check_posed(tuning)
            question = approval_request(tuning.session, request) if ask else None
            answer = ask(question) if ask and question else "yes"
            if answer == "always":
                ask = None
            if answer == "no":
                record = declined(request, tuning.description)
            else:
                extra = tuning.session.phase is Phase.EXCITE
                about, notes = tuning.description, tuning.journal
                record = run_trial(rig, request, about, notes=notes, may_be_refused=extra)
            request = _record_trial(tuning, request, record, listeners)
            consecutive_void = consecutive_void + 1 if record.outcome.is_void else 0
            if record.outcome.is_void:
                _check_void(tuning, record, consecutive_void)
    except KeyboardInterrupt:
        folder = tuning.journal.folder if tuning.journal else None
        raise Stopped(rig.abort(), folder) from None
    if tuning.session.failure:
        raise UnsafeStart(tuning.session.failure)


def _check_posed(tuning: TuningRun) -> None:
    """Refuses to search on a rig that does not answer, or by noise, unless forced."""
    session, first = tuning.session, tuning.first_record
    first_phases = (Phase.SEARCH, Phase.EXCITE)
    begins = session.phase in first_phases and session.number == len(session.baseline)
    if begins and first is not None and not tuning.plan.forced:
        check_answer(first, tuning.plan, tuning.description)
        check_noise(first, tuning.plan, tuning.description, session.baseline[0])


def _check_void(tuning: TuningRun, record: TrialRecord, consecutive: int) -> None:
    """Ends a run that must not repeat its void trial by itself."""
    folder = tuning.journal.folder if tuning.journal else None
    resume = "tune again"
    if folder:
        resume = f"continue with: estune resume {shlex.quote(str(folder))}"
    if needs_operator(record, tuning.description):
        raise Interrupted(cut_off(record), resume)
    if consecutive >= CONSECUTIVE_VOID_MAX:
        raise RigError(
            f"trial {record.trial_id} on rig {record.rig}: {consecutive} consecutive void trials "
            f"({record.reason}); "
            f"fix the cause, then {resume}"
        )


def _record_trial(
    tuning: TuningRun,
    request: TrialRequest,
    record: TrialRecord,
    listeners: tuple[ProgressListener, ...],
) -> TrialRequest | None:
    """Computes the cost of a trial, commits it, and advances the session.

    Returns:
        The next request.

    Raises:
        RigError: the rig ran another trial than requested; nothing is committed.
    """
    was_run = not record.outcome.is_void and record.outcome is not Outcome.DECLINED
    fault = request_fault(record, request, tuning.description) if was_run else ""
    if not (fault or tuning.session.baseline):
        adopt_first(tuning, record)
    if was_run and not tuning.plan.forced:
        fault = fault or applied_fault(record, tuning.description)
    if fault:
        raise RigError(
            f"the record of trial {request.trial_id} of rig {record.rig} is not of the trial that "
            f"was asked for: {fault}; check the rig's limits and its software"
        )
    plan, before = tuning.plan, tuning.session
    phase, cost, reason = before.phase or Phase.CONFIRM, math.nan, record.reason
    if phase is not Phase.EXCITE:
        cost = cost_of(record, plan.step, plan.cost, tuning.description.newtons_per_ampere)
        reason = reason or (unscored(record, plan.step) if math.isnan(cost) else "")
    cut_short = record.outcome in (Outcome.DIVERGED, Outcome.GUARD)
    if cut_short and phase is Phase.BASELINE and moved_backwards(record, plan, tuning.description):
        reason = f"{reason or record.outcome.sentence}; {BACKWARDS}"
    margin = constraint_margin(record, tuning.description)
    entry = JournalEntry(
        *(request.number, request.attempt, request.trial_id, phase, request.gains.as_tuple()),
        *(record.outcome, reason, cost, margin),
    )
    tuning.session = _advanced(tuning, record, cost, margin, reason)
    tuning.session = _showing_limits(tuning, entry, record)
    following = next_request(tuning.session)
    _commit(tuning, CompletedTrial(request, record, cost, margin, reason), following)
    tuning.entries.append(entry)
    keep_record(tuning, entry, record)
    if tuning.journal is not None:
        snapshot.write_if_due(tuning.journal, tuning.session, tuning.entries)
    unsafe = is_unsafe(phase, record.outcome, cost, before.eta_max)
    for listener in listeners:
        listener(Progress(tuning.session, entry, unsafe, record))
    return following


def _showing_limits(tuning: TuningRun, entry: JournalEntry, record: TrialRecord) -> Session:
    """The session with one more trial that shows its limits, by one that is not yet committed."""
    if tuning.session.phase is not None:
        return tuning.session
    known = replace(
        tuning,
        entries=[*tuning.entries, entry],
        recent_records=tuning.recent_records.copy(),
        excitations=[*tuning.excitations],
    )
    keep_record(known, entry, record)
    session = showing_limits(known)
    tuning.judged = known.judged
    return session


def _advanced(
    tuning: TuningRun, record: TrialRecord, cost: float, margin: float, reason: str
) -> Session:
    plan, rig, before = tuning.plan, tuning.description, tuning.session
    learning = before.phase in (Phase.BASELINE, Phase.SEARCH, Phase.EXCITE)
    first = not before.baseline
    needed = (plan.uses_records and learning) or (plan.start_source and first)
    signals = loop_signals(record, plan.step, rig).record if needed else None
    session = after_trial(before, record.outcome, cost, margin, signals, reason=reason)
    if plan.start_source and signals is not None and first and session.baseline:
        settling_time_s = plan.cost.settling_time_s
        fault = first_record_fault(signals, plan.start, rig.controller, settling_time_s)
        session = replace(session, failure=fault)
    return with_excitation(session, rig)


def _commit(
    tuning: TuningRun,
    done: CompletedTrial | None,
    following: TrialRequest | None,
) -> None:
    phase = tuning.session.phase
    if tuning.journal is not None and (done is not None or following is not None):
        next_trial = None if following is None or phase is None else (following, phase)
        tuning.journal.commit(done, next_trial)
