"""A figure as an image of a page: light and dark in one, and narrower for small screens."""

import re

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from estune.support.plot_style import legend, to_svg

DARK_GROUND = "#141414"
"""Background of pages in their dark form."""
NARROW_in = 4.2
"""Width of figures on small screens."""
ORDINATE_in = 0.7
"""Width that an ordinate takes with its labels."""
BRIGHTER = 1.25
"""Power of the contrast: a thin line looks paler on a dark ground. 3.1 becomes 4.1, 1.25 1.3."""

_COLOUR = re.compile(r"(fill|stroke|stop-color): ?(#[0-9a-f]{6})")
_DIGITS = re.compile(r"((?:^|[ \"])-?\d+\.\d\d)\d{2,}(?=[ \"\n])", re.MULTILINE)
"""Coordinates with more digits than a hundredth of a point, which make up half of a drawing."""
_BLACK = "#000000"
_INVERTED = "image { filter: invert(0.92) hue-rotate(180deg) }"
"""For parts of a figure that are drawn as pixels."""


def light_and_dark(figure: Figure) -> str:
    """The figure as SVG that follows the reader's colour scheme."""
    svg = _DIGITS.sub(r"\1", to_svg(figure))
    used = sorted(set(_COLOUR.findall(svg)))
    rules = [
        f'[style*="{key}: {colour}"] {{ {key}: {dark_colour(colour)} !important }}'
        for key, colour in used
    ]
    dark = " ".join([f"svg {{ fill: {dark_colour(_BLACK)} }}", _INVERTED, *rules])
    style = f"<style>@media screen and (prefers-color-scheme: dark) {{ {dark} }}</style>"
    head = svg.index(">") + 1
    return svg[:head] + style + svg[head:]


def narrow(figure: Figure) -> Figure:
    """The figure, laid out again for a small screen with texts of the same size."""
    room = (NARROW_in - ORDINATE_in) * figure.dpi
    for ax in figure.axes:
        shown = ax.get_legend()
        columns = len(shown.get_texts()) if shown else 1
        while shown and shown.get_window_extent().width > room and columns > 1:
            columns -= 1
            legend(ax, columns)  # matplotlib does not lay out a legend again
            shown = ax.get_legend()
    figure.set_size_inches(NARROW_in, figure.get_figheight())
    return figure


def dark_colour(light: str) -> str:
    """The colour of the same hue that is as distinct on `DARK_GROUND` as this one on white.

    Contrast is (L1 + 0.05)/(L2 + 0.05) of the relative luminances, as in the W3C's Web Content
    Accessibility Guidelines.
    """
    rgb = _linear(light)
    ground = _luminance(_linear(DARK_GROUND))
    distinct = (1.05 / (_luminance(rgb) + 0.05)) ** BRIGHTER
    wanted = min(distinct * (ground + 0.05) - 0.05, 1.0)
    rgb = rgb * wanted / _luminance(rgb) if rgb.any() else np.full(3, wanted)
    if rgb.max() > 1.0:  # brighter than the hue can be: blended with white
        rgb /= rgb.max()
        rgb += (1.0 - rgb) * (wanted - _luminance(rgb)) / (1.0 - _luminance(rgb))
    coded = np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * rgb ** (1.0 / 2.4) - 0.055)
    return "#" + "".join(f"{round(255.0 * float(value)):02x}" for value in coded)


def _linear(colour: str) -> NDArray[np.float64]:
    """Linear red, green and blue of #rrggbb, by sRGB."""
    coded = np.array([int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


def _luminance(rgb: NDArray[np.float64]) -> float:
    return float(rgb @ (0.2126, 0.7152, 0.0722))
