"""The sweep on one page: its laws, the paper's figures of them, and every cell left out."""

from collections.abc import Iterator
from html import escape
from importlib.metadata import version

from estune.core.gains import GAIN_NAMES
from estune.errors import InvalidInput
from estune.studies.law.law import GainLaw
from estune.studies.sweep import figures
from estune.studies.sweep.result import Series, SweepResult
from estune.support.html_page import document, drawn, words

TITLE = "Gains over cable length"

_STYLE = "\ntd.number { text-align: right; }\n"


def page(result: SweepResult) -> str:
    """The whole page as HTML."""
    found = [(series, *_law(series)) for series in result.series]
    said = "".join(
        f"<p><b>{escape(series.label)}.</b> {words(law.sentence + '.' if law else why)}</p>\n"
        for series, law, why in found
    )
    header = (
        f"<h1>{escape(TITLE)}</h1>\n<p>{words(result.heading())}.</p>\n{said}"
        f'<p class="soft">Computed by estune {escape(version("estune"))}. Figures 12, 13 and 14 '
        "are the paper's, of these tunings.</p>\n"
    )
    sections = "".join(_section(n, series, law) for n, (series, law, _) in enumerate(found))
    return document(TITLE, header, sections + _asked(result) + _left_out(result), _STYLE)


def _law(series: Series) -> tuple[GainLaw | None, str]:
    try:
        return series.law(), ""
    except InvalidInput as error:
        return None, f"There is no law: {error}."


def _section(n: int, series: Series, law: GainLaw | None) -> str:
    body = "".join(_figures(n, series, law))
    return f"<section>\n<h2>{escape(series.label)}</h2>\n{body}</section>\n"


def _figures(n: int, series: Series, law: GainLaw | None) -> Iterator[str]:
    if any(outcome.trace.size for outcome in series.outcomes):
        yield "<p>Fig. 12. The cost over the search: median of the tunings at each length.</p>\n"
        costs = figures.draw_costs(series.outcomes)
        yield drawn(costs, f"costs-{n}", "Cost over search trials, one line a length")
        yield (
            "<p>Fig. 13. The integral gain over the search, as a mean of eight trials in a row; "
            "median of the tunings at each length.</p>\n"
        )
        integral = figures.draw_integral(series.outcomes)
        yield drawn(integral, f"integral-{n}", "Integral gain over search trials")
    if law is None:
        return
    left_out = [outcome for outcome in series.outcomes if outcome.excluded]
    order = ("I", *(name for name in GAIN_NAMES if name != "I"))
    for name in order:
        first = "Fig. 14. " if name == "I" else ""
        fit = law.fits[name]
        lack = fit.lack_of_fit
        tested = "" if lack is None else f", lack of fit p = {lack.p_value:.2g}"
        yield (
            f"<p>{first}{words(f'{name} = {fit.curve}')} over cable length; R&sup2; = "
            f"{fit.R2:.3f}{tested}.</p>\n"
        )
        drawing = figures.draw_law(law, name, left_out)
        yield drawn(drawing, f"law-{n}-{name}", f"{name} over cable length")
    for remark in law.remarks:
        yield f'<p class="soft">{words(remark)}</p>\n'


def _asked(result: SweepResult) -> str:
    """What every cell was told, in a table."""
    cells = [outcome.cell for outcome in result.outcomes]
    search = cells[0].search
    rows = {
        "rigs": ", ".join(dict.fromkeys(cell.rig.label for cell in cells)),
        "lengths": ", ".join(f"{value:g}" for value in sorted({c.length_m for c in cells})) + " m",
        "tensions": ", ".join(f"{v:g}" for v in sorted({c.tension_N for c in cells})) + " N",
        "tuners": ", ".join(dict.fromkeys(cell.tuner for cell in cells)),
        "repeats of each": str(result.design.seeds),
        "search trials": f"at most {search['trials']}",
        "price on moves": f"{cells[0].cost.move_weight:g}",
    }
    listed = "".join(f"<tr><td>{k}</td><td>{words(v)}</td></tr>\n" for k, v in rows.items())
    return f"<section>\n<h2>What was asked for</h2>\n<table>\n{listed}</table>\n</section>\n"


def _left_out(result: SweepResult) -> str:
    if not result.excluded:
        return ""
    rows = "".join(
        f"<tr><td>{words(outcome.cell.label)}</td><td>{words(outcome.excluded)}</td></tr>\n"
        for outcome in result.excluded
    )
    return (
        "<section>\n<h2>Left out of the laws</h2>\n<table>\n<tr><th>Tuning</th><th>Why</th></tr>\n"
        f"{rows}</table>\n</section>\n"
    )
