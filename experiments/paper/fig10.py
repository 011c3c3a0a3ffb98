"""Fig. 10: how does the bandwidth of a reel with 0.5 m of cable depend on the tension?"""

from experiments.identification import TENSIONS_N
from experiments.paper import PaperFigure, show
from experiments.paper.bandwidth import of_tension


def make(*, quick: bool = False) -> PaperFigure:  # noqa: ARG001  one record each is quick enough
    """The figure."""
    return of_tension(10, 0.5, TENSIONS_N)


if __name__ == "__main__":
    show(make())
