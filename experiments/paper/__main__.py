"""Which claims of the paper's figures hold on simulated reels and benches?

Command: `python -m experiments.paper`.
Target: none; a claim that does not hold is shown with the reason.

The figures go onto one page, which works offline, each with its claim and the numbers that decide
it.
"""

import sys

from estune.support.html_page import write
from experiments import paper
from experiments.paper.page import page
from experiments.results import command_line, print_results


def main() -> int:
    """Reproduces the figures; returns the exit code."""
    parser = command_line(__doc__, quick="fewer repetitions", out="the page paper.html")
    options = parser.parse_args()
    out = options.out / "paper.html"
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        parser.error(f"--out {options.out}: {error.strerror}; name another folder")
    figures = []
    for number in paper.NUMBERS:
        figures.append(paper.make(number, quick=options.quick))
        if not options.json:
            print(f"Fig. {number:<3} {figures[-1].verdict}  {figures[-1].measured}", flush=True)
    write(page(figures), out)
    values = {f"Fig. {one.number}": {"holds": one.holds, **one.numbers} for one in figures}
    return print_results(values, {}, as_json=options.json)


if __name__ == "__main__":
    sys.exit(main())
