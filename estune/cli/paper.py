"""`estune paper`: the paper's figures made again, on one page."""

import importlib
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.text import Text

from estune.cli import output
from estune.errors import InvalidInput
from estune.run.export import replace_file

_Flag = Parameter(negative=(), show_default=False)


def paper(*, out: Path = Path("paper.html"), quick: Annotated[bool, _Flag] = False) -> None:
    """Make the figures of the paper again and say which of its claims hold here.

    Args:
        out: The page to write; it needs no other file and no network.
        quick: Fewer repetitions, for a check that all is well.

    Raises:
        InvalidInput: the page cannot be written there.
    """
    if not out.parent.is_dir():
        raise InvalidInput(f"there is no folder {out.parent}; make it, or give another --out")
    # By name: the experiments are built on estune, which does not know them.
    figures = importlib.import_module("experiments.paper")
    page = importlib.import_module("experiments.paper.page")
    made = []
    console = output.console()
    for number in figures.NUMBERS:
        with console.status(f"Fig. {number}"):
            figure = figures.make(number, quick=quick)
        made.append(figure)
        look = "green" if figure.holds else "yellow"
        line = Text.assemble(f"Fig. {number:<3}", (f"{figure.verdict}  ", look), figure.measured)
        console.print(line, soft_wrap=True)
    try:
        replace_file(out, page.page(made).encode())
    except OSError as error:
        raise InvalidInput(f"{out}: {error.strerror or error}; give another --out") from error
    output.show_next({"page": out})
