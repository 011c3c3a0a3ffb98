"""Report page of a comparison of tuners: cost over the trials, gains and unsafe trials."""

import math
from collections.abc import Mapping

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from estune.core.gains import GAIN_NAMES
from estune.run.ending import RunEnding
from estune.run.results.result import TuneResult
from estune.studies.compare.comparison import Comparison, behaviour_of, searched
from estune.studies.page import study_page
from estune.studies.table import NOTHING, StudyRow, StudyTable
from estune.support.html_page import Drawing, Page, Status
from estune.support.plot_style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    VERMILION,
    WIDTH_in,
    finish,
    legend,
    new_figure,
)
from estune.support.quantity_text import axis_label, time_text

WITHIN = 1.05
"""Cost over the least one up to which a tuner has come near it."""

_COLOURS = (BLUE, GREEN, PURPLE, VERMILION, ORANGE, GREY)
_MARKERS = "osD^vX"
_HEADS = {"setpoint_filter_s": "filter"}

_FIGURES = (
    *("search trials", "all trials", "unsafe", "start cost", "cost", "overshoot", "Ms"),
    *("tracking", "reversals", "rest"),
)


def page(comparison: Comparison) -> Page:
    """The page of a comparison."""
    results = comparison.results
    headline, first = _headline(results), next(iter(results.values()))
    rig, step, cost = first.rig, first.plan.step, first.plan.cost
    how = (
        f"Each tuner began at {rig.gains_text(first.start_gains)} and had at most "
        f"{first.plan.trials} search trials of a step from {rig.step_text(step)}, with the same "
        f"cost for a settling time of {time_text(cost.settling_time_s)}. The tuners ran one after "
        "the other. The cost is from repeats after the search, interleaved with the start. "
        "Results within the limits of sensitivity and overshoot come first, then those whose "
        "limits are not shown, then those that break one, each by cost; only model_based keeps "
        "limits while it searches. Ms is given where the records allow it to be claimed. Tracking "
        "and reversals are the errors on a slow triangle after the tuning, rest the deviation of "
        "a settled loop, all at the recommended gains."
    )
    return study_page(
        f"Tuners compared on {rig.name}",
        Status(f"{headline}."),
        (
            Drawing(cost_figure(results), "costs", headline, csv=_csv(results)),
            Drawing(gain_figure(results), "gains", "Recommended gains and unsafe trials"),
        ),
        table(results),
        procedure=how,
    )


def _headline(results: Mapping[str, TuneResult]) -> str:
    """The best result that may be used, and the tuner that came near its cost first."""
    best = next(iter(results))
    ending, least = results[best].ending, results[best].fun
    needed = {}
    for name, result in results.items():
        near = (searched(result)["best_cost"] <= WITHIN * least).to_numpy()
        if near.any():
            needed[name] = int(near.argmax()) + 1
    within = " within the limits" if ending is RunEnding.TUNED else f" ({ending})"
    told = f"{best} reached the lowest confirmed cost{within}, {least:.3g}"
    if not needed:
        return told
    soonest = min(needed, key=lambda name: needed[name])
    trials = f"{needed[soonest]} search trial{'s' if needed[soonest] > 1 else ''}"
    return f"{told}; {soonest} came within 5 % of it first, after {trials}"


def table(results: Mapping[str, TuneResult]) -> StudyTable:
    """The tuners, a row each."""
    rows = tuple(_row(name, result) for name, result in results.items())
    return StudyTable("tuner", _FIGURES, next(iter(results.values())).rig.gain_units, rows)


def _row(name: str, result: TuneResult) -> StudyRow:
    at, margins = result.tuned or result.start, result.claim.margins
    overshoot = math.nan if at.metrics is None else at.metrics.overshoot
    figures = (
        *(str(result.nit), str(result.nfev), str(result.unsafe)),
        *(f"{result.verdict.start_cost:.4g}", f"{result.fun:.4g}"),
        f"{overshoot:.1%}" if math.isfinite(overshoot) else NOTHING,
        NOTHING if margins is None else f"{margins.sensitivity.value:.2f}",
        *(
            result.rig.measured(value, 3) if math.isfinite(value) else NOTHING
            for value in behaviour_of(result)
        ),
    )
    return StudyRow(name, figures, result.gains, str(result.ending), result.ending.good)


def cost_figure(results: Mapping[str, TuneResult]) -> Figure:
    """Cost of each search trial and the lowest so far, one colour a tuner."""
    figure = new_figure(WIDTH_in, 3.4)
    ax: Axes = figure.add_subplot()
    for name, colour, marker, result in _looks(results):
        frame = searched(result)
        trial = range(1, len(frame) + 1)
        cost = frame["cost"].where(~frame["unsafe"])
        ax.plot(trial, cost, marker, color=colour, markersize=2.5, alpha=0.6, markeredgewidth=0)
        ax.plot(
            trial, frame["best_cost"], color=colour, linewidth=1.4, drawstyle="steps-post",
            label=name, marker=marker, markevery=[-1], markersize=5,
        )  # fmt: skip
    start = next(iter(results.values())).verdict.start_cost
    ax.axhline(start, color=GREY, linewidth=0.9, linestyle="--")
    ax.set_yscale("log")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    finish(ax, "cost, and lowest so far", "search trial")
    legend(ax)
    return figure


def gain_figure(results: Mapping[str, TuneResult]) -> Figure:
    """Recommended gains and number of unsafe trials of each tuner."""
    figure = new_figure(WIDTH_in, 0.9 + 0.28 * len(results))
    axes = figure.subplots(1, 1 + len(GAIN_NAMES), sharey=True)
    for n, (_, colour, marker, result) in enumerate(_looks(results)):
        values = (*result.gains.as_tuple(), float(result.unsafe))
        for ax, value in zip(axes, values, strict=True):
            ax.plot([value], [n], marker, color=colour, markersize=5, clip_on=False)
    units = next(iter(results.values())).rig.gain_units
    for ax, name in zip(axes, (*GAIN_NAMES, "unsafe"), strict=True):
        finish(ax, "", axis_label(_HEADS.get(name, name), units.get(name, "")))
        ax.set_xlim(0.0, 1.15 * ax.dataLim.xmax or 1.0)
        ax.xaxis.set_major_locator(MaxNLocator(2, integer=name == "unsafe"))
        ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))  # short: they stand side by side
    axes[0].set_yticks(range(len(results)), list(results))
    axes[0].set_ylim(len(results) - 0.5, -0.5)
    return figure


def _looks(results: Mapping[str, TuneResult]) -> list[tuple[str, str, str, TuneResult]]:
    """Name, colour, marker and result of each tuner."""
    return [
        (name, _COLOURS[n % len(_COLOURS)], _MARKERS[n % len(_MARKERS)], result)
        for n, (name, result) in enumerate(results.items())
    ]


def _csv(results: Mapping[str, TuneResult]) -> str:
    import pandas as pd  # noqa: PLC0415  slow to import

    columns = ["number", *GAIN_NAMES, "cost", "best_cost", "unsafe"]
    frames = {name: searched(result)[columns] for name, result in results.items()}
    table = pd.concat(frames, names=["tuner"]).reset_index("tuner")
    return str(table.to_csv(index=False, lineterminator="\n"))
