"""Result of a sweep: a tidy frame, an xarray, and the laws over cable length."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from estune.core.gains import GAIN_NAMES, GAIN_UNITS
from estune.errors import InvalidInput
from estune.run.table_file import csv_table
from estune.studies.law.law import GainLaw, fit_law
from estune.studies.law.tuned import CELLS
from estune.studies.sweep.design import SweepDesign
from estune.studies.sweep.exclusions import exclusion_sentences
from estune.studies.sweep.outcome import CellOutcome
from estune.support.lazy_sequence import LazySequence
from estune.support.notebook_card import card
from estune.support.whole_file import write_file

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure

_ROWS_AT_ONCE = 2000

DIMENSIONS = ("length_m", "tension_N", "tuner", "seed", "rig")
"""Columns that identify a cell; without their units, the dimensions of the xarray."""

_UNITS = {**GAIN_UNITS, "duration_s": "s", "length": "m", "tension": "N"}


@dataclass(frozen=True, eq=False)
class Series:
    """Cells that share one law.

    Attributes:
        label: Name of the model, or `rigs`, and of the tuner.
    """

    label: str
    outcomes: LazySequence[CellOutcome]

    def law(self) -> GainLaw:
        """The law over length, of the cells that are safe and converged.

        Raises:
            InvalidInput: too few are left; the message counts the excluded ones by reason.
        """
        return self._law

    @cached_property
    def _law(self) -> GainLaw:
        with_gains = self.outcomes.where(lambda o: o.gains is not None)
        return fit_law(with_gains.map(CellOutcome.tuned), signals=self.outcomes[0].cell.signals)

    def law_or_reason(self) -> GainLaw | str:
        """The law, or why there is none and what to change."""
        try:
            return self.law()
        except InvalidInput as error:
            return "; ".join((str(error), *exclusion_sentences(self.outcomes)))

    def plot_costs(self) -> "Figure":
        """Fig. 12: the cost over the search, one line a length."""
        from estune.studies.sweep import figures  # noqa: PLC0415  slow to import

        return figures.draw_costs(self.outcomes)

    def plot_integral(self) -> "Figure":
        """Fig. 13: the integral gain over the search, one line a length."""
        from estune.studies.sweep import figures  # noqa: PLC0415  slow to import

        return figures.draw_integral(self.outcomes)

    def plot_law(self, name: str = "I") -> "Figure":
        """Fig. 14: a gain over length, the law with its bands, and its residuals.

        Raises:
            InvalidInput: there is no such gain, or no law.
        """
        from estune.studies.sweep import figures  # noqa: PLC0415  slow to import

        return figures.draw_law(self.law(), name, self.outcomes.where(attrgetter("excluded")))


@dataclass(frozen=True, eq=False)
class SweepResult:
    """The outcomes of all cells of a sweep."""

    design: SweepDesign
    outcomes: LazySequence[CellOutcome]
    folder: Path

    @cached_property
    def failed(self) -> LazySequence[CellOutcome]:
        """The cells that could not be run; a further call of the sweep tries them again."""
        return self.outcomes.where(attrgetter("failed"))

    @cached_property
    def excluded(self) -> LazySequence[CellOutcome]:
        """The cells that a law excludes: failed, unsafe or not converged."""
        return self.outcomes.where(attrgetter("excluded"))

    @cached_property
    def series(self) -> tuple[Series, ...]:
        """One for each tuner and model; all rigs at endpoints make one together."""
        groups = self.outcomes.groups(_series_of)
        return tuple(Series(", ".join(key), group) for key, group in groups.items())

    def law(self) -> GainLaw:
        """The law over length of a sweep of one series.

        Raises:
            InvalidInput: there are several series, or too few cells are left.
        """
        series = self.series
        if len(series) > 1:
            raise InvalidInput(
                f"the sweep has {len(series)} series ({'; '.join(s.label for s in series)}), each "
                "with a law of its own; take one of result.series"
            )
        return series[0].law()

    def heading(self) -> str:
        """The sweep in one line."""
        lengths = sorted({outcome.cell.length_m for outcome in self.outcomes})
        trials = sum(outcome.trials for outcome in self.outcomes)
        failed = len(self.failed)
        unused = {"failed": failed, "excluded": len(self.excluded) - failed}
        return ", ".join(
            [
                f"{len(self.outcomes)} tunings",
                f"{len(lengths)} lengths from {lengths[0]:g} to {lengths[-1]:g} m",
                f"{trials} trials",
                *(f"{count} {name}" for name, count in unused.items() if count),
            ]
        )

    def to_frame(self) -> "pd.DataFrame":
        """One row for each cell; gains in their own units, as in `estune.Gains`."""
        import pandas as pd  # noqa: PLC0415  slow to import

        return pd.DataFrame({name: list(map(of, self.outcomes)) for name, of in _COLUMNS.items()})

    def write_cells(self) -> Path:
        """Writes the frame into the folder of the sweep, without holding all of it."""
        path = self.folder / CELLS
        with csv_table(path, tuple(_COLUMNS)) as append:
            for first in range(0, len(self.outcomes), _ROWS_AT_ONCE):
                part = self.outcomes[first : first + _ROWS_AT_ONCE]
                append({name: [_text(of(o)) for o in part] for name, of in _COLUMNS.items()})
        return path

    def to_xarray(self) -> "xr.Dataset":
        """The frame by length, tension, tuner, seed and rig; nan where no cell is."""
        import xarray as xr  # noqa: PLC0415  slow to import

        short = {name: name.rpartition("_")[0] or name for name in DIMENSIONS}
        frame = self.to_frame().rename(columns=short).set_index(list(short.values()))
        dataset = xr.Dataset.from_dataframe(frame)
        for name in map(str, dataset.variables):
            if name in _UNITS:
                dataset[name].attrs["units"] = _UNITS[name]
        return dataset

    def to_parquet(self, path: str | Path) -> None:
        """Writes the frame as Parquet, whole or not at all.

        Raises:
            InvalidInput: pyarrow is not installed, or the file cannot be written.
        """
        try:
            content = self.to_frame().to_parquet(None, index=False)
        except ImportError as error:
            raise InvalidInput(
                "Parquet needs pyarrow, which is not installed: pip install 'estune[parquet]'"
            ) from error
        write_file(Path(path), content)

    def __repr__(self) -> str:
        laws = ((series.label, series.law_or_reason()) for series in self.series)
        lines = (
            f"{label}: {law.sentence if isinstance(law, GainLaw) else f'no law: {law}'}"
            for label, law in laws
        )
        return "\n".join([self.heading(), *lines])

    def _repr_html_(self) -> str:
        heading, *laws = repr(self).split("\n")
        return card(heading, good=not self.excluded, sentences=laws)


def _series_of(outcome: CellOutcome) -> tuple[str, str]:
    rig = outcome.cell.rig
    return rig.label if rig.is_model else "rigs", outcome.cell.tuner


def _gain_columns(index: int, name: str) -> dict[str, Callable[[CellOutcome], Any]]:
    """A gain, and the standard error of its logarithm."""
    return {
        name: lambda o: np.nan if o.gains is None else o.gains.as_tuple()[index],
        f"{name}_log_error": lambda o: np.nan if o.log_errors is None else o.log_errors[index],
    }


_GAINS = [_gain_columns(index, name) for index, name in enumerate(GAIN_NAMES)]
_OWN = ("cost", "cost_error", "start_cost", "safe", "converged", "remaining", "trials")


def _text(value: Any) -> Any:
    """A value as in a CSV file; nothing where there is none."""
    return "" if value is None or value != value else value  # noqa: PLR0124  nan differs from itself


_COLUMNS: dict[str, Callable[[CellOutcome], Any]] = {
    **{name: attrgetter(f"cell.{name}") for name in DIMENSIONS[:-1]},
    "rig": attrgetter("cell.rig.label"),
    "ending": lambda outcome: str(outcome.ending),
    **{name: columns[name] for name, columns in zip(GAIN_NAMES, _GAINS, strict=True)},
    **{name: of for columns in _GAINS for name, of in columns.items() if name not in GAIN_NAMES},
    **{name: attrgetter(name) for name in (*_OWN, "unsafe_trials", "duration_s", "message")},
    "key": attrgetter("cell.key"),
}
"""Columns of the frame: name, and its value of an outcome."""
