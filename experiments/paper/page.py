"""The page of the paper's figures, with a verdict on each."""

from collections.abc import Sequence

from estune.support.html_page import (
    Drawing,
    Link,
    Page,
    Paragraph,
    Section,
    Status,
    Table,
)
from experiments.paper import PaperFigure

TITLE = "The paper's figures, reproduced"
PAPER = (
    "Otis, Nguyen-Dang, Laliberté, Ouellet, Laurendeau and Gosselin: Cable Tension Control and "
    "Analysis of Reel Transparency for 6-DOF Haptic Foot Platform on a Cable-Driven Locomotion "
    "Interface (2009)."
)


def page(figures: Sequence[PaperFigure]) -> Page:
    """The page of the figures."""
    holding = sum(figure.holds for figure in figures)
    headline = Status(
        f"{holding} of {len(figures)} claims hold here.",
        good=holding == len(figures) or None,
        detail=(
            "Each figure is computed on simulated reels and benches; the paper's own machine and "
            "data are not available. A claim that does not hold is shown with the reason."
        ),
    )
    rows = [
        (
            Link(f"Fig. {figure.number}", f"figure-{figure.number}"),
            figure.claim,
            Status(figure.verdict.removesuffix(" here"), figure.holds),
        )
        for figure in figures
    ]
    summary = Table(("Figure", "The paper's claim", "Here"), rows)
    sections = tuple(map(_section, figures))
    return Page(TITLE, headline, (Paragraph(PAPER, style="soft"), summary), sections)


def _section(figure: PaperFigure) -> Section:
    verdict = f"{figure.verdict.capitalize()}."
    name = f"figure-{figure.number}"
    return Section(
        f"Fig. {figure.number}. {figure.title}",
        (
            Paragraph(figure.claim, style="quote"),
            Status(verdict, figure.holds, figure.measured),
            Drawing(figure.figure, name, figure.title),
            Paragraph(f"**Rule.** {figure.rule}", style="soft"),
            Paragraph(f"**Note.** {figure.caveat}", style="soft"),
        ),
        name,
    )
