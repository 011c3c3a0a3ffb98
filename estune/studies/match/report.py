"""Report page of a matching: the costs as a figure, the records as a table, the procedure."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from estune.core.gains import GAIN_NAMES
from estune.studies.match.outcome import CostEstimate, Matching, ReelMatch
from estune.support.html_page import Cell, Drawing, Page, Paragraph, Section, Status, Table
from estune.support.plot_style import (
    BLUE,
    GREEN,
    GREY,
    LIGHT,
    VERMILION,
    WIDTH_in,
    finish,
    legend,
    new_figure,
)
from estune.support.quantity_text import axis_label, time_text

TITLE = "Equal transparency"


def page(matching: Matching) -> Page:
    """The page of a matching."""
    chosen_by = "the worst of the tuned reels" if matching.by_worst else "the user"
    rule = (
        f"The target was set by {chosen_by}; a reel passes if the 95 % confidence interval of "
        f"its cost lies within {100.0 * matching.tolerance:g} % of it."
    )
    heads = (
        axis_label("filter" if name == "setpoint_filter_s" else name, unit)
        for name, unit in matching.signals.gain_units.items()
    )
    columns = ("Reel", "Tuned η", "Matched η", *heads, "Outcome")
    table = Table(columns, tuple(map(_row, matching.reels)), numeric=range(1, len(columns) - 1))
    heading = matching.heading()
    return Page(
        TITLE,
        Status(f"{heading}.", good=matching.passed),
        (Paragraph(rule, style="soft"), Drawing(_figure(matching), "costs", heading), table),
        (Section("Procedure", (Paragraph(_procedure(matching)),)),),
    )


def _procedure(matching: Matching) -> str:
    step, cost = matching.step, matching.cost
    return (
        f"Every trial was a step from {matching.signals.step_text(step)}, with the same cost for "
        f"a settling time of {time_text(cost.settling_time_s)} and a move weight of "
        f"{cost.move_weight:g}. They are the same for all reels, so that costs are comparable. "
        "Each reel was tuned for its least cost. Its P, I and D were then reduced by one factor "
        "until the cost equalled the target. The matched cost is from repeats that were not used "
        "to find the gains."
    )


def _figure(matching: Matching) -> Figure:
    """The tuned and the matched cost of each reel with their 95 % intervals, and the target."""
    figure = new_figure(WIDTH_in, 3.0)
    ax = figure.add_subplot()
    target, reels = matching.target, matching.reels
    share = matching.tolerance * target
    ax.axhspan(target - share, target + share, color=LIGHT, linewidth=0)
    ax.axhline(target, color=GREY, linewidth=0.8, label=f"target {target:.4g}")
    tuned = {n - 0.12: reel.tuned_cost for n, reel in enumerate(reels)}
    passed = {n + 0.12: reel.cost for n, reel in enumerate(reels) if reel.passed}
    missed = {n + 0.12: reel.cost for n, reel in enumerate(reels) if not reel.passed}
    _draw(ax, tuned, "o", BLUE, "tuned on its own")
    _draw(ax, passed, "s", GREEN, "matched, passes")
    _draw(ax, missed, "X", VERMILION, "matched, does not pass")
    ax.set_xticks(range(len(reels)), [reel.label for reel in reels])
    ax.set_xlim(-0.5, len(reels) - 0.5)
    finish(ax, "cost η")
    legend(ax)
    return figure


def _draw(
    ax: Axes, costs: dict[float, CostEstimate | None], marker: str, colour: str, label: str
) -> None:
    """Costs by abscissa, without those that have no upper limit."""
    closed = {x: cost for x, cost in costs.items() if cost and cost.high < float("inf")}
    if closed:
        means = [cost.cost for cost in closed.values()]
        below = [cost.cost - cost.low for cost in closed.values()]
        above = [cost.high - cost.cost for cost in closed.values()]
        ax.errorbar(
            list(closed), means, yerr=[below, above], fmt=marker, color=colour, label=label,
            markersize=4.5, elinewidth=1.0, capsize=2.5,
        )  # fmt: skip


def _row(reel: ReelMatch) -> tuple[Cell, ...]:
    gains = reel.gains.as_tuple() if reel.gains else (None,) * len(GAIN_NAMES)
    reason = "" if reel.passed else reel.reason
    return (
        reel.label,
        _text(reel.tuned_cost),
        _text(reel.cost),
        *map(_text, gains),
        Status(str(reel.outcome), reel.passed, reason),
    )


def _text(value: CostEstimate | float | None) -> str:
    if value is None:
        return "\N{EN DASH}"
    if isinstance(value, CostEstimate):
        return f"{value.cost:.4g} ± {100.0 * value.half_width:.1f} %"
    return f"{value:.4g}"
