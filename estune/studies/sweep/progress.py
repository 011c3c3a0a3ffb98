"""What a sweep shows while it goes on: a bar on a terminal, some plain lines anywhere else."""

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple, TextIO

from rich.console import Console, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from estune.run.progress import duration
from estune.studies.sweep.outcome import CellOutcome

Watcher = Callable[[CellOutcome], None]
"""Told of each cell after it was committed; must return quickly."""

_REFRESH_Hz = 4.0
_LINES = 12
"""About so many plain lines a sweep."""


class SweepStatus(NamedTuple):
    """How a sweep stands.

    Attributes:
        done: Cells done, with those of earlier calls.
        most: Cells in all.
        failed: Cells of this call that could not be run.
        left_s: Time the rest will take at the pace so far; nan until it is known.
        last: What the last cell came to, in a line; empty before the first.
    """

    done: int
    most: int
    failed: int
    left_s: float
    last: str


class Tally:
    """Counts the cells as they come in."""

    def __init__(self, most: int, before: int) -> None:
        """`most` cells in all, `before` of them done by earlier calls."""
        self._most, self._before = most, before
        self._now = self._failed = 0
        self._last = ""
        self._began_s = time.monotonic()

    def saw(self, outcome: CellOutcome) -> None:
        """Takes note of a cell."""
        self._now += 1
        self._failed += outcome.failed
        cost = f", cost {outcome.cost:.3g}" if math.isfinite(outcome.cost) else ""
        self._last = f"{outcome.cell.label}: {outcome.ending}{cost}"

    def status(self) -> SweepStatus:
        """How it stands now."""
        pace = (time.monotonic() - self._began_s) / self._now if self._now else math.nan
        done = self._before + self._now
        return SweepStatus(done, self._most, self._failed, pace * (self._most - done), self._last)


@contextmanager
def watching(most: int, before: int, stream: TextIO | None = None) -> Iterator[Watcher]:
    """A watcher that shows a sweep for as long as the block lasts.

    Args:
        most: Cells in all.
        before: Cells done by earlier calls.
        stream: Where to; standard error by default.
    """
    tally = Tally(most, before)
    stream = stream or sys.stderr
    console = Console(file=stream)
    if console.is_terminal and not console.is_dumb_terminal:
        with Live(
            console=console,
            refresh_per_second=_REFRESH_Hz,
            get_renderable=lambda: render(tally.status()),
        ):
            yield tally.saw
        return
    every = max(1, (most - before) // _LINES)

    def saw(outcome: CellOutcome) -> None:
        tally.saw(outcome)
        status = tally.status()
        if (status.done - before) % every == 0 or status.done == most or outcome.failed:
            print(line(status), file=stream, flush=True)

    yield saw


def render(status: SweepStatus) -> RenderableType:
    """The live display: a bar, and the last cell below it."""
    bar = Table.grid(padding=(0, 2))
    bar.add_row(
        ProgressBar(total=status.most, completed=status.done, width=32),
        Text(_count(status)),
        Text(_left(status), style="dim"),
    )
    grid = Table.grid()
    grid.add_row(bar)
    grid.add_row(Text(status.last, style="dim", overflow="ellipsis", no_wrap=True))
    return grid


def line(status: SweepStatus) -> str:
    """The sweep in one line."""
    return "  ".join(filter(None, (_count(status), _left(status), status.last)))


def _count(status: SweepStatus) -> str:
    trouble = f", {status.failed} failed" if status.failed else ""
    return f"{status.done} of {status.most} cells{trouble}"


def _left(status: SweepStatus) -> str:
    return f"{duration(status.left_s)} left" if status.done < status.most else ""
