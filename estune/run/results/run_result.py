"""Result of a run as numbers, words, tables and figures."""

import itertools
import math
from collections import Counter
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult

from estune.core.comparison import Change, repeatability
from estune.core.controller_form import ControllerForm
from estune.core.gains import GAIN_NAMES, Gains
from estune.core.metrics import NO_METRICS
from estune.errors import JournalError
from estune.loop_model.claim import Claim, unexplained
from estune.loop_model.load_rejection import LoadRejection, load_rejection
from estune.run.behaviour import (
    Measured,
    behaviour_remarks,
    behaviour_rows,
    measure_all,
    stored_behaviour,
)
from estune.run.ending import RunEnding
from estune.run.journal import Journal, JournalEntry
from estune.run.labels import ListedNumbers
from estune.run.limit_verdict import LimitVerdict, measured_overshoot
from estune.run.phase import Phase
from estune.run.plan import Plan
from estune.run.results import result_warnings
from estune.run.results.sentences import (
    bounds_reached,
    claimed_robustness,
    load_cells,
    load_remarks,
    load_stays,
    response_changes,
    start_remarks,
    trial_remark,
)
from estune.run.results.summary import (
    INTERVALS_ARE,
    Performance,
    RunSummary,
)
from estune.run.robustness import (
    IdentifiedLoop,
    claim_from,
    identify,
    limit_price,
    robustness_cells,
)
from estune.run.session import Session
from estune.run.tally import was_safe, was_unsafe
from estune.run.trial_quality import quality_remarks
from estune.trial import Rig, RigDescription, TrialRecord
from estune.trial.scoring import constraint_margin
from estune.tuners.identified_loop_state import fit_of

if TYPE_CHECKING:
    import pandas as pd


class ResultRow(NamedTuple):
    """Row of the before/after table; `tuned` is empty without an improvement."""

    label: str
    start: str
    tuned: str


class RunResult(OptimizeResult):  # type: ignore[misc]  # scipy ships no type information
    """The result of a run, finished or not, as numbers.

    Attributes:
        x: The gains to use, shape (4,): P, I, D, setpoint_filter_s.
        fun: Their mean cost.
        nit: Number of search trials.
        nfev: Number of all trials, void ones too.
        success: Whether the improvement is statistically significant.
        status: 0 tuned, 1 no significant improvement, 2 stopped, 3 unsafe start, 4 not robust, 5
            tuned but limits not shown, 6 tuned but a limit is broken.
        message: How the run ended, in a sentence.
        ending: How the run ended.
        gains: The gains to use; the initial ones without a significant improvement.
        limits: Whether the tuned gains keep the limits of the run; None without tuned gains.
        fitted_form: Form of the rig's controller by its logged effort, where the rig declares none
            and does not run estune's own.
        entries: Every completed trial, void ones too.
        folder: The run on disk, or None.
        first_record: Record of the first trial with the initial gains, or None.
        tuned_record: Record of the last confirmation trial with the tuned gains, or None.
        improvement: Relative change of the cost from the initial gains, with its 95 % confidence
            interval; None if they were not compared.
        recent_records: Records of the last step trials.
    """

    x: "np.ndarray[tuple[int], np.dtype[np.float64]]"
    fun: float
    nit: int
    nfev: int
    success: bool
    status: int
    message: str
    ending: RunEnding
    gains: Gains
    start_gains: Gains
    verdict: RunSummary
    limits: LimitVerdict | None
    fitted_form: ControllerForm | None
    entries: tuple[JournalEntry, ...]
    folder: Path | None
    plan: Plan
    rig: RigDescription
    first_record: TrialRecord | None
    tuned_record: TrialRecord | None
    improvement: Change | None
    unsafe: int
    session: Session
    recent_records: tuple[TrialRecord, ...]
    excitations: tuple[TrialRecord, ...]

    @cached_property
    def claim(self) -> Claim:
        """Robustness of the gains to use as the records show it, or why nothing is claimed."""
        return claim_from(self.identified, self.plan, self.rig, self.gains)

    @cached_property
    def identified(self) -> IdentifiedLoop:
        """The loop identified from the last records."""
        own = fit_of(self.session.tuner_state)
        records, excited = self.recent_records, self.excitations
        return identify(records, excited, self.plan, self.rig, own=own, gains=self.gains)

    def load_rejection(self, gains: Gains) -> LoadRejection | None:
        """What a load step does with some gains, by the identified loop; None without one."""
        fit, cost = self.identified.fit, self.plan.cost
        if fit is None or not fit.responds:
            return None
        return load_rejection(
            *(fit.model, gains, self.rig.controller, self.plan.step.step_N, cost.settling_time_s)
        )

    @cached_property
    def rejections(self) -> dict[str, LoadRejection | None]:
        """What a load step does with the initial gains, `start`, and the `tuned` ones."""
        gains = {"start": self.start_gains} | ({"tuned": self.gains} if self.tuned else {})
        return {name: self.load_rejection(one) for name, one in gains.items()}

    @cached_property
    def start(self) -> Performance:
        """Performance of the start gains."""
        summary = self.verdict
        cost = summary.start_cost, summary.start_cost_error
        performance = Performance.on(
            self.rig, self.plan.step, self.start_gains, cost, record=self.first_record
        )
        return self._with_mean_overshoot(performance)

    @cached_property
    def tuned(self) -> Performance | None:
        """Performance of the tuned gains, or None."""
        if not self.success:
            return None
        summary = self.verdict
        performance = Performance.on(
            *(self.rig, self.plan.step, self.gains, (summary.cost, summary.cost_error)),
            record=self.tuned_record,
            intervals=summary.intervals,
        )
        return self._with_mean_overshoot(performance)

    def _with_mean_overshoot(self, performance: Performance) -> Performance:
        """The performance with the overshoot of all records with its gains, as limits judge it."""
        records = self.identified.undisturbed(self.recent_records)
        mean = measured_overshoot(self.plan, performance.gains, records)
        if mean is None or performance.metrics is None:
            return performance
        return replace(performance, metrics=performance.metrics._replace(overshoot=mean.value))

    @cached_property
    def behaviour(self) -> Measured:
        """Tracking and rest at the `start` and the `tuned` gains; empty where not asked for."""
        if self.folder is None:
            return {}
        with Journal.open(self.folder) as journal:
            return stored_behaviour(journal)

    def measure_behaviour(self, rig: Rig, journal: Journal | None) -> None:
        """Measures it on the rig, after the tuning."""
        gains = {"start": self.start_gains} | ({"tuned": self.gains} if self.success else {})
        found = measure_all(rig, self.rig, self.plan.run, gains, journal)
        self.__dict__["behaviour"] = found  # the cached property
        if journal is not None:
            journal.note(behaviour=found)

    @cached_property
    def findings(self) -> tuple[result_warnings.ResultWarning, ...]:
        """Warnings: low margins, a response near a limit, gains at a bound, a flat cost.

        Without an improvement the search need not have covered the initial gains, so that only
        the flat directions that it did find are reported.
        """
        if not self.verdict.complete:
            return ()
        at, session, space = self.tuned or self.start, self.session, self.plan.tuner.space
        eta_max = session.eta_max  # a mean over the baseline: once, for runs are long
        safe = [e for e in self.entries if e.phase is not Phase.EXCITE and was_safe(e, eta_max)]
        best = space.point_of(at.gains)
        repeated = [r.costs for r in (session.choice, session.confirmation) if r is not None]
        flat = result_warnings.flat_directions(
            *(space, best, at.cost),
            points=space.points_of(np.array([e.gain_values for e in safe])),
            costs=np.array([e.cost for e in safe]),
            noise=at.cost * repeatability((session.baseline, *itertools.chain(*repeated))),
            units=self.rig.gain_units,
        )
        if self.plan.uses_records:  # the search is too short to vary the cost, and needs not to
            flat = ()
        elif self.tuned is None:
            flat = tuple(finding for finding in flat if finding.kind == "flat")
        share = math.inf if at.record is None else constraint_margin(at.record, self.rig)
        near = result_warnings.low_margins(
            at.margins, limited=self._limited, by_records=self.plan.uses_records
        ) + result_warnings.near_limits(
            share, f"{self.rig.measurement_name} or {self.rig.command_name}"
        )
        return near + result_warnings.at_bounds(space, best, self.rig.gain_units) + flat

    @property
    def _limited(self) -> bool:
        """Whether a limit of the sensitivity judges the result."""
        limits = self.plan.limits
        return limits is not None and bool(limits.max_sensitivity)

    @property
    def trials_text(self) -> str:
        """The number of trials, and how many of each phase and void ones it is made of."""
        void = sum(1 for e in self.entries if e.outcome is None or e.outcome.is_void)
        counts = Counter(e.phase for e in self.entries if e.outcome and not e.outcome.is_void)
        repeats = counts[Phase.CHOOSE] + counts[Phase.CONFIRM]
        parts = [(counts[Phase.BASELINE], "initial"), (counts[Phase.SEARCH], "search")]
        parts += [(counts[Phase.EXCITE], "exciting")]
        parts += [(repeats, "repeats"), (void, "void")]
        listed = ", ".join(f"{count} {what}" for count, what in parts if count)
        total = len(self.entries)
        return f"{total} trial{'' if total == 1 else 's'}{f' ({listed})' if listed else ''}"

    @property
    def listed_numbers(self) -> ListedNumbers:
        """Response and Ms with the gains to use, costs and ending, for a list of runs."""
        known = (self.tuned or self.start).metrics or NO_METRICS
        rise_s, overshoot, start_cost = (
            x if math.isfinite(x) else None
            for x in (known.rise_time_s, known.overshoot, self.verdict.start_cost)
        )
        Ms = None if self.claim.margins is None else self.claim.margins.sensitivity.value
        cost = float(self.fun) if self.success else None
        return ListedNumbers(rise_s, overshoot, Ms, start_cost, cost, self.ending)

    def heading(self) -> str:
        """The run in one line, its ending first."""
        if self.ending.is_tuned:
            start, cost = self.verdict.start_cost, self.verdict.cost
            change = f"cost {start:.3g} → {cost:.3g}, {self.improvement}"
            said = [*response_changes(self.start, self.tuned)]
            said += [claimed_robustness(self.claim, self.limits), *bounds_reached(self.findings)]
            said += load_stays(self.rejections.get("tuned"), self.plan, self.rig)
            shown = ", ".join(said)
            return f"{self.ending.upper()}: {self.rig.name}, {shown}; {change}; {self.trials_text}"
        if self.improvement is not None:
            change = f"cost {self.improvement}, keep the initial gains"
        else:
            change = "keep the initial gains"
        return f"{self.ending.upper()}: {self.rig.name}, {self.trials_text}, {change}"

    def rows(self) -> tuple[ResultRow, ...]:
        """The before/after table as text; the last column is empty without an improvement."""
        start = self.start.cells()
        tuned = self.tuned.cells() if self.tuned else dict.fromkeys(start, "")
        shown = [ResultRow(label, start[label], tuned.get(label, "-")) for label in start]
        robust = robustness_cells(self.claim.margins)
        shown += [ResultRow(label, *(("-", x) if self.tuned else (x, ""))) for label, x in robust]
        none = "-" if self.tuned else ""
        before, *after = (load_cells(one, self.rig) for one in self.rejections.values())
        last = after[0] if after else dict.fromkeys(before, "")
        shown += [ResultRow(label, at, last[label]) for label, at in before.items()]
        shown += [ResultRow(*r) for r in behaviour_rows(self.behaviour, self.rig.measured, none)]
        return tuple(shown)

    def remarks(self) -> tuple[str, ...]:
        """The conclusion and the warnings, a sentence each."""
        counts = ((self.unsafe, "unsafe"), (self.verdict.declined, "declined and not run"))
        sentences = (
            self.message,
            *start_remarks(self.plan, self.start_gains, self.fitted_form),
            *(f"{n} trial{'s were' if n > 1 else ' was'} {what}" for n, what in counts if n),
            *(finding.sentence for finding in self.findings),
            *behaviour_remarks(self.behaviour),
            *((INTERVALS_ARE,) if self.tuned and self.tuned.intervals else ()),
            trial_remark(self.plan, self.rig),
            *load_remarks([*self.rejections.values()][-1], self.plan, self.rig),
            *(_robustness_remarks(self) if self.verdict.complete else ()),
        )
        return tuple(f"{sentence[:1].upper()}{sentence[1:]}." for sentence in sentences)

    def to_frame(self) -> "pd.DataFrame":
        """The trials, one row each: number, phase, gains, cost, best cost so far, outcome."""
        import pandas as pd  # noqa: PLC0415  slow to import

        return pd.DataFrame(self.columns())

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns of `to_frame` by name, without pandas, which takes long to import."""
        entries = self.entries
        costs = np.array([e.cost for e in entries], np.float64)
        gains = np.array([e.gain_values for e in entries], np.float64).reshape(-1, len(GAIN_NAMES))
        eta_max = self.session.eta_max  # as in `findings`
        unsafe = np.array([was_unsafe(e, eta_max) for e in entries], np.bool_)
        return {
            "number": np.array([e.number for e in entries], np.int64),
            "attempt": np.array([e.attempt for e in entries], np.int64),
            "trial_id": np.array([e.trial_id for e in entries], np.object_),
            "phase": np.array([e.phase.value for e in entries], np.object_),
            **dict(zip(GAIN_NAMES, gains.T, strict=True)),
            "cost": costs,
            "best_cost": np.fmin.accumulate(np.where(unsafe, np.nan, costs)),
            "unsafe": unsafe,
            "outcome": np.array([str(e.outcome) for e in entries], np.object_),
            "reason": np.array([e.reason for e in entries], np.object_),
        }

    def record(self, number: int) -> TrialRecord:
        """The record of one trial.

        Raises:
            JournalError: there is no such trial, or the run has no journal.
        """
        entry = next((e for e in reversed(self.entries) if e.number == number), None)
        if entry is None:
            raise JournalError(
                f"there is no trial {number}; the run has trials 0 to {self.session.number - 1}"
            )
        if self.folder is not None:
            with Journal.open(self.folder) as journal:
                return journal.record(entry.trial_id)
        for record in (self.first_record, self.tuned_record):
            if record and record.trial_id == entry.trial_id:
                return record
        raise JournalError(
            f"the record of trial {number} is not stored; tune with journal=True to store them all"
        )


def _robustness_remarks(result: RunResult) -> tuple[str, ...]:
    """Properties that the records do not show, and the cost of the limits."""
    loop, tuned = result.identified, result.tuned
    remarks = [*loop.remarks]
    reason = result.claim.reason
    if result.ending is RunEnding.NOT_ROBUST:  # few trials were near the initial gains
        beyond = loop.fit is not None and loop.fit.is_incomplete
        reason = unexplained(loop.fit.misfit) if loop.fit and beyond else ""
    told = result.limits is not None and reason in result.limits.reason
    if reason and not told:
        remarks.append(f"no sensitivity is claimed from the records: {reason}")
    price = limit_price(loop, result.claim, result.plan, result.rig, result.gains)
    if tuned is not None and price is not None and price.sentence:
        remarks.append(price.sentence)
    first, start_cost = result.first_record, result.verdict.start_cost
    return (*remarks, *quality_remarks(result.plan, result.rig, first, start_cost, loop.fit))
