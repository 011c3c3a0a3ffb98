"""The page of a diagnosis: one HTML file that needs nothing beside it."""

from collections.abc import Callable
from functools import partial

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from estune.support import html_page
from estune.support.html_page import Block, Drawing, Heading, Page, Paragraph, Section
from estune.support.plot_style import WIDTH_in, new_figure
from plants.diagnosis.report import figures, residual_figures, summary
from plants.diagnosis.residual.localisation import ResidualLocation
from plants.diagnosis.result import DiagnosisResult, Trace
from plants.remedies import text as remedies

TITLE = "Where simulation and measurement disagree"


def page(d: DiagnosisResult) -> Page:
    """The page of a diagnosis."""
    certain = d.verdict in {"named", "none"}
    lead = [Paragraph(text, "lead") for text in summary.sentences(d)]
    explained = Paragraph(
        "Short-prediction errors are cross-validated: the model is refitted three times, each "
        "time without one third of the data, and tested on that third. The model as given is not "
        "refitted. Free runs use models fitted to all data. No model was fitted to held-out "
        "records, if there are any. The noise floor is the noise of the sensors with an allowance "
        "for the form of the model. A short prediction is restarted from the measurement at "
        "regular intervals; a free run is not.",
        "soft",
    )
    sections = (
        Section("What was found", _effects(d)),
        Section("Before and after" if d.effects else "What the model predicts", _traces(d)),
        Section("What is unexplained", _where(d.unexplained, _LEFT)),
        Section("What can be done", _remedies(d)),
        *([Section("Where the effects show", _where(d.where, _EFFECTS))] if d.effects else ()),
        Section("What was tried", _ranking(d)),
        Section("The base model's numbers", _calibrations(d)),
        Section("What to measure next", _next_experiment(d)),
        Section("The data", _data(d)),
    )
    headline = html_page.Status(summary.heading(d), good=certain)
    return Page(TITLE, headline, (*lead, _table(summary.gaps(d)), explained), sections)


def _effects(d: DiagnosisResult) -> list[Block]:
    if not d.effects:
        return []
    looks = [
        Paragraph(f"**{e.title}** (`{e.name}`) looks like this in data: {e.effect.appearance}.")
        for e in d.effects
    ]
    return [*looks, _table(summary.parameters(d))]


def _traces(d: DiagnosisResult) -> list[Block]:
    blocks: list[Block] = []
    if d.traces:
        trace = summary.worst_trace(d)
        blocks += [
            Paragraph(
                f"Record `{trace.name}` in free run, with the recorded command as the only input. "
                "Above: the part with the largest error of the base model; below: the error over "
                "the whole record."
            ),
            Drawing(_trace_figure(trace), "traces", "a record before and after"),
            Heading("Over frequency"),
            _plot(lambda ax: figures.draw_spectrum(ax, d), "spectrum", "error over frequency"),
        ]
    if len(d.steps) > 1:
        blocks += [
            Heading("Step by step"),
            _plot(lambda ax: figures.draw_gap(ax, d), "gap", "prediction error after each step"),
            _table(summary.steps(d)),
        ]
    return blocks


def _remedies(d: DiagnosisResult) -> list[Block]:
    offers = d.remedies()
    table = html_page.Table(remedies.COLUMNS, remedies.rows(offers), ())
    sentences = [Paragraph(text) for text in remedies.sentences(d, offers)]
    if not offers:
        return [*sentences]
    return [
        Paragraph(
            "Ratios with the remedy to without, at the same gains, predicted with the model found "
            "here: cost of a step, rms error on a slow triangle, greatest error after a reversal, "
            "standard deviation at rest. In brackets what the intervals of the numbers make of "
            "them. `estune remedy` writes a remedy in the loop as a patch of the rig's file, and "
            "`estune prove` measures it on the rig."
        ),
        table,
        html_page.Table(remedies.WORK_COLUMNS, remedies.work_rows(offers), ()),
        *sentences,
    ]


_LEFT = (
    "What the model leaves of each of its balance equations, with the effects that were found. "
    "Shares are of the power on stretches of time that are left out: each variable takes off so "
    "much by its mean in each of a few bins, the strongest first. Over frequency it is what "
    "follows the explained part by any linear response. Grey is the level of noise alone."
)
_EFFECTS = (
    "The residual of the refitted base model, without any added effect. A missing effect appears "
    "in the balance it acts on."
)


def _where(where: ResidualLocation, text: str) -> list[Block]:
    if not where.blocks:
        return []
    height = 1.0 + 0.32 * len({v.name for b in where.blocks for v in b.views})
    blocks: list[Block] = [
        Paragraph(text),
        _plot(lambda ax: residual_figures.draw_shares(ax, where), "shares", "shares", height),
    ]
    for block in where.blocks:
        drawing = residual_figures.block_figure(block)
        heading = Heading(block.title[:1].upper() + block.title[1:])
        blocks += [heading, Drawing(drawing, f"block-{block.name}", block.title)]
    return blocks


def _ranking(d: DiagnosisResult) -> list[Block]:
    blocks: list[Block] = [
        Paragraph(
            "Every effect was screened as the first missing one. The screening R² is the share of "
            "the residual that is explained by the direction in which the effect changes the "
            "predictions. The effects with the largest shares were fitted together with the base "
            "model to all data, and are judged by the share of the error power above the noise "
            "floor that they explain. The probability of a family is that of any of its members."
        )
    ]
    count = len(summary.fitted(d, figures.BARS_MAX).rows)
    if count:
        draw = partial(figures.draw_ranking, d=d)
        blocks.append(_plot(draw, "ranking", "error left", 1.0 + 0.3 * count))
    blocks.append(_table(summary.ranking(d)))
    if d.not_excited:
        blocks += [Heading("What these records cannot show"), _table(summary.not_excited(d))]
    return blocks


def _calibrations(d: DiagnosisResult) -> list[Block]:
    if not d.calibrations:
        return []
    text = (
        "A missing effect biases the parameters of the base model. Parameters that return to the "
        "given values when the effect is added are further evidence for it."
        if d.effects
        else "Parameters of the base model that were free in every fit."
    )
    blocks: list[Block] = [Paragraph(text)]
    count = len(figures.scalable(d))
    if count:
        draw = partial(figures.draw_calibrations, d=d)
        blocks.append(_plot(draw, "calibrations", "shifts", 0.9 + 0.36 * count))
    return [*blocks, _table(summary.calibrations(d))]


def _next_experiment(d: DiagnosisResult) -> list[Block]:
    if d.next_recording is not None:
        table = "`estune explain` with `--next` writes it as a table."
        paragraphs = [Paragraph(remedies.full_sentence(d.next_recording.sentence))]
        return [*paragraphs, *([Paragraph(table)] if d.next_recording.columns else [])]
    if d.next_experiment is None:
        return []
    return [
        Paragraph(remedies.full_sentence(d.next_experiment.sentence)),
        Paragraph("`estune explain` with `--next` writes its trial file; then"),
        Paragraph(d.next_experiment.command, "code"),
        Paragraph("runs it on the rig, and its record joins the data."),
    ]


def _data(d: DiagnosisResult) -> list[Block]:
    records = len({trace.name for trace in d.traces})
    blocks: list[Block] = [
        Paragraph(
            f"{records} records. Models are fitted to all data and compared on all data. A third "
            "that is left out in cross-validation has a part of every record."
        ),
        Heading("Noise"),
        _table(summary.noises(d)),
    ]
    if d.findings:
        blocks += [Heading("Issues of the files"), _table(summary.findings(d))]
    return blocks


def _table(table: summary.TextTable) -> html_page.Table:
    return html_page.Table(table.columns, table.rows, table.numeric)


def _plot(
    draw: Callable[[Axes], Axes], name: str, alt: str, height_in: float = 3.0
) -> html_page.Drawing:
    figure = new_figure(WIDTH_in, height_in)
    draw(figure.add_subplot())
    return Drawing(figure, name, alt)


def _trace_figure(trace: Trace) -> Figure:
    figure = new_figure(WIDTH_in, 5.0)
    above, below = figure.subplots(2, 1, height_ratios=(1.5, 1.0))
    figures.draw_trace(above, trace)
    figures.draw_error(below, trace)
    return figure
