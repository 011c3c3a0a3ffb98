"""The page: every figure with its claim, in one file that needs nothing beside it."""

from collections.abc import Sequence
from html import escape
from importlib.metadata import version

from estune.support.html_page import document, drawn, words
from experiments.paper import PaperFigure

TITLE = "The paper's figures, made again"
PAPER = (
    "Otis, Nguyen-Dang, Laliberté, Ouellet, Laurendeau and Gosselin: Cable Tension Control and "
    "Analysis of Reel Transparency for 6-DOF Haptic Foot Platform on a Cable-Driven Locomotion "
    "Interface (2009)"
)


def page(made: Sequence[PaperFigure]) -> str:
    """The whole page as HTML."""
    held = sum(figure.holds for figure in made)
    failing = (
        "" if held == len(made) else ", and those that do not are shown as such, with the reason"
    )
    rows = "".join(_row(figure) for figure in made)
    sections = "".join(_section(figure) for figure in made)
    header = (
        f"<h1>{escape(TITLE)}</h1>\n"
        f"<p>Each figure is computed anew on simulated reels and benches; the paper's own machine "
        f"and data are not at hand. {held} of its {len(made)} claims hold here{failing}.</p>\n"
        f'<p class="soft">{escape(PAPER)}. Computed by estune {escape(version("estune"))}.</p>\n'
        f"<table>\n<tr><th>Figure</th><th>What the paper claims</th><th>Here</th></tr>\n{rows}"
        f"</table>\n"
    )
    return document(TITLE, header, sections)


def _row(made: PaperFigure) -> str:
    return (
        f'<tr><td><a href="#figure-{made.number}">Fig. {made.number}</a></td>'
        f"<td>{words(made.claim)}</td><td>{_verdict(made, 'holds', 'does not hold')}</td></tr>\n"
    )


def _section(made: PaperFigure) -> str:
    return (
        f'<section id="figure-{made.number}">\n'
        f"<h2>Fig. {made.number}. {escape(made.title)}</h2>\n"
        f"<blockquote>{words(made.claim)}</blockquote>\n"
        f"<p>{_verdict(made, 'Holds here.', 'Does not hold here.')} {words(made.measured)}</p>\n"
        f"{drawn(made.figure, f'figure-{made.number}', made.title)}"
        f'<p class="soft"><b>Rule.</b> {words(made.rule)}</p>\n'
        f'<p class="soft"><b>Note.</b> {words(made.caveat)}</p>\n</section>\n'
    )


def _verdict(made: PaperFigure, yes: str, no: str) -> str:
    return f'<span class="{"yes" if made.holds else "no"}">{yes if made.holds else no}</span>'
