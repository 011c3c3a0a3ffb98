"""What a run came to, as a value to look at, compute with and draw.

A result is an `OptimizeResult`, so that what knows scipy knows it. How the run ended is told first
and everywhere: only a run whose gains were confirmed to beat the start shows a column "tuned", and
one that was compared with the start and found no better says so under a name of its own.
"""

import html
import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.optimize import OptimizeResult

from estune.core.comparison import Change, repeatability
from estune.core.gains import GAIN_NAMES, Gains
from estune.errors import JournalError
from estune.run import result_warnings
from estune.run.journal import Journal, JournalEntry
from estune.run.loop import TuningRun
from estune.run.performance import Performance
from estune.run.session import Plan, Session, is_censored, is_unsafe
from estune.run.summary import RunSummary, summarise
from estune.trial import RigDescription, TrialRecord
from estune.trial.scoring import constraint_margin

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class RunEnding(StrEnum):
    """How a run ended; the value is what it is called."""

    TUNED = "tuned"
    NO_IMPROVEMENT = "no significant improvement"
    STOPPED = "stopped"
    UNSAFE_START = "unsafe start"

    @property
    def status(self) -> int:
        """The status number of the `OptimizeResult`: zero is success."""
        return list(RunEnding).index(self)

    @property
    def exit_code(self) -> int:
        """The exit code of the command line; the other endings are exceptions with one."""
        return NO_IMPROVEMENT_CODE if self is RunEnding.NO_IMPROVEMENT else 0


NO_IMPROVEMENT_CODE = 7
"""A result and not an error, but one that a script must be able to tell from success."""


class Row(NamedTuple):
    """A line of the before/after table, as text; `tuned` is empty where nothing was tuned."""

    label: str
    start: str
    tuned: str


class TuneResult(OptimizeResult):  # type: ignore[misc]  # scipy ships no type information
    """The result of a run, finished or not.

    Attributes:
        x: The gains to use, shape (4,): P, I, D, setpoint_filter_s.
        fun: Their mean cost.
        nit: Search trials run.
        nfev: Trials run, with baseline, confirmation and void ones.
        success: Whether gains were confirmed to beat the start.
        status: 0 tuned, 1 no significant improvement, 2 stopped, 3 the start is unsafe.
        message: How the run ended, in a sentence.
        ending: The same as an `RunEnding`.
        gains: The gains to use; the start where nothing was confirmed to beat it.
        start_gains: The gains the run began from.
        verdict: What the repeats came to.
        entries: Every trial told, void ones too.
        folder: The run on disk, or None.
        plan: What decided the run.
        rig: The rig as it was when the run began.
        first_record: What the rig measured first, with the start gains; None before that.
        found_record: What it measured last with the gains found; None without such a trial.
        improvement: The change of the cost from the start's, with its 95 % interval; None where
            the two were not compared.
        unsafe: Unsafe trials of the run.
        session: Where the run stands.

    What takes a moment to work out is worked out when it is asked for first.
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
    entries: tuple[JournalEntry, ...]
    folder: Path | None
    plan: Plan
    rig: RigDescription
    first_record: TrialRecord | None
    found_record: TrialRecord | None
    improvement: Change | None
    unsafe: int
    session: Session

    @cached_property
    def start(self) -> Performance:
        """Performance of the start gains."""
        found = self.verdict
        cost = found.start_cost, found.start_cost_error
        return Performance.on(
            self.rig, self.plan.step, self.start_gains, cost, record=self.first_record
        )

    @cached_property
    def tuned(self) -> Performance | None:
        """Performance of the tuned gains, or None."""
        if not self.success:
            return None
        found = self.verdict
        return Performance.on(
            *(self.rig, self.plan.step, self.gains, (found.cost, found.cost_error)),
            record=self.found_record,
            intervals=found.intervals,
        )

    @cached_property
    def findings(self) -> tuple[result_warnings.ResultWarning, ...]:
        """Remarks: thin margins, a response near a limit of the rig, gains at a bound, flat cost.

        Of a start that was kept only what the trials do say: they need not have looked around it.
        """
        if not self.verdict.complete:
            return ()
        at, session, space = self.tuned or self.start, self.session, self.plan.tuner.space
        safe = [
            e for e in self.entries if e.outcome and not is_censored(session, e.outcome, e.cost)
        ]
        best = space.point_of(at.gains)
        repeated = [r.costs for r in (session.choice, session.confirmation) if r is not None]
        flat = result_warnings.flat_directions(
            *(space, best, at.cost),
            points=np.array([space.point_of(e.gains) for e in safe]),
            costs=np.array([e.cost for e in safe]),
            noise=at.cost * repeatability((session.baseline, *itertools.chain(*repeated))),
        )
        if self.tuned is None:
            flat = tuple(finding for finding in flat if finding.kind == "flat")
        share = math.inf if at.record is None else constraint_margin(at.record, self.rig)
        near = result_warnings.low_margins(at.margins) + result_warnings.near_limits(share)
        return near + result_warnings.at_bounds(space, best) + flat

    def to_frame(self) -> "pd.DataFrame":
        """The trials, one row each: number, phase, gains, cost, best cost so far, outcome."""
        import pandas as pd  # noqa: PLC0415  slow to import

        rows = [
            (
                *(e.number, e.attempt, e.trial_id, str(e.phase), *e.gains.as_tuple(), e.cost),
                *(_is_unsafe(self.session, e), str(e.outcome), e.reason),
            )
            for e in self.entries
        ]
        before, after = ("number", "attempt", "trial_id", "phase"), ("unsafe", "outcome", "reason")
        frame = pd.DataFrame(rows, columns=[*before, *GAIN_NAMES, "cost", *after])
        frame["unsafe"] = frame["unsafe"].astype(bool)
        safe = frame["cost"].where(~frame["unsafe"]).to_numpy(dtype=float)
        place = list(frame.columns).index("cost") + 1
        frame.insert(place, "best_cost", np.fmin.accumulate(safe))
        return frame

    def record(self, number: int) -> TrialRecord:
        """What the rig measured in one trial.

        Raises:
            JournalError: there was no such trial, or the run was not kept on disk.
        """
        entry = next((e for e in reversed(self.entries) if e.number == number), None)
        if entry is None:
            raise JournalError(
                f"there is no trial {number}; the run has trials 0 to {self.session.number - 1}"
            )
        if self.folder is not None:
            with Journal.open(self.folder) as journal:
                return journal.record(entry.trial_id)
        for kept in (self.first_record, self.found_record):
            if kept and kept.trial_id == entry.trial_id:
                return kept
        raise JournalError(
            f"the record of trial {number} was not kept; tune with journal=True to keep every one"
        )

    def plot_cost(self, ax: "Axes | None" = None) -> "Axes":
        """Draws the cost per trial with the best so far, on `ax` or a figure of its own."""
        from estune.run import figures  # noqa: PLC0415  slow to import
        from estune.support import plot_style  # noqa: PLC0415  slow to import

        return figures.draw_cost(
            ax or plot_style.new_axes(),
            self.to_frame(),
            self.verdict.start_cost,
            self.session.eta_max,
        )

    def plot_response(self, ax: "Axes | None" = None) -> "Axes":
        """Draws the step response before and after, on `ax` or a figure of its own."""
        from estune.run import figures  # noqa: PLC0415  slow to import
        from estune.support import plot_style  # noqa: PLC0415  slow to import

        return figures.draw_response(
            *(ax or plot_style.new_axes(), self.plan.step, self.first_record),
            self.found_record if self.success else None,
        )

    def plot_gains(self, ax: "Axes | None" = None) -> "Axes":
        """Draws the gains over the trials, on `ax` or a figure of its own."""
        from estune.run import figures  # noqa: PLC0415  slow to import
        from estune.support import plot_style  # noqa: PLC0415  slow to import

        return figures.draw_gains(
            *(ax or plot_style.new_axes(), self.to_frame(), self.start_gains, self.gains),
            self.tuned.intervals if self.tuned else {},
        )

    def figure(self) -> "Figure":
        """All three figures on one page; pyplot is not touched."""
        from estune.support import plot_style  # noqa: PLC0415  slow to import

        page = plot_style.new_figure(7.2, 6.6)
        grid = page.add_gridspec(2, 2)
        self.plot_response(page.add_subplot(grid[0, :]))
        self.plot_cost(page.add_subplot(grid[1, 0]))
        self.plot_gains(page.add_subplot(grid[1, 1]))
        page.suptitle(self.heading(), fontsize=10)
        return page

    def heading(self) -> str:
        """The run in one line, its ending first."""
        if self.ending is RunEnding.TUNED:
            start, cost = self.verdict.start_cost, self.verdict.cost
            came = f"cost {start:.3g} → {cost:.3g}, {self.improvement}"
        elif self.improvement is not None:
            came = f"cost {self.improvement}, the start gains stand"
        else:
            came = "the start gains stand"
        return f"{self.ending.upper()}: {self.rig.name}, {len(self.entries)} trials, {came}"

    def rows(self) -> tuple[Row, ...]:
        """The before/after table as text; the last column is empty unless the run tuned."""
        start = self.start.cells()
        tuned = self.tuned.cells() if self.tuned else dict.fromkeys(start, "")
        return tuple(Row(label, start[label], tuned[label]) for label in start)

    def remarks(self) -> tuple[str, ...]:
        """What is to be known beside the table, a sentence each."""
        said = (
            self.message,
            *_unsafe_said(self.verdict),
            *(finding.sentence for finding in self.findings),
        )
        return tuple(f"{sentence[:1].upper()}{sentence[1:]}." for sentence in said)

    def __repr__(self) -> str:
        rows = self.rows()
        columns = [("", "start", "tuned" if self.tuned else ""), *rows]
        widths = [max(len(row[i]) for row in columns) for i in range(3)]
        table = [
            f"  {label:<{widths[0]}}  {start:>{widths[1]}}  {tuned:>{widths[2]}}".rstrip()
            for label, start, tuned in columns
        ]
        where = [f"run: {self.folder}"] if self.folder else []
        return "\n".join([self.heading(), *table, *self.remarks(), *where])

    def __str__(self) -> str:
        return repr(self)

    def _repr_html_(self) -> str:
        from estune.support import plot_style  # noqa: PLC0415  slow to import

        def cells(tag: str, *texts: str) -> str:
            shown = texts if self.tuned else texts[:2]
            return "<tr>" + "".join(f"<{tag}>{html.escape(t)}</{tag}>" for t in shown) + "</tr>"

        colour = plot_style.GREEN if self.success else plot_style.VERMILION
        head = cells("th", "", "start", "tuned")
        table = head + "".join(cells("td", *row) for row in self.rows())
        remarks = "".join(f"<p>{html.escape(remark)}</p>" for remark in self.remarks())
        where = f"<p><code>{html.escape(str(self.folder))}</code></p>" if self.folder else ""
        return (
            f'<div><p style="border-left:4px solid {colour};padding-left:8px">'
            f"<b>{html.escape(self.heading())}</b></p><table>{table}</table>{remarks}{where}"
            f"{plot_style.to_svg(self.figure())}</div>"
        )


def from_tuning(tuning: TuningRun) -> TuneResult:
    """The result of a run so far as it went."""
    session, plan = tuning.session, tuning.plan
    found = summarise(session)
    if tuning.intervals is not None:
        found = replace(found, intervals=tuning.intervals)
    if session.failure:
        ending = RunEnding.UNSAFE_START
    elif not found.complete:
        ending = RunEnding.STOPPED
    else:
        ending = RunEnding.TUNED if found.improved else RunEnding.NO_IMPROVEMENT
    return TuneResult(
        x=np.array(found.gains.as_tuple()),
        fun=found.cost,
        nit=session.searched,
        nfev=len(tuning.entries),
        success=found.improved,
        status=ending.status,
        message=found.message,
        ending=ending,
        gains=found.gains,
        start_gains=plan.start,
        verdict=found,
        entries=tuple(tuning.entries),
        folder=tuning.journal.folder if tuning.journal else None,
        plan=plan,
        rig=tuning.description,
        first_record=tuning.first,
        found_record=tuning.found,
        improvement=found.change,
        unsafe=found.unsafe,
        session=session,
    )


def _is_unsafe(session: Session, entry: JournalEntry) -> bool:
    return entry.outcome is not None and is_unsafe(session, entry.outcome, entry.cost)


def _unsafe_said(found: RunSummary) -> Iterator[str]:
    """How many trials were unsafe, and how many were declined, where there are any."""
    for count, what in ((found.unsafe, "unsafe"), (found.declined, "declined and not run")):
        if count:
            yield f"{count} trial{'s were' if count > 1 else ' was'} {what}"
