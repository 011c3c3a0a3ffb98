"""What a diagnosis can do to be looked at: figures, a page, text, JSON."""

import html
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from plants.diagnosis.report import summary

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from plants.diagnosis.report.diagnosis import Diagnosis


class DiagnosisDisplay:
    """Gives a diagnosis its figures and its representations; pyplot is not touched."""

    __slots__ = ()

    @property
    def _d(self) -> "Diagnosis":
        return cast("Diagnosis", self)

    def heading(self) -> str:
        """The verdict in one line, and what became of the gap."""
        return summary.heading(self._d)

    def to_json(self) -> dict[str, Any]:
        """Verdict, effects, gaps and evidence as JSON values."""
        return summary.to_json(self._d)

    def save(self, path: str | Path, plant: str = "") -> None:
        """Writes the augmented model as a TOML file; see `plants.load_model`.

        Args:
            path: The file; one that is there is replaced.
            plant: What a Python plant is found by, module:attribute.

        Raises:
            InvalidInput: the model cannot be written as text, or the file cannot be written.
        """
        from plants.models.model_file import save_model  # noqa: PLC0415  of no use to most who look

        save_model(self._d.augmented, path, self.heading(), plant)

    def report(self, path: str | Path) -> Path:
        """Writes everything as one page that needs no other file and no network.

        Raises:
            InvalidInput: the page cannot be written there.
        """
        from plants.diagnosis.report.report import write  # noqa: PLC0415  slow to import

        return write(self._d, Path(path))

    def plot_gap(self, ax: "Axes | None" = None) -> "Axes":
        """Draws the gap above its floor after each step, on `ax` or a figure of its own."""
        from plants.diagnosis.report import figures  # noqa: PLC0415  slow to import

        return figures.draw_gap(_axes(ax), self._d)

    def plot_traces(self, record: str | None = None, ax: "Axes | None" = None) -> "Axes":
        """Draws a record in free run, before and after, where the base model is worst.

        Args:
            record: Name of a record of the report split; the most telling one by default.
            ax: Where to draw; on a figure of its own by default.

        Raises:
            InvalidInput: there is no such record in the report split.
        """
        from plants.diagnosis.report import figures  # noqa: PLC0415  slow to import

        return figures.draw_trace(_axes(ax), figures.trace_of(self._d, record))

    def plot_error(self, record: str | None = None, ax: "Axes | None" = None) -> "Axes":
        """Draws what the free run is wrong by over a whole record; see `plot_traces`."""
        from plants.diagnosis.report import figures  # noqa: PLC0415  slow to import

        return figures.draw_error(_axes(ax), figures.trace_of(self._d, record))

    def plot_spectrum(self, ax: "Axes | None" = None) -> "Axes":
        """Draws the free run's error over frequency, before and after."""
        from plants.diagnosis.report import figures  # noqa: PLC0415  slow to import

        return figures.draw_spectrum(_axes(ax), self._d)

    def plot_where(self, ax: "Axes | None" = None) -> "Axes":
        """Draws what share of each block's residual goes with time, speed, tension and so on."""
        from plants.diagnosis.report import figures  # noqa: PLC0415  slow to import

        return figures.draw_shares(_axes(ax), self._d)

    def plot_ranking(self, ax: "Axes | None" = None) -> "Axes":
        """Draws what each effect that was fitted leaves of the gap."""
        from plants.diagnosis.report import figures  # noqa: PLC0415  slow to import

        return figures.draw_ranking(_axes(ax), self._d)

    def plot_calibrations(self, ax: "Axes | None" = None) -> "Axes":
        """Draws how the base model's numbers shifted."""
        from plants.diagnosis.report import figures  # noqa: PLC0415  slow to import

        return figures.draw_calibrations(_axes(ax), self._d)

    def plot_splits(self, ax: "Axes | None" = None) -> "Axes":
        """Draws what each stretch of the records was used for."""
        from plants.diagnosis.report import figures  # noqa: PLC0415  slow to import

        return figures.draw_splits(_axes(ax), self._d)

    def figure(self) -> "Figure":
        """Before and after, the gap step by step, and where it lives, on one page."""
        from plants.diagnosis.report import figures  # noqa: PLC0415  slow to import

        return figures.overview(self._d)

    def __repr__(self) -> str:
        table = summary.gaps(self._d)
        rows = [table.columns, *table.rows]
        widths = [max(len(row[n]) for row in rows) for n in range(len(table.columns))]
        lines = [
            "  ".join(
                [f"  {row[0]:<{widths[0]}}"]
                + [f"{cell:>{width}}" for cell, width in zip(row[1:], widths[1:], strict=True)]
            ).rstrip()
            for row in rows
        ]
        return "\n".join([self.heading(), *lines, *summary.sentences(self._d)])

    def _repr_html_(self) -> str:
        from estune.support import plot_style  # noqa: PLC0415  slow to import
        from plants.diagnosis.report.report import table_html  # noqa: PLC0415  slow to import

        d = self._d
        colour = plot_style.GREEN if d.verdict in {"named", "none"} else plot_style.VERMILION
        told = "".join(f"<p>{html.escape(text)}</p>" for text in summary.sentences(d))
        tables = table_html(summary.gaps(d))
        if d.effects:
            tables += table_html(summary.parameters(d))
        return (
            f'<div><p style="border-left:4px solid {colour};padding-left:8px">'
            f"<b>{html.escape(self.heading())}</b></p>{told}{tables}"
            f"{plot_style.to_svg(self.figure())}</div>"
        )


def _axes(ax: "Axes | None") -> "Axes":
    from estune.support.plot_style import new_axes  # noqa: PLC0415  slow to import

    return ax or new_axes()
