"""Result of a run, as it is shown: in a terminal, in a notebook, as a page."""

from dataclasses import replace
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from estune.core.gain_forms import GainForm, gain_forms
from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.loop_model.optimum import SENSITIVITY_MAX
from estune.run.ending import RunEnding
from estune.run.results.run_result import RunResult
from estune.run.results.summary import not_robust_summary, summarise, within_limits_summary
from estune.run.robustness import verdict_on
from estune.run.tuning_run import TuningRun
from estune.support.notebook_card import card

if TYPE_CHECKING:
    from control import StateSpace
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from estune.run.results.frequency_figures import PlantResponse


_TITLE_WIDTH = 100
"""Characters of a line of the figure's title."""


class TuneResult(RunResult):
    """The result of a run with its representations; pyplot is not touched."""

    @property
    def forms(self) -> tuple[GainForm, ...]:
        """The gains to use as Kp/Ti/Td, in series and parallel form, and per sample."""
        return gain_forms(self.gains, self.rig.controller)

    @property
    def controller(self) -> "StateSpace":
        """The controller with the gains to use, sampled at the rig's rate, for python-control."""
        from estune.interop import sampled_controller  # noqa: PLC0415  slow to import

        return sampled_controller(self.gains, self.rig.controller)

    def loop(self, plant: Any = None, dead_time_s: float = 0.0) -> "StateSpace":
        """The loop of a plant with the gains to use; see `estune.interop.closed_loop`.

        Args:
            plant: A linear system of python-control or SciPy; the rig's own model by default.
            dead_time_s: Dead time of the system, s.

        Raises:
            InvalidInput: no plant is given and the rig has no model, or the plant is no such.
        """
        from estune.interop import closed_loop  # noqa: PLC0415  slow to import

        plant = self.rig.linear_model if plant is None else plant
        if plant is None:
            raise InvalidInput(
                f"rig {self.rig.name} gives no linear model of itself; give the plant, as in "
                "result.loop(control.tf([1], [1, 1]))"
            )
        return closed_loop(plant, self.gains, self.rig.controller, dead_time_s)

    def plot_cost(self, ax: "Axes | None" = None) -> "Axes":
        """Draws the cost per trial with the best so far, on `ax` or a figure of its own."""
        from estune.run.results import figures  # noqa: PLC0415  slow to import

        costs = self.verdict.start_cost, self.session.eta_max
        return figures.draw_cost(ax, self.columns(), *costs)

    @property
    def loops(self) -> "list[tuple[str, Gains]]":
        """The gains whose loops are compared, by what they are."""
        tuned = [("tuned gains", self.gains)] if self.success else []
        return [("initial gains", self.start_gains), *tuned]

    @property
    def sensitivity_limit(self) -> float:
        """Limit of Ms by which the result was judged; the usual one where there was none."""
        limits = self.plan.limits
        return (limits and limits.max_sensitivity) or SENSITIVITY_MAX

    def plot_bode(self, ax: "Axes | None" = None) -> "Axes":
        """Draws gain and phase of the loop before and after, on `ax` or a figure of its own.

        Raises:
            InvalidInput: neither the records nor the rig give a model of the loop.
        """
        from estune.run.results import frequency_figures  # noqa: PLC0415  slow to import

        response = self._loop_response()
        return frequency_figures.draw_bode(response, self.rig.controller, self.loops, ax)

    def plot_nyquist(self, ax: "Axes | None" = None) -> "Axes":
        """Draws the loop gain in the complex plane, on `ax` or a figure of its own.

        Raises:
            InvalidInput: as of `plot_bode`.
        """
        from estune.run.results import frequency_figures  # noqa: PLC0415  slow to import

        response, limit = self._loop_response(), self.sensitivity_limit
        return frequency_figures.draw_nyquist(response, self.rig.controller, self.loops, limit, ax)

    def _loop_response(self) -> "PlantResponse":
        from estune.run.results.frequency_figures import PlantResponse  # noqa: PLC0415  as above

        found = PlantResponse.of_loop(self.claim, self.identified.fit, self.rig)
        if found is None:
            raise InvalidInput(
                f"there is no model of the loop to draw: {self.claim.reason}; plot_step() draws "
                "what was measured"
            )
        return found

    def plot_step(self, ax: "Axes | None" = None) -> "Axes":
        """Draws the step response before and after, on `ax` or a figure of its own."""
        from estune.run.results import figures  # noqa: PLC0415  slow to import

        after = self.tuned_record if self.success else None
        return figures.draw_response(
            ax, self.plan.step, self.first_record, after, self.rig.measurement
        )

    def plot_gains(self, ax: "Axes | None" = None) -> "Axes":
        """Draws the gains over the trials, on `ax` or a figure of its own."""
        from estune.run.results import figures  # noqa: PLC0415  slow to import

        intervals = self.tuned.intervals if self.tuned else {}
        units = self.rig.gain_units
        gains = self.start_gains, self.gains
        return figures.draw_gains(ax, self.columns(), *gains, intervals=intervals, units=units)

    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """Draws the step response on `ax`; without one, all three figures on one page."""
        return self.figure().axes[0] if ax is None else self.plot_step(ax)

    def figure(self) -> "Figure":
        """All three figures on one page; pyplot is not touched."""
        from estune.support import plot_style  # noqa: PLC0415  slow to import

        page = plot_style.new_figure(7.2, 6.6)
        grid = page.add_gridspec(2, 2)
        self.plot_step(page.add_subplot(grid[0, :], axes_class=plot_style.ShownAxes))
        self.plot_cost(page.add_subplot(grid[1, 0]))
        self.plot_gains(page.add_subplot(grid[1, 1]))
        page.suptitle(fill(self.heading(), _TITLE_WIDTH), fontsize=10)
        return page

    def report(self, path: str | Path) -> Path:
        """Writes everything as one page that needs no other file and no network.

        Raises:
            InvalidInput: the page cannot be written there.
        """
        from estune.run.results.report import page  # noqa: PLC0415  draws: slow to import
        from estune.support.html_page import write  # noqa: PLC0415  as above

        write(page(self), Path(path))
        return Path(path)

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

    def __dir__(self) -> list[str]:  # scipy lists the fields alone, without methods
        return sorted({*object.__dir__(self), *self})

    def _repr_html_(self) -> str:
        shown = 3 if self.tuned else 2
        rows = [row[:shown] for row in (("", "start", "tuned"), *self.rows())]
        where = (f"run: {self.folder}",) if self.folder else ()
        return card(
            self.heading(),
            good=self.ending.good,
            tables=[rows],
            sentences=(*self.remarks(), *where),
            figure=self.figure(),
        )


def from_tuning(tuning: TuningRun) -> TuneResult:
    """The result of a run, complete or not."""
    session, plan = tuning.session, tuning.plan
    summary = summarise(session)
    if tuning.intervals is not None:
        summary = replace(summary, intervals=tuning.intervals)
    verdict = verdict_on(tuning, summary.change)
    if verdict.fault:
        summary = not_robust_summary(summary, plan, verdict.fault)
    elif verdict.broken:
        summary = within_limits_summary(summary, session, verdict.broken)
    if session.failure:
        ending = RunEnding.UNSAFE_START
    elif not summary.complete:
        ending = RunEnding.STOPPED
    else:
        worse = RunEnding.NOT_ROBUST if verdict.fault else RunEnding.NO_IMPROVEMENT
        ending = verdict.limits.ending if summary.improved else worse
    result = TuneResult(
        x=np.array(summary.gains.as_tuple()),
        fun=summary.cost,
        nit=session.search_trials,
        nfev=len(tuning.entries),
        success=summary.improved,
        status=ending.status,
        message=summary.message,
        ending=ending,
        gains=summary.gains,
        start_gains=plan.start,
        verdict=summary,
        limits=verdict.limits if summary.improved else None,
        fitted_form=tuning.fitted_form,
        entries=tuple(tuning.entries),
        folder=tuning.journal.folder if tuning.journal else None,
        plan=plan,
        rig=tuning.description,
        first_record=tuning.first_record,
        tuned_record=tuning.tuned_record,
        improvement=summary.change,
        unsafe=summary.unsafe,
        session=session,
        recent_records=tuple(tuning.recent_records),
        excitations=tuple(tuning.excitations),
    )
    if verdict.loop is not None:
        result.__dict__["identified"] = verdict.loop  # the cached property
        if result.gains == session.candidate:
            result.__dict__["claim"] = verdict.claim  # as above
    return result
