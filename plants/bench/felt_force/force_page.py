"""Report page of a bench: the force that a user feels, before and after tuning."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from estune.core.gains import Gains
from estune.support.html_page import (
    Block,
    Drawing,
    Page,
    Paragraph,
    Section,
    Status,
    Table,
    Warnings,
)
from estune.support.plot_style import BLUE, GREY, VERMILION, WIDTH_in, finish, legend, new_figure
from estune.support.quantity_text import time_text
from plants.bench.felt_force.felt_force import HALF_POWER, FeltForce
from plants.bench.felt_force.force_procedure import BenchPhase, ForceRecord

COLUMNS = {
    "error_rms_N": "felt rms (N)",
    "error_peak_N": "99 % (N)",
    "gauge_rms_N": "gauge rms (N)",
    "hysteresis_N": "hysteresis (N)",
    "bandwidth_Hz": "bandwidth (Hz)",
}
"""Figures of the table, with their heads."""

_STYLES = {"before": VERMILION, "after": BLUE}


STALL_S = 0.05
"""Gap between two readings that is reported, s: the far end then jumps by 1.5 mm at 30 mm/s."""


class ReelForces(NamedTuple):
    """Results of one reel: by `before` and `after`, one for each command."""

    label: str
    gains: Mapping[str, Gains]
    records: Mapping[str, Sequence[ForceRecord]]
    figures: Mapping[str, Sequence[FeltForce]]

    def rows(self) -> Iterator[tuple[str, ...]]:
        """Rows of the table: reel, command, gains, and the figures of `COLUMNS`."""
        for n, first in enumerate(self.figures["before"]):
            for name, each in self.figures.items():
                texts = [_text(each[n], column) for column in COLUMNS]
                yield self.label, f"{first.command_N:g}", name, *texts

    def stalls(self) -> Iterator[str]:
        """Warnings of gaps between the readings, in which nothing was commanded."""
        for name, records in self.records.items():
            longest_s = max(float(np.diff(record.time_s).max()) for record in records)
            if longest_s > STALL_S:
                yield (
                    f"Reel {self.label}, gains {name}: no setpoint arrived for "
                    f"{time_text(longest_s)}; its peaks and bandwidth are uncertain. Repeat the "
                    "test on a machine and a network with less to do."
                )


def page(reels: Sequence[ReelForces], source: str) -> Page:
    """The page of a bench.

    Args:
        reels: Results of the reels.
        source: Where the outside force comes from.
    """
    heads = ("reel", "at (N)", "gains", *COLUMNS.values())
    table = Table(heads, [row for reel in reels for row in reel.rows()], numeric=range(3, 8))
    how = (
        "Each reel held a constant tension while the far end of its cable moved: slowly at a "
        "constant speed, for the hysteresis, then in many frequencies at once, for the rms error "
        "felt and at the reel's own gauge, and the error exceeded in 1 % of the time. At last the "
        f"command oscillated, for the bandwidth. The outside force is {source}. "
        "Hysteresis is the felt force while the cable is pulled out minus that while it is wound "
        "in. The controller sees its own gauge only: what the eyelet adds, no gains remove."
    )
    notes = Warnings([note for reel in reels for note in reel.stalls()])
    sections = [Section(f"Reel {reel.label}", tuple(_blocks(reel))) for reel in reels]
    summary = (notes, table, Paragraph(how, "soft"))
    return Page("Felt force", Status(headline(reels)), summary, sections)


def headline(reels: Sequence[ReelForces]) -> str:
    """The result in one line."""
    return "; ".join(f"Reel {reel.label}: {_change(reel)}" for reel in reels)


def _change(reel: ReelForces) -> str:
    texts = []
    for name, column, unit in (
        ("felt error while moving", "error_rms_N", "N rms"),
        ("bandwidth", "bandwidth_Hz", "Hz"),
    ):
        values = [_text(each[0], column) for each in reel.figures.values()]
        texts.append(f"{name} {' to '.join(values)} {unit}")
    return f"{', '.join(texts)} at {reel.figures['before'][0].command_N:g} N"


def _text(figures: FeltForce, column: str) -> str:
    value = getattr(figures, column)
    return f"> {figures.frequencies_Hz[-1]:.3g}" if value is None else f"{value:.3g}"


def _blocks(reel: ReelForces) -> Iterator[Block]:
    for name, gains in reel.gains.items():
        yield Paragraph(f"Gains {name}: {gains}.")
    for n, record in enumerate(reel.records["before"]):
        yield Drawing(
            _figure(reel, n),
            f"reel_{reel.label}_{n}",
            f"Felt force of reel {reel.label} at {record.command_N:g} N",
            f"Command {record.command_N:g} N. Above: error of the felt force while the far end "
            "moves fast. Below: error over the position of the slowly moving far end, and felt "
            "force over command; the line is half power.",
        )


def _figure(reel: ReelForces, n: int) -> Figure:
    figure = new_figure(WIDTH_in, 5.2)
    grid = figure.add_gridspec(2, 2)
    moving = figure.add_subplot(grid[0, :])
    slow, ratio = (figure.add_subplot(grid[1, k]) for k in range(2))
    for name, records in reel.records.items():
        style: dict[str, Any] = {"color": _STYLES[name], "linewidth": 1.0, "label": name}
        fast, back = (records[n].of(phase) for phase in (BenchPhase.FAST, BenchPhase.SLOW))
        moving.plot(fast.time_s - fast.time_s[0], fast.felt_N - fast.command_N, **style)
        slow.plot(1e3 * back.position_m, back.felt_N - back.command_N, **style)
        felt = reel.figures[name][n]
        ratio.loglog(felt.frequencies_Hz, np.abs(felt.ratio), marker=".", **style)
    ratio.axhline(HALF_POWER, color=GREY, linewidth=0.8)
    finish(moving, "felt error (N)", "time (s)")
    finish(slow, "felt error (N)", "position of the far end (mm)")
    finish(ratio, "felt over command", "frequency (Hz)")
    legend(moving)
    return figure
