"""Report page of a suggestion: the gains in use, better ones, and what that rests on."""

from collections.abc import Iterator

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.loop_model.drawn_models import drawn_models, white_factor
from estune.loop_model.model import LoopModel, close_loop
from estune.loop_model.optimum import SENSITIVITY_MAX
from estune.run.results.frequency_figures import (
    Loop,
    PlantResponse,
    loop_drawings,
)
from estune.service_records.cause.page import sections
from estune.service_records.judged_records import JudgedRecords
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
from estune.support.plot_style import (
    BLUE,
    GREY,
    ORANGE,
    finish,
    legend,
    new_figure,
    stacked,
)
from estune.support.quantity_text import time_text

_DRAWS = 60
"""Models drawn for the bands of the responses."""

_POINTS_MAX = 2000
"""Samples of a curve; longer ones are thinned."""

_GOOD = {"change": True, "keep": True}


def page(suggestion: JudgedRecords) -> Page:
    """The page of a suggestion."""
    return Page(
        "Gains by records of operation",
        _headline(suggestion),
        (
            Table(("", "In use", "Recommended"), suggestion.rows(), numeric=(1, 2)),
            Paragraph(
                "Intervals are 95 % confidence intervals of what the records show, the cost is "
                f"that of a step in {time_text(suggestion.trial.cost.settling_time_s)}.",
                style="soft",
            ),
            *_replayed(suggestion),
            Warnings(suggestion.remarks()),
        ),
        (
            *sections(suggestion.cause),
            Section("Predicted responses", tuple(_responses(suggestion))),
            Section("Loop", tuple(_loop(suggestion))),
            Section("Records", tuple(_records(suggestion))),
        ),
    )


def _headline(suggestion: JudgedRecords) -> Status:
    """The cause and the verdict, in the order of the command line."""
    verdict, good = suggestion.heading(), _GOOD.get(suggestion.verdict)
    if suggestion.cause is None:
        return Status(verdict, good=good)
    cause = suggestion.cause.heading()
    title, detail = (verdict, cause) if suggestion.verdict_first else (cause, verdict)
    return Status(title, good=good, detail=detail)


def _replayed(suggestion: JudgedRecords) -> Iterator[Block]:
    compared = suggestion.replay
    if compared is not None and compared.agrees:  # else it is the first line, or a remark
        sentence = compared.sentence()
        yield Paragraph(f"{sentence[:1].upper()}{sentence[1:]}.", style="soft")


def _loops(suggestion: JudgedRecords) -> list[Loop]:
    loops: list[Loop] = [("in use", suggestion.in_use)] if suggestion.margins else []
    if suggestion.recommendation is not None:
        loops.append(("recommended", suggestion.recommendation.gains))
    return loops


def _responses(suggestion: JudgedRecords) -> Iterator[Block]:
    if not suggestion.judgement.can_tell:
        yield Paragraph(f"Nothing is predicted: {suggestion.judgement.reason}.")
        return
    figure, axes = stacked(3, 6.4)
    rate = suggestion.trial.controller.sampling_Hz
    for (label, gains), color in zip(reversed(_loops(suggestion)), (BLUE, ORANGE), strict=False):
        at, drawn = _signals(suggestion, gains)
        time = np.arange(at.shape[1]) / rate
        thin = slice(None, None, max(time.size // _POINTS_MAX, 1))
        low, high = np.quantile(drawn, (0.025, 0.975), axis=0)
        for ax, curve, least, most in zip(axes, at, low, high, strict=True):
            ax.fill_between(time[thin], least[thin], most[thin], color=color, alpha=0.2, lw=0.0)
            ax.plot(time[thin], curve[thin], color=color, label=label)
    axes[0].axhline(1.0, color=GREY, linewidth=0.8)
    finish(axes[0], "step response")
    finish(axes[1], "effort per step")
    finish(axes[2], "response to a load", "time, s")
    legend(axes[0])
    yield Drawing(
        figure,
        "responses",
        "Response to a step of the setpoint, effort, and response to a load, over time",
        "Predictions for a step of the setpoint of one, and for a load of one at the plant's "
        "input. The bands hold 95 % of the models that the records allow.",
    )


def _signals(suggestion: JudgedRecords, gains: Gains) -> tuple[FloatArray, FloatArray]:
    """Step response, effort and load response, shape (3, samples), and those of drawn models."""
    fit, settings = suggestion.fit, suggestion.trial.controller
    ones = np.ones(suggestion.trial.samples)

    def signals(model: LoopModel) -> FloatArray:
        loop = close_loop(model, gains, settings)
        output, effort = loop.setpoint_response(ones)
        return np.array([output, effort, loop.load_response(ones)[0]])

    with np.errstate(over="ignore", invalid="ignore"):
        drawn = np.array([signals(m) for m in drawn_models(fit, white_factor(fit), _DRAWS, 0)])
    return signals(fit.model), drawn[np.isfinite(drawn).all(axis=(1, 2))]


def _loop(suggestion: JudgedRecords) -> Iterator[Block]:
    if not suggestion.judgement.can_tell:
        return
    settings, loops = suggestion.trial.controller, _loops(suggestion)
    settling_s = suggestion.trial.cost.settling_time_s
    response = PlantResponse.of_fit(suggestion.fit, settings, settling_s)
    dead = suggestion.fit.model.dead_samples
    yield Paragraph(
        f"The plant is identified from the records with {suggestion.fit.order} poles and a dead "
        f"time of {dead} {'sample' if dead == 1 else 'samples'}; poles faster than a sample are "
        "dead time, too."
    )
    limit = suggestion.limits.max_sensitivity or SENSITIVITY_MAX
    yield from loop_drawings(response, settings, loops, limit)


def _records(suggestion: JudgedRecords) -> Iterator[Block]:
    rate = suggestion.trial.controller.sampling_Hz
    figure = new_figure(7.2, 2.8)
    ax = figure.add_subplot()
    longest = max(suggestion.stretches, key=lambda s: s.samples)
    time = longest.start_s + np.arange(longest.samples) / rate
    thin = slice(None, None, max(time.size // _POINTS_MAX, 1))
    ax.plot(time[thin], longest.measurement[thin], color=BLUE, label="measurement", lw=0.8)
    ax.plot(time[thin], longest.setpoint[thin], color=GREY, label="setpoint", lw=1.0)
    finish(ax, "signals", "time, s")
    legend(ax)
    yield Drawing(
        figure,
        "records",
        "Setpoint and measurement of the longest stretch over time",
        f"The longest stretch that was used, of {longest.log}.",
    )
    used = [
        (s.log, f"{s.start_s:.4g}", f"{s.start_s + s.samples / rate:.4g}", "used")
        for s in suggestion.stretches
    ]
    left = [
        (part.log, f"{part.start_s:.4g}", f"{part.stop_s:.4g}", part.reason)
        for part in suggestion.left_out
    ]
    yield Table(("log", "from s", "to s", ""), [*used, *left], numeric=(1, 2))
