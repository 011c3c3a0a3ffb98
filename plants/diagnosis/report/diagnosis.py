"""The answer of `explain`: a diagnosis with figures, page, text and JSON."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from estune.support.notebook_card import card
from plants.diagnosis.report import summary
from plants.diagnosis.report.json_form import to_json
from plants.diagnosis.result import DiagnosisResult

if TYPE_CHECKING:  # matplotlib is slow to import: a diagnosis can be had without it
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class Diagnosis(DiagnosisResult):
    """A diagnosis with its representations; pyplot is not touched.

    The `plot_...` methods draw on the axes `ax`, or on a figure of their own.
    """

    __slots__ = ()

    def heading(self) -> str:
        """The verdict and the prediction error in one line."""
        return summary.heading(self)

    def to_json(self) -> dict[str, Any]:
        """Verdict, effects, prediction errors and evidence as JSON values."""
        return to_json(self)

    def save(self, path: str | Path, plant: str = "") -> None:
        """Writes the augmented model as a TOML file; see `plants.load_model`.

        Args:
            path: The file; one that is there is replaced.
            plant: What a Python plant is found by, module:attribute.

        Raises:
            InvalidInput: the model cannot be written as text, or the file cannot be written.
        """
        from plants.models.model_file import save_model  # noqa: PLC0415  slow to import

        save_model(self.augmented, path, self.heading(), plant)

    def report(self, path: str | Path) -> Path:
        """Writes everything as one page that needs no other file and no network.

        Raises:
            InvalidInput: the page cannot be written there.
        """
        from estune.support.html_page import write  # noqa: PLC0415  slow to import
        from plants.diagnosis.report.page import page  # noqa: PLC0415  as above

        write(page(self), Path(path))
        return Path(path)

    def plot_gap(self, ax: "Axes | None" = None) -> "Axes":
        """Draws the prediction error above the noise floor after each step."""
        return _drawn("gap", ax, self)

    def plot_traces(self, record: str | None = None, ax: "Axes | None" = None) -> "Axes":
        """Draws a record in free run, before and after, where the base model is worst.

        Args:
            record: Name of a record; the one with the largest error by default.
            ax: Where to draw; on a figure of its own by default.

        Raises:
            InvalidInput: there is no such record.
        """
        return _drawn("trace", ax, summary.trace_of(self, record))

    def plot_where(self, ax: "Axes | None" = None) -> "Axes":
        """Draws the share of each block's residual that follows time, speed, tension and so on."""
        return _drawn("shares", ax, self.where)

    def plot_ranking(self, ax: "Axes | None" = None) -> "Axes":
        """Draws the prediction error left by each effect that was fitted."""
        return _drawn("ranking", ax, self)

    def figure(self) -> "Figure":
        """Before and after, the error step by step, and where it is, on one page."""
        from plants.diagnosis.report import figures  # noqa: PLC0415  slow to import

        return figures.overview(self)

    def __repr__(self) -> str:
        lines = summary.gaps(self).lines()
        return "\n".join([self.heading(), *lines, *summary.sentences(self)])

    def _repr_html_(self) -> str:
        tables = [summary.gaps(self), *([summary.parameters(self)] if self.effects else [])]
        return card(
            self.heading(),
            good=self.verdict in {"named", "none"},
            tables=[(table.columns, *table.rows) for table in tables],
            sentences=summary.sentences(self),
            figure=self.figure(),
        )


def _drawn(what: str, ax: "Axes | None", subject: Any) -> "Axes":
    from estune.support.plot_style import new_axes  # noqa: PLC0415  slow to import
    from plants.diagnosis.report import figures  # noqa: PLC0415  slow to import

    drawn: Axes = getattr(figures, f"draw_{what}")(ax or new_axes(), subject)
    return drawn
