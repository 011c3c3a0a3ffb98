"""Style of figures: colours, axes and legends, without pyplot.

Without pyplot a service can draw figures, too; a notebook displays them by their `_repr_png_`.
Colours are of the Okabe-Ito set, distinguishable for colour-blind readers; orange is darker than
theirs, so that every line has a contrast of 3:1 to white. Markers and dashes distinguish curves in
grey.
"""

from contextlib import AbstractContextManager
from io import BytesIO

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

BLACK, GREY, LIGHT = "#222222", "#7a7a7a", "#d9d9d9"
BLUE, VERMILION, GREEN, ORANGE, PURPLE = "#0072b2", "#d55e00", "#009e73", "#b87d00", "#cc79a7"

WIDTH_in = 7.2

_DECADE = 10.0


class ShownFigure(Figure):
    """A figure that a notebook displays without pyplot."""

    def _repr_png_(self) -> bytes:
        return to_png(self)


class ShownAxes(Axes):
    """Axes that a notebook displays as their whole figure."""

    def _repr_png_(self) -> bytes:
        return to_png(figure_of(self))


def figure_of(ax: Axes) -> Figure:
    """The whole figure that axes are part of."""
    return ax.get_figure(root=True) or ShownFigure()


def new_axes() -> Axes:
    """Axes on a figure of their own."""
    axes: Axes = new_figure(6.4, 3.2).add_subplot(axes_class=ShownAxes)
    return axes


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure with constrained layout."""
    figure = ShownFigure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def simplified() -> AbstractContextManager[None]:
    """Block in which lines are drawn to the pixel: 5 times as fast with 100 000 points."""
    return rc_context({"path.simplify_threshold": 1.0, "agg.path.chunksize": 5000})


def to_png(figure: Figure) -> bytes:
    """The figure as PNG."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=160.0)
    return buffer.getvalue()


def to_svg(figure: Figure) -> str:
    """The figure as an SVG element for a page; its ground becomes transparent."""
    figure.set_facecolor("none")
    for axes in figure.axes:
        axes.set_facecolor("none")
    buffer, canvas, dpi = BytesIO(), figure.canvas, figure.dpi
    try:
        # savefig would draw it twice: a page of ten figures then takes 5.5 s in place of 4.
        # Without a date the same run gives the same page.
        canvas_svg = FigureCanvasSVG(figure)
        canvas_svg.print_svg(buffer, metadata={"Date": None})  # type: ignore[no-untyped-call]
    finally:
        figure.set_canvas(canvas)
        figure.set_dpi(dpi)
    text = buffer.getvalue().decode()
    return text[text.index("<svg") :]


def stacked(rows: int, height_in: float) -> tuple[Figure, list[Axes]]:
    """A figure with stacked axes that share their abscissa."""
    figure = new_figure(WIDTH_in, height_in)
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)
    return figure, list(axes[:, 0])


def finish(ax: Axes, ordinate: str, abscissa: str = "") -> None:
    """Labels, a light grid, no frame at top and right, and readable decades."""
    ax.set_ylabel(ordinate, fontsize=9)
    if abscissa:
        ax.set_xlabel(abscissa, fontsize=9)
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=8)
    ax.grid(visible=True, color="#e6e6e6", linewidth=0.6)
    ax.set_axisbelow(True)
    if ax.get_yscale() == "log":
        low, high = ax.get_ylim()
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        # Decades alone would label one tick or none on less than two decades.
        subs = (1.0, 2.0, 5.0) if high / low < _DECADE**2 else (1.0,)
        ax.yaxis.set_major_locator(LogLocator(subs=subs))
        ax.yaxis.set_minor_formatter(NullFormatter())


def legend(ax: Axes, columns: int = 4, left: float = 0.0) -> None:
    """A legend above the axes, from a share of their width on."""
    ax.legend(
        loc="lower left", bbox_to_anchor=(left, 1.0), ncols=columns, fontsize=8, frameon=False,
        handlelength=2.4, columnspacing=1.4, borderaxespad=0.2,
    )  # fmt: skip
