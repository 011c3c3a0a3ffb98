"""The page of a diagnosis: one HTML file that needs nothing beside it."""

import math
from collections.abc import Callable, Iterable
from functools import partial
from html import escape
from importlib.metadata import version
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from estune.errors import InvalidInput
from estune.run.export import replace_file
from estune.support.html_page import document, drawn, words
from estune.support.plot_style import WIDTH_in, new_figure
from plants.diagnosis.report import figures, summary
from plants.diagnosis.report.diagnosis import Diagnosis, Trace
from plants.diagnosis.report.summary import Table

STYLE = """
.verdict { border-left: 4px solid var(--no); padding-left: .9rem; }
.verdict.sure { border-color: var(--yes); }
.lead { font-size: 1.08rem; }
h3 { font-size: 1rem; margin: 1.6rem 0 .3rem; }
table { margin: .8rem 0; }
table.told td:last-child { white-space: normal; }
code { font: .88rem/1.4 ui-monospace, "SFMono-Regular", Menlo, Consolas, monospace; }
pre { overflow-x: auto; padding: .6rem .8rem; border: 1px solid var(--rule); }
"""

TITLE = "Where simulation and measurement disagree"


def write(d: Diagnosis, path: Path) -> Path:
    """Writes the page, whole or not at all.

    Raises:
        InvalidInput: it cannot be written there.
    """
    text = page(d)
    try:
        replace_file(path, text.encode())
    except OSError as error:
        raise InvalidInput(f"{path}: {error.strerror or error}; give another file") from error
    return path


def page(d: Diagnosis) -> str:
    """The whole page as HTML."""
    sure = " sure" if d.verdict in {"named", "none"} else ""
    told = "".join(f'<p class="lead">{words(text)}</p>\n' for text in summary.sentences(d))
    header = (
        f"<h1>{TITLE}</h1>\n"
        f'<div class="verdict{sure}"><h2>{words(summary.heading(d))}</h2>\n{told}</div>\n'
        f"{table_html(summary.gaps(d))}"
        '<p class="soft">The figures are of records that were used neither to fit nor to choose. '
        "The floor is the noise of the sensors and what no two simulations agree to; a short "
        "prediction begins anew from the measured angle every few moments, a free run never."
        f"</p>\n"
    )
    sections = (
        _found(d),
        _before_after(d),
        _where(d),
        _ranking(d),
        _calibrations(d),
        _next(d),
        _data(d),
    )
    return document(TITLE, header, "".join(sections), STYLE)


def table_html(table: Table, kind: str = "") -> str:
    """A table as HTML."""
    head = "".join(f"<th>{words(cell)}</th>" for cell in table.columns)
    rows = "".join(
        f"<tr>{''.join(f'<td>{words(cell)}</td>' for cell in row)}</tr>\n" for row in table.rows
    )
    look = f' class="{kind}"' if kind else ""
    return f'<div class="wide"><table{look}>\n<tr>{head}</tr>\n{rows}</table></div>\n'


def _found(d: Diagnosis) -> str:
    if not d.effects:
        return ""
    seen = "".join(
        f"<p><b>{escape(effect.title)}</b> (<code>{escape(effect.name)}</code>) looks like this "
        f"in data: {words(effect.effect.appearance)}.</p>\n"
        for effect in d.effects
    )
    return _section("What was found", seen + table_html(summary.parameters(d)))


def _before_after(d: Diagnosis) -> str:
    shown = ""
    if d.traces:
        trace = figures.most_telling(d)
        shown += (
            f"<p>Record <code>{escape(trace.name)}</code> in free run: only the command goes in. "
            "Above, the stretch in which the base model is worst; below, the error over the whole "
            "record.</p>\n"
        )
        shown += drawn(_trace_figure(trace), "traces", "a record before and after")
        shown += "<h3>Over frequency</h3>\n"
        shown += _one(lambda ax: figures.draw_spectrum(ax, d), "spectrum", "error over frequency")
    if len(d.steps) > 1:
        shown += "<h3>Step by step</h3>\n"
        shown += _one(lambda ax: figures.draw_gap(ax, d), "gap", "gap after each step")
        shown += table_html(summary.steps(d))
    return _section("Before and after" if d.effects else "What the model predicts", shown)


def _where(d: Diagnosis) -> str:
    if not d.where.blocks:
        return ""
    height = 1.0 + 0.32 * len({v.name for b in d.where.blocks for v in b.views})
    shown = (
        "<p>The residual of the base model with its own numbers fitted, before any effect was. "
        "Each block is one of its balances, so that what is missing shows in the block it belongs "
        "to; grey is what noise alone would give.</p>\n"
    )
    shown += _one(lambda ax: figures.draw_shares(ax, d), "shares", "shares", height)
    for block in d.where.blocks:
        shown += f"<h3>{words(block.title[:1].upper() + block.title[1:])}</h3>\n"
        shown += drawn(figures.block_figure(block), f"block-{block.name}", block.title)
    if d.where.distortion:
        shown += (
            "<h3>Lines that a periodic setpoint does not excite</h3>\n"
            "<p>A linear plant answers on the excited lines alone. A law that bends both ways "
            "alike adds odd lines, one that does not even lines as well. Drawn is the record of "
            "each channel that shows most.</p>\n"
        )
    for channel, distortion in figures.most_distorted(d).items():
        draw = partial(figures.draw_distortion, distortion=distortion)
        shown += _one(draw, f"distortion-{channel}", f"lines of {channel}")
    if d.where.distortion:
        shown += table_html(summary.distortions(d))
    return _section("Where it shows", shown)


def _ranking(d: Diagnosis) -> str:
    shown = (
        "<p>Every effect was tried as the first one. “Explains” is the share of the residual that "
        "points the way the effect would change it, on the fit split; the best were fitted with "
        "the base model, and judged by what they leave on the rank split.</p>\n"
    )
    fitted = [c for c in d.candidates if math.isfinite(c.gap)]
    if fitted:
        height = 1.0 + 0.3 * min(len(fitted), figures.MOST_BARS)
        shown += _one(lambda ax: figures.draw_ranking(ax, d), "ranking", "gap left", height)
    shown += table_html(summary.ranking(d), "told")
    if summary.reasons(d):
        shown += "<h3>Ruled out</h3>\n" + _list(summary.reasons(d))
    if d.not_excited:
        shown += "<h3>What these records cannot show</h3>\n"
        rows = tuple((name, reason) for name, reason in d.not_excited.items())
        shown += table_html(Table(("effect", "why"), rows), "told")
    return _section("What was tried", shown)


def _calibrations(d: Diagnosis) -> str:
    if not d.calibrations:
        return ""
    shown = "<p>Numbers of the base model that were free in every fit.</p>\n"
    if d.effects:
        shown = (
            "<p>An effect that is missing pulls the base model's numbers off. Where they come "
            "back with the effect, that is evidence too.</p>\n"
        )
    count = len(figures.scalable(d))
    if count:
        height = 0.9 + 0.36 * count
        shown += _one(
            lambda ax: figures.draw_calibrations(ax, d), "calibrations", "shifts", height
        )
    return _section("The base model's numbers", shown + table_html(summary.calibrations(d)))


def _next(d: Diagnosis) -> str:
    if d.next_experiment is None:
        return ""
    return _section(
        "What to measure next",
        f"<p>{words(_sentence(d.next_experiment.sentence))}</p>\n<p><code>estune explain</code> "
        "with <code>--next</code> writes its trial file; then</p>\n"
        f"<pre>{escape(d.next_experiment.command)}</pre>\n"
        "<p>runs it on the rig, and its record joins the data.</p>\n",
    )


def _data(d: Diagnosis) -> str:
    records = len({part.record for part in d.splits})
    shown = (
        f"<p>{records} records. Each stretch serves one end: effects are fitted on the first "
        "kind, chosen on the second, and the figures above are of the third.</p>\n"
    )
    shown += _one(
        lambda ax: figures.draw_splits(ax, d), "splits", "splits", 0.9 + 0.24 * max(records, 2)
    )
    shown += "<h3>Noise</h3>\n" + table_html(summary.noises(d))
    if d.findings:
        shown += "<h3>What was wrong with the files</h3>\n"
        shown += table_html(summary.findings(d), "told")
    shown += f'<p class="soft">Made by estune {escape(version("estune"))}.</p>\n'
    return _section("The data", shown)


def _section(title: str, inner: str) -> str:
    return f"<section>\n<h2>{escape(title)}</h2>\n{inner}</section>\n"


def _list(items: Iterable[str]) -> str:
    return f"<ul>\n{''.join(f'<li>{words(item)}</li>' for item in items)}\n</ul>\n"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def _one(draw: Callable[[Axes], Axes], name: str, alt: str, height_in: float = 3.0) -> str:
    """A drawing with one pair of axes."""
    figure = new_figure(WIDTH_in, height_in)
    draw(figure.add_subplot())
    return drawn(figure, name, alt)


def _trace_figure(trace: Trace) -> Figure:
    figure = new_figure(WIDTH_in, 5.0)
    above, below = figure.subplots(2, 1, height_ratios=(1.5, 1.0))
    figures.draw_trace(above, trace)
    figures.draw_error(below, trace)
    return figure
