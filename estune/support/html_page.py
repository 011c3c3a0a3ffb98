"""Pages of one HTML file that needs nothing beside it: drawings inside, no script, no network."""

import base64
import re
from html import escape

import matplotlib as mpl
from matplotlib.figure import Figure

from estune.support.plot_style import to_svg

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
/* On a small screen drawings and tables keep their size and can be moved. */
figure, .wide { overflow-x: auto; }
@media (max-width: 40rem) { figure img { width: 38rem; max-width: none; } }
.yes, .no { font-weight: 600; }
.yes { color: var(--yes); }
.no { color: var(--no); }
@media print { body { max-width: none; padding: 0; font-size: 10.5pt; }
  section { break-inside: avoid; margin-top: 1.5rem; } }
"""


def document(title: str, header: str, main: str, style: str = "") -> str:
    """A whole page.

    Args:
        title: Its title, plain text.
        header: HTML of its head.
        main: HTML of its sections.
        style: Rules beyond the common ones.
    """
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}{style}</style>\n</head>\n<body>\n"
        f"<header>\n{header}</header>\n<main>\n{main}</main>\n</body>\n</html>\n"
    )


def words(plain: str) -> str:
    """Escaped, with true minus signs, and numbers on one line with their errors and units."""
    signed = re.sub(r"(?<!\S)-(?=[\d ])", "&minus;", escape(plain))
    return re.sub(r"(?<=\d) (?=[A-Za-z%±])|(?<=±) ", "&nbsp;", signed)


def drawn(figure: Figure, name: str, alt: str) -> str:
    """A drawing in its place, as an address of its own: its element ids cannot meet another's.

    Args:
        figure: The drawing.
        name: What sets it apart from the page's other drawings.
        alt: What it shows, in words.
    """
    # A fixed salt, so that the same figure gives the same page.
    with mpl.rc_context({"svg.hashsalt": name}):
        svg = base64.b64encode(to_svg(figure).encode()).decode()
    return f'<figure><img src="data:image/svg+xml;base64,{svg}" alt="{escape(alt)}"></figure>\n'
