"""A run in progress: where it stands, and the records that it keeps at hand."""

from collections import deque
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

from estune.core.comparison import Change
from estune.core.controller_form import ControllerForm
from estune.run.first_trial import adopted
from estune.run.journal import Journal, JournalEntry
from estune.run.phase import Phase
from estune.run.plan import Plan
from estune.run.session import Session
from estune.trial import Outcome, RigDescription, TrialRecord

RECENT_MAX = 20
"""Records that a run keeps at hand."""


@dataclass(slots=True)
class TuningRun:
    """A run in progress.

    Attributes:
        entries: Every completed trial, void ones too.
        first_record: Record of the first baseline trial, the response before tuning.
        tuned_record: Record of the last confirmation trial with the tuned gains.
        intervals: Stored confidence intervals of an archived run, as in
            `estune.run.results.summary.RunSummary`; None where the tuner computes them.
        recent_records: Records of the last step trials, void ones excluded.
        fitted_form: Form of the controller that the first record shows, where the rig declares
            none and does not run estune's own; the description and the plan have it.
        judged: What was last said of the confirmed gains (`robustness.verdict_on`), after
            the change of the cost and the number of trials that it is of; None before that.
    """

    plan: Plan
    description: RigDescription
    session: Session
    entries: list[JournalEntry]
    journal: Journal | None
    first_record: TrialRecord | None
    tuned_record: TrialRecord | None
    intervals: tuple[tuple[str, float, float], ...] | None = None
    recent_records: deque[TrialRecord] = field(default_factory=lambda: deque(maxlen=RECENT_MAX))
    excitations: list[TrialRecord] = field(default_factory=list)
    fitted_form: ControllerForm | None = None
    judged: tuple[Change | None, int, Any] | None = None


def adopt_first(tuning: TuningRun, record: TrialRecord) -> None:
    """Takes over what the first record shows of the rig."""
    before = tuning.description.controller.form
    tuning.plan, tuning.description = adopted(tuning.plan, tuning.description, record)
    tuning.session = replace(tuning.session, plan=tuning.plan)
    if tuning.description.controller.form != before:
        tuning.fitted_form = tuning.description.controller.form


def keep_record(tuning: TuningRun, entry: JournalEntry, record: TrialRecord) -> None:
    """Keeps the record of the first trial, and of the last that confirmed the tuned gains."""
    if record.outcome.is_void:
        return
    if entry.phase is Phase.EXCITE:
        if record.outcome is Outcome.DONE:
            tuning.excitations.append(record)
        return
    tuning.recent_records.append(record)
    if tuning.first_record is None:
        tuning.first_record = record
    elif entry.phase is Phase.CONFIRM and entry.gains != tuning.plan.start:
        tuning.tuned_record = record


def read_kept_records(tuning: TuningRun, journal: Journal) -> None:
    """Reads the records that `keep_record` keeps of a run's trials, and no others."""
    entries = [e for e in tuning.entries if e.outcome and not e.outcome.is_void]
    confirmed = (
        e for e in reversed(entries) if e.phase is Phase.CONFIRM and e.gains != tuning.plan.start
    )
    excited = (e for e in entries if e.phase is Phase.EXCITE)
    for entry in sorted({*entries[:1], *excited, *islice(confirmed, 1), *entries[-RECENT_MAX:]}):
        keep_record(tuning, entry, journal.record(entry.trial_id))
