"""Progress of a run or study on the screen: a live display, plain lines, or a notebook cell.

`show_progress` displays whatever a function returns as `ProgressStatus`; `watching` does so for a
tuning run. On a terminal a thread of the display draws, so that a run never waits for it.
"""

import importlib
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from statistics import fmean
from typing import Any, Literal, NamedTuple, TextIO

import numpy as np
from rich.console import Console, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from estune.loop_model.optimum import RobustnessLimits
from estune.run.disk_space import DiskForecast
from estune.run.loop import Progress, ProgressListener
from estune.run.tuning_run import TuningRun

_REDRAW_S = 0.25
"""Minimum time between two drawings."""

_LINE_EVERY_S = 10.0
"""Maximum time between two plain lines while steps are completed."""

_LINES = 12
"""Approximate number of plain lines."""


class ProgressStatus(NamedTuple):
    """Progress of a run or study at one moment.

    Attributes:
        stage: Present stage, such as a phase; may be empty.
        done: Completed steps, with those of earlier calls.
        unit: What a step is, in the plural: trials, cells.
        alerts: Failures so far, such as "2 failed"; a change is reported at once.
        summary: Everything else for a plain line.
        details: Everything else for a live display: label and text of each row.
        remaining_s: Time of the missing steps at the rate so far; nan until it is known.
        at_most: Whether there may be fewer steps than that.
    """

    stage: str
    done: int
    total: int
    unit: str
    alerts: str
    summary: str
    details: tuple[tuple[str, str], ...]
    remaining_s: float
    at_most: bool = False

    @property
    def steps(self) -> str:
        """Completed steps and failures."""
        width = len(str(self.total))
        alerts = f", {self.alerts}" if self.alerts else ""
        return f"{self.done:>{width}} of {self._bound}{self.total} {self.unit}{alerts}"

    @property
    def remaining(self) -> str:
        """Remaining time in words; empty when nothing is missing or it is not known."""
        known = self.done < self.total and math.isfinite(self.remaining_s)
        return f"{self._bound}{duration(self.remaining_s)} left" if known else ""

    @property
    def _bound(self) -> str:
        return "at most " if self.at_most else ""

    def line(self) -> str:
        """The status in one line."""
        stage = f"{self.stage:<8}" if self.stage else ""
        return "  ".join(filter(None, (stage, self.steps, self.remaining, self.summary)))


@contextmanager
def show_progress(
    status: Callable[[], ProgressStatus],
    heading: str = "",
    *,
    stream: TextIO | None = None,
    live: bool = True,
) -> Iterator[Callable[[], None]]:
    """Shows progress for the duration of the block: live where possible, else as plain lines.

    Args:
        status: Returns the present status; called from any thread.
        heading: Line above the progress.
        stream: Output; standard error by default.
        live: Whether the display may redraw; not while an operator is prompted.

    Yields:
        The function to call after each step.
    """
    stream = stream or sys.stderr
    console = Console(file=stream)
    if live and _in_notebook():
        display = _show_in_cell(status, heading)
    elif live and console.is_terminal and not console.is_dumb_terminal:
        display = show_live(status, heading, console)
    else:
        display = _show_lines(status, heading, stream)
    with display as update:
        yield update


@contextmanager
def show_live(
    status: Callable[[], ProgressStatus], heading: str, console: Console
) -> Iterator[Callable[[], None]]:
    """Shows progress in a few lines of a terminal, redrawn in place."""
    if heading:
        console.print(heading, style="dim", highlight=False, soft_wrap=True)
    with Live(
        console=console,
        refresh_per_second=1.0 / _REDRAW_S,
        get_renderable=lambda: _render(status()),
    ):
        yield lambda: None


@contextmanager
def _show_lines(
    status: Callable[[], ProgressStatus], heading: str, stream: TextIO
) -> Iterator[Callable[[], None]]:
    if heading:
        print(heading, file=stream, flush=True)
    first = status()
    every = max(1, (first.total - first.done) // _LINES)
    printed: ProgressStatus | None = None
    printed_s = -math.inf

    def update(*, at_end: bool = False) -> None:
        nonlocal printed, printed_s
        now = status()
        if printed is None:
            is_due = not at_end or now.done > 0
        elif at_end or now.done == now.total:
            is_due = now.done != printed.done
        else:
            is_new = (now.stage, now.alerts) != (printed.stage, printed.alerts)
            is_late = time.monotonic() - printed_s > _LINE_EVERY_S
            is_due = is_new or is_late or now.done - printed.done >= every
        if is_due:
            printed, printed_s = now, time.monotonic()
            print(now.line(), file=stream, flush=True)

    try:
        yield update
    finally:
        update(at_end=True)


@contextmanager
def _show_in_cell(
    status: Callable[[], ProgressStatus], heading: str
) -> Iterator[Callable[[], None]]:
    """One output of a notebook cell, updated by plain display messages: no widgets."""
    output: Any = importlib.import_module("IPython.display")

    def content() -> dict[str, str]:
        now = status()
        rows = (f"{label}  {text}" for label, text in now.details)
        return {"text/plain": "\n".join(filter(None, (heading, now.line(), *rows)))}

    handle = output.display(content(), raw=True, display_id=True)
    drawn_s = -math.inf

    def update() -> None:
        nonlocal drawn_s
        if time.monotonic() - drawn_s > _REDRAW_S:
            drawn_s = time.monotonic()
            handle.update(content(), raw=True)

    try:
        yield update
    finally:
        handle.update(content(), raw=True)


def _render(status: ProgressStatus) -> RenderableType:
    """A bar, and a row for each detail."""
    bar = Table.grid(padding=(0, 2))
    bar.add_row(
        ProgressBar(total=status.total, completed=status.done, width=32),
        Text(status.steps.lstrip()),
        Text(status.remaining, style="dim"),
    )
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", width=8, no_wrap=True)
    grid.add_column()
    grid.add_row(Text(status.stage, style="bold"), bar)
    for label, text in status.details:
        grid.add_row(label, Text(text))
    return grid


def _in_notebook() -> bool:
    """Whether a Jupyter kernel runs this; IPython is consulted only if it is loaded already."""
    ipython: Any = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return shell is not None and hasattr(shell, "kernel")


@contextmanager
def watching(
    watch: ProgressListener | Literal["auto"] | None, tuning: TuningRun, *, asking: bool = False
) -> Iterator[tuple[ProgressListener, ...]]:
    """The progress listeners of a run, for the duration of the block.

    Args:
        watch: The caller's own listener, None for none, or "auto" for `show_progress`.
        tuning: The run about to start.
        asking: Whether the operator is prompted in between.
    """
    if watch != "auto":
        yield () if watch is None else (watch,)
        return
    counter = ProgressCounter(tuning)
    with show_progress(counter.status, counter.heading(), live=not asking) as update:

        def on_trial(progress: Progress) -> None:
            counter.on_trial(progress)
            update()

        yield (on_trial,)


class ProgressCounter:
    """Progress of a run, with what its session does not count: the best cost and the rate.

    Attributes:
        best: Lowest cost of a safe trial, with those before a resumption; nan without any.
    """

    def __init__(self, tuning: TuningRun) -> None:
        self._tuning = tuning
        self._first = tuning.session.number
        self._began_s = time.monotonic()
        self._last: Progress | None = None
        self._disk = DiskForecast(tuning.journal) if tuning.journal else None
        self._disk_warning = ""
        safe = [e.cost for e in tuning.entries if e.cost <= tuning.session.eta_max]
        self.best = min(safe, default=math.nan)

    def on_trial(self, progress: Progress) -> None:
        """Takes a trial into account."""
        self._last = progress
        if self._disk is not None:
            self._disk_warning = self._disk.warning(progress.session.trials_left)
        if not progress.unsafe:
            self.best = float(np.fmin(self.best, progress.entry.cost))

    def heading(self) -> str:
        """Rig, tuner and folder of the run, and how to stop it."""
        tuning = self._tuning
        folder = f", stored in {tuning.journal.folder}" if tuning.journal else ""
        again = f" from trial {self._first} on" if self._first else ""
        by = tuning.plan.tuner.name
        if not tuning.plan.uses_records and tuning.plan.limits != RobustnessLimits(
            None, None, None
        ):
            by += ", which searches without limits (model_based keeps them)"
        return (
            f"tuning {tuning.description.name} with {by}{again}{folder}; "
            "Ctrl-C stops and restores the rig's own gains"
        )

    def status(self) -> ProgressStatus:
        """The present status."""
        last, tuning = self._last, self._tuning
        session = tuning.session if last is None else last.session
        trials = session.number - self._first
        rate_s = (time.monotonic() - self._began_s) / trials if trials else math.nan
        start = fmean(session.baseline) if session.baseline else math.nan
        gains = tuning.plan.start if last is None else last.entry.gains
        tried = tuning.description.gains_text(gains)
        costs = "  ".join(
            (
                f"cost {_cost(math.nan if last is None else last.entry.cost)}",
                f"best {_cost(self.best)}",
                f"start {_cost(start)}",
                f"{session.unsafe} unsafe",
            )
        )
        rig = tuning.description
        live = f"{rig.gains_text(rig.gains)}  on {rig.name}, between trials"
        return ProgressStatus(
            stage=str((session.phase if last is None else last.entry.phase) or "done"),
            done=session.number,
            total=session.number + session.most_left,
            unit="trials",
            alerts=self._disk_warning,
            summary=f"{costs}  tried {tried}",
            details=(("now", costs), ("tried", tried), ("live", live)),
            remaining_s=rate_s * session.most_left,
            at_most=session.is_open,
        )


@contextmanager
def counting(unit: str, *, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """A function to be called with the steps done, and all, that shows progress."""
    with showing_phases(quiet=quiet) as on_phase:
        yield lambda done, total: on_phase(f"{done} of {total} {unit}", done / max(total, 1))


@contextmanager
def showing_phases(*, quiet: bool) -> Iterator[Callable[[str, float], None]]:
    """A function to be called with the present phase and the share of the work that is done.

    It shows them with the time left, from a first call until the share is 1: more work may follow.
    """
    if quiet:
        yield lambda _phase, _done: None
        return
    phase, share, began_s = "", 0.0, 0.0
    update: Callable[[], None] | None = None

    def status() -> ProgressStatus:
        left_s = (time.monotonic() - began_s) / share * (1.0 - share) if share else math.nan
        percent = round(100 * share)
        return ProgressStatus("", percent, 100, "%", "", phase, (("now", phase),), left_s)

    with ExitStack() as display:

        def on_phase(present: str, done: float) -> None:
            nonlocal phase, share, began_s, update
            phase, share = present, done
            if update is None:
                began_s = time.monotonic()
                update = display.enter_context(show_progress(status))
            update()
            if done >= 1.0:
                update = None
                display.close()

        yield on_phase


def _cost(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "-"


def duration(seconds: float) -> str:
    """A time as m:ss or h:mm:ss, or a dash."""
    if not math.isfinite(seconds):
        return "-"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
