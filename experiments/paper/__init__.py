"""The paper's figures, each made again by the project's own models, beside what the paper claims.

One file per figure, which can also be run by itself: `python -m experiments.paper.fig09`.
`estune reproduce-paper` puts them all on one page. Every number in a sentence is computed by the figure's
own run.
"""

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from matplotlib.figure import Figure

NUMBERS = (7, 9, 10, 11, 12, 15, 16, 17, 18)
"""The figures that have a file here."""


@dataclass(frozen=True, eq=False)
class PaperFigure:
    """A figure of the paper made again, and what became of its claim.

    Attributes:
        number: Its number in the paper.
        title: Its caption.
        claim: What the paper says of it, in a sentence.
        holds: Whether that is so here.
        measured: The numbers that decide it, in a sentence or two.
        rule: When the claim counts as holding.
        caveat: What this can say and what it cannot: where the numbers come from, and why a claim
            fails where it does.
        numbers: The numbers of `measured`, by name.
        figure: The drawing.
    """

    number: int
    title: str
    claim: str
    holds: bool
    measured: str
    rule: str
    caveat: str
    numbers: Mapping[str, float]
    figure: Figure

    @property
    def verdict(self) -> str:
        """Whether the claim holds, in words."""
        return "holds here" if self.holds else "does not hold here"


def make(number: int, *, quick: bool = False) -> PaperFigure:
    """Makes one figure.

    Args:
        number: One of `NUMBERS`.
        quick: Fewer repetitions, for a check that all is well.
    """
    module = importlib.import_module(f"experiments.paper.fig{number:02d}")
    maker: Callable[..., PaperFigure] = module.make
    return maker(quick=quick)


def show(made: PaperFigure) -> None:
    """Prints a figure's claim and what became of it."""
    print(f"Fig. {made.number}. {made.title}")
    print(f"  the paper: {made.claim}")
    print(f"  {made.verdict}: {made.measured}")
    print(f"  rule: {made.rule}")
    print(f"  note: {made.caveat}")
