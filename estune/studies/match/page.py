"""A matching as one offline page: the levels drawn, the records as a table, how it was done."""

from html import escape

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from estune.core.gains import GAIN_NAMES, GAIN_UNITS
from estune.studies.match.cost_estimate import CostEstimate
from estune.studies.match.outcome import Matching, ReelMatch
from estune.support.html_page import document, drawn, words
from estune.support.plot_style import (
    BLUE,
    GREEN,
    GREY,
    LIGHT,
    VERMILION,
    finish,
    legend,
    new_figure,
)

TITLE = "Equal transparency"

_STYLE = """
td:first-child, th:first-child { white-space: nowrap; }
td.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
td:last-child { white-space: normal; }
"""


def page(found: Matching) -> str:
    """The whole page as HTML."""
    by = "the worst of the tuned reels" if found.by_worst else "whoever asked for it"
    step, cost = found.step, found.cost
    header = (
        f"<h1>{TITLE}</h1>\n<p>{words(_sentence(found.heading()))}</p>\n"
        f'<p class="soft">{words(f"The target was chosen by {by}; a reel passes where the 95 % ")}'
        f"{words(f'interval of its cost lies within {100.0 * found.tolerance:g} % of it.')}</p>\n"
    )
    head = "".join(
        f"<th>{escape(name)}</th>"
        for name in ("Reel", "Tuned η", "Matched η", *_GAIN_HEADS, "Outcome")
    )
    rows = "".join(map(_row, found.reels))
    how = (
        f"Every trial was a step of {step.step_N:g} N from {step.preload_N:g} N, scored by the "
        f"cost (35) with a settling time of {cost.settling_time_s:.4g} s and a move weight of "
        f"{cost.move_weight:g}: the same for all reels, or their costs could not be compared. "
        "Each reel was tuned for its own least cost, then its P, I and D were made smaller by one "
        "factor until the cost met the target. The matched cost is from repeats that had no part "
        "in finding the gains."
    )
    main = (
        f"{drawn(figure(found), 'levels', found.heading())}"
        f'<div class="wide"><table>\n<tr>{head}</tr>\n{rows}</table></div>\n'
        f"<section><h2>How it was done</h2>\n<p>{words(how)}</p></section>\n"
    )
    return document(TITLE, header, main, _STYLE)


def figure(found: Matching) -> Figure:
    """The cost of each reel, tuned on its own and matched, with the target."""
    drawing = new_figure(7.2, 3.0)
    draw_levels(drawing.add_subplot(), found)
    return drawing


def draw_levels(ax: Axes, found: Matching) -> None:
    """Draws the levels with their 95 % intervals, one place for each reel."""
    share = found.tolerance * found.target
    ax.axhspan(found.target - share, found.target + share, color=LIGHT, linewidth=0)
    ax.axhline(found.target, color=GREY, linewidth=0.8, label=f"target {found.target:.4g}")
    reels = list(enumerate(found.reels))
    tuned = [(n - 0.12, r.tuned_level) for n, r in reels]
    passed = [(n + 0.12, r.level) for n, r in reels if r.passed]
    other = [(n + 0.12, r.level) for n, r in reels if not r.passed]
    _draw(ax, tuned, "o", BLUE, "tuned on its own")
    _draw(ax, passed, "s", GREEN, "matched, passes")
    _draw(ax, other, "X", VERMILION, "matched, does not pass")
    ax.set_xticks(range(len(found.reels)), [reel.label for reel in found.reels])
    ax.set_xlim(-0.5, len(found.reels) - 0.5)
    finish(ax, "cost η")
    legend(ax)


def _draw(
    ax: Axes, levels: list[tuple[float, CostEstimate | None]], marker: str, colour: str, label: str
) -> None:
    known = [(x, level) for x, level in levels if level is not None and level.high < float("inf")]
    if known:
        below = [level.cost - level.low for _, level in known]
        above = [level.high - level.cost for _, level in known]
        ax.errorbar(
            [x for x, _ in known],
            [level.cost for _, level in known],
            yerr=[below, above],
            fmt=marker,
            color=colour,
            markersize=4.5,
            elinewidth=1.0,
            capsize=2.5,
            label=label,
        )


_LABELS = {"setpoint_filter_s": "filter"}
_GAIN_HEADS = tuple(f"{_LABELS.get(name, name)}, {GAIN_UNITS[name]}" for name in GAIN_NAMES)


def _row(reel: ReelMatch) -> str:
    gains = reel.gains.as_tuple() if reel.gains else (None,) * len(GAIN_NAMES)
    numbers = [reel.tuned_level, reel.level, *gains]
    cells = "".join(f'<td class="number">{_cell(value)}</td>' for value in numbers)
    verdict = f'<span class="{"yes" if reel.passed else "no"}">{escape(str(reel.standing))}</span>'
    why = "" if reel.passed else f"<br>{words(reel.reason)}"
    return f"<tr><td>{escape(reel.label)}</td>{cells}<td>{verdict}{why}</td></tr>\n"


def _cell(value: CostEstimate | float | None) -> str:
    if value is None:
        return "&ndash;"
    return words(
        f"{value.cost:.4g} ± {100.0 * value.half_width:.1f} %"
        if isinstance(value, CostEstimate)
        else f"{value:.4g}"
    )


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."
