"""Report page of a sweep: its laws, the paper's figures of them, and the excluded cells."""

import math
from collections.abc import Iterator
from operator import attrgetter

from estune.core.gains import GAIN_NAMES
from estune.studies.law.law import GainLaw
from estune.studies.page import study_page
from estune.studies.sweep import figures
from estune.studies.sweep.exclusions import exclusion_sentences
from estune.studies.sweep.outcome import CellOutcome
from estune.studies.sweep.result import Series, SweepResult
from estune.studies.table import NOTHING, StudyRow, StudyTable
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

_POINTS_MAX = 2000
"""Points that the page offers as CSV; cells.csv has them all."""

TITLE = "Gains over cable length"

_ROWS_MAX = 100
"""Tunings that the page lists; cells.csv has them all."""


def page(result: SweepResult) -> Page:
    """The page of a sweep."""
    laws = [(series, series.law_or_reason()) for series in result.series]
    sentences = [
        Paragraph(f"**{series.label}.** {_sentence(law)}", style="lead") for series, law in laws
    ]
    sections = [
        Section(series.label, tuple(_figures(n, series, law)))
        for n, (series, law) in enumerate(laws)
    ]
    complete = not result.excluded and all(isinstance(law, GainLaw) for _, law in laws)
    note = Paragraph("Figures 12, 13 and 14 are the paper's, of these tunings.", style="soft")
    counted = [Paragraph(f"{sentence}.") for sentence in exclusion_sentences(result.outcomes)]
    table = _table(result)
    if len(table.rows) < len(result.outcomes):
        more = len(result.outcomes) - len(table.rows)
        counted.append(Paragraph(f"{more} more are listed in cells.csv.", style="soft"))
    return study_page(
        TITLE,
        Status(f"{result.heading()}.", good=complete or None),
        (*sentences, note, *counted),
        table,
        sections=(*sections, Section("Design", (_design(result),))),
    )


def _sentence(law: GainLaw | str) -> str:
    return f"{law.sentence}." if isinstance(law, GainLaw) else f"There is no law: {law}."


def _figures(n: int, series: Series, law: GainLaw | str) -> Iterator[Block]:
    if any(outcome.trials for outcome in series.outcomes):
        yield Drawing(
            series.plot_costs(),
            f"costs-{n}",
            "Cost over search trials, one line a length",
            "Fig. 12. The cost over the search: median of the tunings at each length.",
        )
        yield Drawing(
            series.plot_integral(),
            f"integral-{n}",
            "Integral gain over search trials",
            "Fig. 13. The integral gain over the search, as a running mean; "
            "median of the tunings at each length.",
        )
    if isinstance(law, str):
        return
    excluded = [outcome for outcome in series.outcomes if outcome.excluded]
    for name in sorted(GAIN_NAMES, key="I".__ne__):  # the paper's Fig. 14 first
        fit = law.fits[name]
        lack = fit.lack_of_fit
        test = "" if lack is None else f", lack of fit p = {lack.p_value:.2g}"
        yield Drawing(
            figures.draw_law(law, name, excluded),
            f"law-{n}-{name}",
            f"{name} over cable length",
            f"{'Fig. 14. ' * (name == 'I')}{name} = {fit.curve} over cable length; "
            f"R² = {fit.R2:.3f}{test}.",
            csv=_points_csv(law, name),
        )
    yield Warnings(law.remarks)


def _points_csv(law: GainLaw, name: str) -> str:
    """The points of a law's figure; empty where they are too many for the page."""
    points = law.fits[name].points
    if points.length_m.size > _POINTS_MAX:
        return ""
    rows = zip(points.length_m, points.tension_N, points.gain, points.own_error, strict=True)
    lines = [",".join(f"{value:.9g}" for value in row) for row in rows]
    return "\n".join([f"length_m,tension_N,{name},{name}_error", *lines, ""])


def _design(result: SweepResult) -> Table:
    cell = result.outcomes[0].cell
    places = attrgetter("cell.rig.label", "cell.length_m", "cell.tension_N", "cell.tuner")
    rigs, lengths, tensions, tuners = map(set, zip(*result.outcomes.groups(places), strict=True))
    rows = {
        "rigs": ", ".join(sorted(rigs)),
        "lengths": ", ".join(f"{value:g}" for value in sorted(lengths)) + " m",
        "tensions": ", ".join(cell.signals.measured(value, 6) for value in sorted(tensions)),
        "tuners": ", ".join(sorted(tuners)),
        "repeats of each": str(result.design.seeds),
        "search trials": f"at most {cell.search['trials']}",
        "control-move penalty": f"{cell.cost.move_weight:g}",
    }
    return Table((), tuple(rows.items()))


def _table(result: SweepResult) -> StudyTable:
    """The tunings, those that the laws exclude first."""
    excluded = result.excluded[:_ROWS_MAX]
    used = result.outcomes.where(lambda outcome: not outcome.excluded)
    rows = tuple(map(_row, (*excluded, *used[: _ROWS_MAX - len(excluded)])))
    signals = result.outcomes[0].cell.signals
    return StudyTable("tuning", ("trials", "start cost", "cost"), signals.gain_units, rows)


def _row(outcome: CellOutcome) -> StudyRow:
    costs = (outcome.start_cost, outcome.cost)
    figures = (f"{cost:.4g}" if math.isfinite(cost) else NOTHING for cost in costs)
    return StudyRow(
        outcome.cell.label,
        (str(outcome.trials), *figures),
        outcome.gains,
        str(outcome.ending),
        not outcome.excluded,
        outcome.excluded,
    )
