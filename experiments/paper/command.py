"""`estune reproduce-paper`: the paper's figures, reproduced on one page with a verdict on each."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.text import Text

from estune.cli import output
from estune.cli.values import Flag, check_folder_exists
from estune.run.loop import Stopped
from estune.support.html_page import (
    Drawing,
    Link,
    Page,
    Paragraph,
    Section,
    Status,
    Table,
    write,
)
from experiments import paper
from experiments.paper import PaperFigure

TITLE = "The paper's figures, reproduced"
PAPER = (
    "Otis, Nguyen-Dang, Laliberté, Ouellet, Laurendeau and Gosselin: Cable Tension Control and "
    "Analysis of Reel Transparency for 6-DOF Haptic Foot Platform on a Cable-Driven Locomotion "
    "Interface (2009)."
)


def reproduce_paper(*, out: Path = Path("paper.html"), quick: Flag = False) -> None:
    """Reproduce the figures of the paper and check its claims.

    Args:
        out: The page to write; it works offline.
        quick: Fewer repetitions, for a quick check.

    Raises:
        InvalidInput: the page cannot be written there.
    """
    check_folder_exists("--out", out)
    figures = []
    console = output.console()
    for number in paper.NUMBERS:
        with console.status(f"Fig. {number}"), _no_rig_to_report():
            figure = paper.make(number, quick=quick)
        figures.append(figure)
        style = "green" if figure.holds else "yellow"
        line = Text.assemble(f"Fig. {number:<3}", (f"{figure.verdict}  ", style), figure.measured)
        console.print(line, soft_wrap=True)
    write(page(figures), out)
    output.show_next({"page": out})


@contextmanager
def _no_rig_to_report() -> Iterator[None]:
    """Only simulated reels are tuned here, whose live gains a stop needs not report."""
    try:
        yield
    except Stopped:
        raise KeyboardInterrupt from None


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
