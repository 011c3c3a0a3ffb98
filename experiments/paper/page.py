"""The page: every figure with its claim, in one file that needs nothing beside it."""

import base64
import re
from collections.abc import Sequence
from html import escape
from importlib.metadata import version

import matplotlib as mpl

from estune.figures import to_svg
from experiments.paper import PaperFigure

TITLE = "The paper's figures, made again"
PAPER = (
    "Otis, Nguyen-Dang, Laliberté, Ouellet, Laurendeau and Gosselin: Cable Tension Control and "
    "Analysis of Reel Transparency for 6-DOF Haptic Foot Platform on a Cable-Driven Locomotion "
    "Interface (2009)"
)
STYLE = """
:root { color-scheme: light dark; --ink: #1c1c1c; --soft: #5c5c5c; --rule: #dcdcdc;
  --ground: #ffffff; --yes: #00664a; --no: #a33f00; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e6e6; --soft: #a6a6a6; --rule: #3a3a3a;
  --ground: #141414; --yes: #4fc79f; --no: #f29a5c; }
  /* Drawings are made for white paper: turned over, with their hues kept. */
  figure img { filter: invert(0.92) hue-rotate(180deg); } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2.5rem 1.25rem 4rem; max-width: 46rem; background: var(--ground);
  color: var(--ink); font: 1rem/1.55 system-ui, "Segoe UI", "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .5rem; }
h2 { font-size: 1.15rem; line-height: 1.35; margin: 0 0 .6rem; }
p { margin: .5rem 0; }
a { color: inherit; }
.soft { color: var(--soft); font-size: .9rem; }
table { width: 100%; border-collapse: collapse; margin: 1.5rem 0 0; font-size: .93rem; }
th, td { text-align: left; vertical-align: top; padding: .4rem .9rem .4rem 0;
  border-bottom: 1px solid var(--rule); }
th { color: var(--soft); font-weight: 500; }
td:first-child, td:last-child { white-space: nowrap; }
td:last-child, th:last-child { padding-right: 0; }
section { margin-top: 3rem; padding-top: 1.5rem; border-top: 1px solid var(--rule); }
blockquote { margin: .5rem 0; padding-left: .9rem; border-left: 3px solid var(--rule); }
figure { margin: 1.1rem 0; }
figure img { display: block; width: 100%; height: auto; }
.yes, .no { font-weight: 600; }
.yes { color: var(--yes); }
.no { color: var(--no); }
@media print { body { max-width: none; padding: 0; font-size: 10.5pt; }
  section { break-inside: avoid; margin-top: 1.5rem; } }
"""


def page(made: Sequence[PaperFigure]) -> str:
    """The whole page as HTML."""
    held = sum(figure.holds for figure in made)
    failing = (
        "" if held == len(made) else ", and those that do not are shown as such, with the reason"
    )
    rows = "".join(_row(figure) for figure in made)
    sections = "".join(_section(figure) for figure in made)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(TITLE)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<header>\n"
        f"<h1>{escape(TITLE)}</h1>\n"
        f"<p>Each figure is computed anew on simulated reels and benches; the paper's own machine "
        f"and data are not at hand. {held} of its {len(made)} claims hold here{failing}.</p>\n"
        f'<p class="soft">{escape(PAPER)}. Computed by estune {escape(version("estune"))}.</p>\n'
        f"<table>\n<tr><th>Figure</th><th>What the paper claims</th><th>Here</th></tr>\n{rows}"
        f"</table>\n</header>\n<main>\n{sections}</main>\n</body>\n</html>\n"
    )


def _row(made: PaperFigure) -> str:
    return (
        f'<tr><td><a href="#figure-{made.number}">Fig. {made.number}</a></td>'
        f"<td>{_text(made.claim)}</td><td>{_verdict(made, 'holds', 'does not hold')}</td></tr>\n"
    )


def _section(made: PaperFigure) -> str:
    return (
        f'<section id="figure-{made.number}">\n'
        f"<h2>Fig. {made.number}. {escape(made.title)}</h2>\n"
        f"<blockquote>{_text(made.claim)}</blockquote>\n"
        f"<p>{_verdict(made, 'Holds here.', 'Does not hold here.')} {_text(made.measured)}</p>\n"
        f'<figure><img src="{_drawing(made)}" alt="{escape(made.title)}"></figure>\n'
        f'<p class="soft"><b>Rule.</b> {_text(made.rule)}</p>\n'
        f'<p class="soft"><b>Note.</b> {_text(made.caveat)}</p>\n</section>\n'
    )


def _verdict(made: PaperFigure, yes: str, no: str) -> str:
    return f'<span class="{"yes" if made.holds else "no"}">{yes if made.holds else no}</span>'


def _text(plain: str) -> str:
    """Escaped, with true minus signs, and numbers on one line with their errors and units."""
    signed = re.sub(r"(?<!\S)-(?=[\d ])", "&minus;", escape(plain))
    return re.sub(r"(?<=\d) (?=[A-Za-z%±])|(?<=±) ", "&nbsp;", signed)


def _drawing(made: PaperFigure) -> str:
    """The drawing as an address of its own: its element ids cannot meet those of another."""
    # A fixed salt, so that the same figure gives the same page.
    with mpl.rc_context({"svg.hashsalt": f"figure-{made.number}"}):
        drawn = to_svg(made.figure)
    return f"data:image/svg+xml;base64,{base64.b64encode(drawn.encode()).decode()}"
