"""`estune reproduce-paper`: the paper's figures, reproduced on one page."""

from pathlib import Path

from rich.text import Text

from estune.cli import output
from estune.cli.values import Flag, check_folder_exists
from estune.run.export import write_file
from experiments import paper
from experiments.paper import page


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
        with console.status(f"Fig. {number}"):
            figure = paper.make(number, quick=quick)
        figures.append(figure)
        style = "green" if figure.holds else "yellow"
        line = Text.assemble(f"Fig. {number:<3}", (f"{figure.verdict}  ", style), figure.measured)
        console.print(line, soft_wrap=True)
    write_file(out, page.page(figures).encode())
    output.show_next({"page": out})
