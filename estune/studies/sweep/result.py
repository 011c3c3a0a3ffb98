"""What a sweep came to: a tidy frame, an xarray, the laws over length, and one offline page."""

import html
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from estune.core.gains import GAIN_NAMES, GAIN_UNITS
from estune.errors import InvalidInput
from estune.run.export import replace_file
from estune.studies.law.law import GainLaw, fit_law
from estune.studies.sweep.design import SweepDesign
from estune.studies.sweep.outcome import CellOutcome

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure

DIMENSIONS = ("length_m", "tension_N", "tuner", "seed", "rig")
"""What a cell is found by in a frame; the dimensions of the xarray, without their units."""

_UNITS = {**GAIN_UNITS, "duration_s": "s", "length": "m", "tension": "N"}


class Series(NamedTuple):
    """Cells that one law is fitted to.

    Attributes:
        label: Which model, or the rigs at endpoints, and which tuner.
        outcomes: What they came to.
    """

    label: str
    outcomes: tuple[CellOutcome, ...]

    def law(self) -> GainLaw:
        """The law over length; cells that are unsafe, unconverged or failed have no part in it.

        Raises:
            InvalidInput: too few are left; the message names those left out.
        """
        return fit_law([tuned for o in self.outcomes if (tuned := o.tuned()) is not None])

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

        left_out = [outcome for outcome in self.outcomes if outcome.excluded]
        return figures.draw_law(self.law(), name, left_out)


@dataclass(frozen=True, eq=False)
class SweepResult:
    """Every cell of a sweep, and what is made of them.

    Attributes:
        design: What was asked for.
        outcomes: What each cell came to, in the order of the design.
        folder: Where it is kept.
    """

    design: SweepDesign
    outcomes: tuple[CellOutcome, ...]
    folder: Path

    @property
    def failed(self) -> tuple[CellOutcome, ...]:
        """The cells that could not be run; a further call of the sweep tries them again."""
        return tuple(outcome for outcome in self.outcomes if outcome.failed)

    @property
    def excluded(self) -> tuple[CellOutcome, ...]:
        """The cells that a law leaves out: failed, unsafe, or not at their end."""
        return tuple(outcome for outcome in self.outcomes if outcome.excluded)

    @property
    def series(self) -> tuple[Series, ...]:
        """One for each tuner and model; rigs at endpoints, each at its length, make one."""
        found: dict[tuple[str, str], list[CellOutcome]] = {}
        for outcome in self.outcomes:
            rig = outcome.cell.rig
            name = rig.label if rig.is_model else "rigs"
            found.setdefault((name, outcome.cell.tuner), []).append(outcome)
        return tuple(Series(", ".join(k), tuple(some)) for k, some in found.items())

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
        trouble = [
            f"{len(some)} {what}"
            for what, some in (
                ("failed", self.failed),
                ("left out", [o for o in self.excluded if not o.failed]),
            )
            if some
        ]
        lengths = sorted({outcome.cell.length_m for outcome in self.outcomes})
        trials = sum(len(outcome.trace) for outcome in self.outcomes)
        where = f"{len(lengths)} lengths from {lengths[0]:g} to {lengths[-1]:g} m"
        return ", ".join([f"{len(self.outcomes)} tunings at {where}, {trials} trials", *trouble])

    def to_frame(self) -> "pd.DataFrame":
        """The cells, one row each; gains have their own units, as in `estune.Gains`."""
        import pandas as pd  # noqa: PLC0415  slow to import

        return pd.DataFrame(list(map(_row, self.outcomes)))

    def to_xarray(self) -> "xr.Dataset":
        """The same by length, tension, tuner, seed and rig; what was not tuned is empty."""
        import xarray as xr  # noqa: PLC0415  slow to import

        short = {name: name.rpartition("_")[0] or name for name in DIMENSIONS}
        frame = self.to_frame().rename(columns=short).set_index(list(short.values()))
        found = xr.Dataset.from_dataframe(frame)
        for name in map(str, found.variables):
            unit = _UNITS.get(name.removesuffix("_log_error"))
            if unit is not None and not name.endswith("_log_error"):
                found[name].attrs["units"] = unit
        return found

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
        write(Path(path), content)

    def write_report(self, path: str | Path) -> None:
        """Writes everything on one page that needs no other file and no network.

        Raises:
            InvalidInput: the file cannot be written.
        """
        from estune.studies.sweep import report  # noqa: PLC0415  slow to import

        write(Path(path), report.page(self).encode())

    def __repr__(self) -> str:
        return "\n".join([self.heading(), *laws_in_words(self)])

    def _repr_html_(self) -> str:
        return "".join(f"<p>{html.escape(line)}</p>" for line in repr(self).split("\n"))


def laws_in_words(result: SweepResult) -> Iterator[str]:
    """Each series' law as a sentence, or why there is none."""
    for series in result.series:
        try:
            law = series.law()
        except InvalidInput as error:
            yield f"{series.label}: no law: {error}"
        else:
            yield f"{series.label}: {law.sentence}"


def write(path: Path, content: bytes) -> None:
    """Writes a file whole or not at all.

    Raises:
        InvalidInput: it cannot be written.
    """
    try:
        replace_file(path, content)
    except OSError as error:
        raise InvalidInput(f"{path}: {error.strerror or error}; give another file") from error


def _row(outcome: CellOutcome) -> dict[str, Any]:
    cell, gains, errors = outcome.cell, outcome.gains, outcome.log_errors
    nothing = (np.nan,) * len(GAIN_NAMES)
    told = zip(GAIN_NAMES, errors or nothing, strict=True)
    return {
        **dict(
            zip(
                DIMENSIONS,
                (cell.length_m, cell.tension_N, cell.tuner, cell.seed, cell.rig.label),
                strict=True,
            )
        ),
        "ending": str(outcome.ending),
        **dict(zip(GAIN_NAMES, nothing if gains is None else gains.as_tuple(), strict=True)),
        **{f"{name}_log_error": error for name, error in told},
        "cost": outcome.cost,
        "cost_error": outcome.cost_error,
        "start_cost": outcome.start_cost,
        "safe": outcome.safe,
        "converged": outcome.converged,
        "remaining": outcome.remaining,
        "trials": len(outcome.trace),
        "unsafe_trials": int(outcome.trace[:, -1].sum()),
        "duration_s": outcome.duration_s,
        "message": outcome.message,
        "key": cell.key,
    }
