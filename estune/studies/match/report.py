"""Report page of a matching: the costs as a figure, the records as a table, the procedure."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from estune.studies.match.outcome import CostEstimate, Matching
from estune.studies.page import study_page
from estune.support.html_page import Drawing, Page, Paragraph, Status
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
from estune.support.quantity_text import time_text

TITLE = "Equal transparency"


def page(matching: Matching) -> Page:
    """The page of a matching."""
    chosen_by = "the worst of the tuned reels" if matching.by_worst else "the user"
    rule = (
        f"The target was set by {chosen_by}; a reel passes if the 95 % confidence interval of "
        f"its cost lies within {100.0 * matching.tolerance:g} % of it."
    )
    heading = matching.heading()
    return study_page(
        TITLE,
        Status(f"{heading}.", good=matching.passed),
        (Paragraph(rule, style="soft"), Drawing(_figure(matching), "costs", heading)),
        matching.table(),
        procedure=_procedure(matching),
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
