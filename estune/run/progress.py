"""What a run shows while it goes on: a live display, plain lines, or a notebook cell.

A watcher only notes the last trial; drawing is done a few times a second at most, on a terminal by
a thread of its own, so that the run does not wait for its display.
"""

import importlib
import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import fmean
from typing import Any, Literal, NamedTuple, Protocol, TextIO

import numpy as np
from rich.console import Console, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from estune.core.gains import Gains
from estune.run.loop import Progress, ProgressListener, TuningRun
from estune.run.session import Phase

_REDRAW_S = 0.25
"""Least time between two drawings."""

_LINE_EVERY_S = 10.0
"""Greatest time between two plain lines while trials come in."""

_LINES = 12
"""About so many plain lines a run."""


@contextmanager
def watching(
    watch: ProgressListener | Literal["auto"] | None, tuning: TuningRun, *, asking: bool = False
) -> Iterator[tuple[ProgressListener, ...]]:
    """The watchers of a run, ready for as long as the block lasts.

    Args:
        watch: A watcher of the caller's own, None for silence, or "auto": a live display on a
            terminal, an updated cell in a notebook, one line per some trials anywhere else.
        tuning: The run about to go on.
        asking: Whether somebody is asked in between, so that nothing may be redrawn.
    """
    if watch is None:
        yield ()
    elif watch != "auto":
        yield (watch,)
    else:
        display = PlainDisplay(tuning, sys.stderr) if asking else _display(tuning, sys.stderr)
        with display:
            yield (display.saw,)


class RunStatus(NamedTuple):
    """What there is to show of a run at one moment.

    Attributes:
        rig: Name of the rig.
        phase: Phase of the last trial, or of the next one where there is none yet.
        done: Trials told.
        most: Trials the run takes if nothing ends it early or draws it out.
        cost: Cost of the last trial; nan where it has none.
        best: Least cost of a safe trial; nan where there is none.
        start: Mean cost of the start gains; nan until there is one.
        unsafe: Unsafe trials so far.
        tried: Gains of the last trial.
        live: Gains that are live on the rig between trials.
        left_s: Time the missing trials will take at the pace so far; nan until it is known.
    """

    rig: str
    phase: Phase | None
    done: int
    most: int
    cost: float
    best: float
    start: float
    unsafe: int
    tried: Gains
    live: Gains
    left_s: float


class ProgressCounter:
    """Counts what the session does not: the best cost and the pace."""

    def __init__(self, tuning: TuningRun) -> None:
        self._tuning = tuning
        self._first = tuning.session.number
        self._began_s = time.monotonic()
        self._last: Progress | None = None
        told = [e for e in tuning.entries if e.outcome is not None and not e.outcome.is_void]
        # A resumed run: what its earlier trials came to.
        safe = [e.cost for e in told if e.cost <= tuning.session.eta_max]
        self._best = min(safe, default=math.nan)

    def on_trial(self, progress: Progress) -> None:
        """Takes note of a trial."""
        self._last = progress
        if not progress.unsafe:
            self._best = float(np.fmin(self._best, progress.entry.cost))

    def status(self) -> RunStatus:
        """Everything, now."""
        last, tuning = self._last, self._tuning
        session = tuning.session if last is None else last.session
        here = session.number - self._first
        most = session.number + session.trials_left
        pace = (time.monotonic() - self._began_s) / here if here else math.nan
        return RunStatus(
            rig=tuning.description.name,
            phase=session.phase if last is None else last.entry.phase,
            done=session.number,
            most=most,
            cost=math.nan if last is None else last.entry.cost,
            best=self._best,
            start=fmean(session.baseline) if session.baseline else math.nan,
            unsafe=session.unsafe,
            tried=tuning.plan.start if last is None else last.entry.gains,
            live=tuning.description.gains,
            left_s=pace * (most - session.number),
        )


class _Display(Protocol):
    def saw(self, progress: Progress) -> None: ...

    def __enter__(self) -> object: ...

    def __exit__(self, *_: object) -> None: ...


class TerminalDisplay:
    """A few lines at the foot of the terminal, redrawn in place by rich's own thread."""

    def __init__(self, tuning: TuningRun, console: Console) -> None:
        self._tally = ProgressCounter(tuning)
        self._heading = heading(tuning)
        self._live = Live(
            console=console,
            refresh_per_second=1.0 / _REDRAW_S,
            get_renderable=lambda: render(self._tally.status()),
            transient=False,
        )

    def saw(self, progress: Progress) -> None:
        """Takes note of a trial."""
        self._tally.on_trial(progress)

    def __enter__(self) -> None:
        self._live.console.print(self._heading, style="dim", highlight=False, soft_wrap=True)
        self._live.start()

    def __exit__(self, *_: object) -> None:
        self._live.stop()


class PlainDisplay:
    """One line per some trials, for a pipe or a log file."""

    def __init__(self, tuning: TuningRun, stream: TextIO) -> None:
        self._tally = ProgressCounter(tuning)
        self._heading = heading(tuning)
        self._stream = stream
        self._every = max(1, (tuning.session.number + tuning.session.trials_left) // _LINES)
        self._shown: tuple[Phase | None, int] = (None, -self._every)
        self._shown_s = -math.inf

    def saw(self, progress: Progress) -> None:
        """Takes note of a trial, and prints a line if it is time for one."""
        self._tally.on_trial(progress)
        phase, number = progress.entry.phase, progress.session.number
        late = time.monotonic() - self._shown_s > _LINE_EVERY_S
        if phase is self._shown[0] and number - self._shown[1] < self._every and not late:
            return
        self._shown, self._shown_s = (phase, number), time.monotonic()
        print(line(self._tally.status()), file=self._stream, flush=True)

    def __enter__(self) -> None:
        print(self._heading, file=self._stream, flush=True)

    def __exit__(self, *_: object) -> None:
        status = self._tally.status()
        if status.done != self._shown[1] and status.done > 0:
            print(line(status), file=self._stream, flush=True)


class NotebookDisplay:
    """One output of a cell, updated in place by plain display messages: no widgets."""

    def __init__(self, tuning: TuningRun) -> None:
        self._tally = ProgressCounter(tuning)
        self._heading = heading(tuning)
        self._output: Any = importlib.import_module("IPython.display")
        self._handle: Any = None
        self._shown_s = -math.inf

    def saw(self, progress: Progress) -> None:
        """Takes note of a trial, and redraws if the last drawing is old enough."""
        self._tally.on_trial(progress)
        if time.monotonic() - self._shown_s > _REDRAW_S:
            self._draw()

    def __enter__(self) -> None:
        self._handle = self._output.display(self._content(), raw=True, display_id=True)

    def __exit__(self, *_: object) -> None:
        self._draw()

    def _draw(self) -> None:
        self._handle.update(self._content(), raw=True)
        self._shown_s = time.monotonic()

    def _content(self) -> dict[str, str]:
        status = self._tally.status()
        lines = (self._heading, *_parts(status), f"live  {status.live}")
        return {"text/plain": "\n".join(lines)}


def render(status: RunStatus) -> RenderableType:
    """The live display: a bar and a line each for costs, gains tried and gains live."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", width=8, no_wrap=True)
    grid.add_column()
    bar = Table.grid(padding=(0, 2))
    phase = "done" if status.done == status.most else str(status.phase)
    bar.add_row(
        ProgressBar(total=status.most, completed=status.done, width=32),
        Text(f"{status.done} of {status.most} trials"),
        Text(f"{duration(status.left_s)} left" if status.done < status.most else "", style="dim"),
    )
    grid.add_row(Text(phase, style="bold"), bar)
    costs = Text()
    for label, value in (("now", status.cost), ("best", status.best), ("start", status.start)):
        costs.append(f"{label} ", style="dim").append(f"{number(value):<9}")
    if status.unsafe:
        costs.append(f" {status.unsafe} unsafe", style="yellow")
    grid.add_row("cost", costs)
    grid.add_row("tried", str(status.tried))
    grid.add_row("live", Text(f"{status.live}  on {status.rig}, between trials and after them"))
    return grid


def heading(tuning: TuningRun) -> str:
    """What is about to go on, where it is kept, and how to stop it."""
    where = f", kept in {tuning.journal.folder}" if tuning.journal else ""
    again = f" from trial {tuning.session.number} on" if tuning.session.number else ""
    return (
        f"tuning {tuning.description.name} with {tuning.plan.tuner.name}{again}{where}; "
        "Ctrl-C stops and leaves the rig its own gains"
    )


def line(status: RunStatus) -> str:
    """The run in one line."""
    return "  ".join(_parts(status))


def _parts(status: RunStatus) -> tuple[str, str]:
    """How the run stands, and the gains it tried last."""
    parts = [
        f"{status.phase or 'done':<8} {status.done:>{len(str(status.most))}} of {status.most}",
        f"cost {number(status.cost)}",
        f"best {number(status.best)}",
        f"start {number(status.start)}",
        f"{status.unsafe} unsafe",
    ]
    if status.done < status.most and math.isfinite(status.left_s):
        parts.append(f"{duration(status.left_s)} left")
    return "  ".join(parts), f"tried {status.tried}"


def number(value: float) -> str:
    """A cost in three digits, or a dash."""
    return f"{value:.3g}" if math.isfinite(value) else "-"


def duration(seconds: float) -> str:
    """A time as m:ss or h:mm:ss, or a dash."""
    if not math.isfinite(seconds):
        return "-"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def _display(tuning: TuningRun, stream: TextIO) -> _Display:
    if _in_notebook():
        return NotebookDisplay(tuning)
    console = Console(file=stream)
    if console.is_terminal and not console.is_dumb_terminal:
        return TerminalDisplay(tuning, console)
    return PlainDisplay(tuning, stream)


def _in_notebook() -> bool:
    """Whether a Jupyter kernel runs this; IPython is asked only if it is loaded already."""
    ipython: Any = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return shell is not None and hasattr(shell, "kernel")
