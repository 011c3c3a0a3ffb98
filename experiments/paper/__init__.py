"""The paper's figures, reproduced with the project's models, and a verdict on each claim.

`python -m experiments.paper` puts them on one page. Every number in a sentence is computed in the
same run. What the figures need and no command does, with the paper's equations and figures:

    cable             sag, stretch and slack of the cable (1)-(7), string frequency (31)
    identify          resonance, damping and dead time of a reel from broadband records, (30);
                      its friction from a velocity ramp, (10)
    initial_gains     gains by rules from the `second_order` model
    two_reels         eyelet angles (11)-(13), friction contact (14)-(20), attenuation ratio B and
                      friction coefficient (21)-(26), transparency index (27)-(29), hysteresis
    demonstrations    friction and inertia compensation (Figs. 16 and 17), the boundary of the
                      workspace (Fig. 18)
    cable_platform    tension distribution and pose control of a platform
"""

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from matplotlib.figure import Figure

_MODULES = {
    7: "attenuation",
    9: "bandwidth",
    10: "bandwidth",
    11: "bandwidth",
    12: "convergence",
    15: "hysteresis",
    16: "compensation",
    17: "compensation",
    18: "boundary",
}

NUMBERS = tuple(_MODULES)
"""The figures that are reproduced."""


@dataclass(frozen=True, eq=False)
class PaperFigure:
    """A reproduced figure with its claim.

    Attributes:
        number: Number in the paper.
        title: Caption.
        claim: The paper's claim, as a sentence.
        holds: Whether it holds here.
        measured: The numbers that decide it, in a sentence or two.
        rule: Condition under which the claim holds.
        caveat: Limits of the reproduction: origin of the numbers, and the reason where a claim
            fails.
        numbers: The numbers of `measured`, by name.
        figure: The figure.
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
        """Whether the claim holds."""
        return "holds here" if self.holds else "does not hold here"


def make(number: int, *, quick: bool = False) -> PaperFigure:
    """Reproduces one figure.

    Args:
        number: One of `NUMBERS`.
        quick: Fewer repetitions, for a quick check.
    """
    module = importlib.import_module(f"experiments.paper.{_MODULES[number]}")
    maker: Callable[..., PaperFigure] = getattr(module, f"figure_{number}")
    return maker(quick=quick)
