"""What directions are compared with: a residual, and what calibrations can undo of a change."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from estune.core.quantities import FloatArray
from plants.diagnosis.search.cable_block import CableBlock

Numbers = NDArray[np.int64]
InitialGuesses = Callable[[str], Sequence[float]]
"""From `slug.parameter` to the values to begin with that the data suggest, often none."""


class ScoreContext(NamedTuple):
    """What directions are compared with.

    Attributes:
        values: The fit so far, by name.
        residual: The residuals screened, less what calibrations can undo, shape (screened,).
        basis: Orthonormal rows that span what calibrations can undo, shape (rank, screened).
        entries: Numbers of the entries screened.
        lowest_Hz: Lowest frequency that the records resolve.
        highest_Hz: Highest frequency that all of them hold.
        suggest: What the data suggest for parameters.
        block: The block looked at; None is all entries.
    """

    values: Mapping[str, float]
    residual: FloatArray
    basis: FloatArray
    entries: Numbers
    lowest_Hz: float
    highest_Hz: float
    suggest: InitialGuesses
    block: CableBlock | None = None

    @property
    def size(self) -> float:
        """Root mean square of the residuals, in floors."""
        return float(np.sqrt(np.mean(self.residual**2)))

    def shown(self, residuals: FloatArray) -> FloatArray:
        """What is looked at of residuals of the entries, shape (..., screened)."""
        return residuals if self.block is None else self.block.left(residuals)

    def projected_products(self, changes: FloatArray) -> "NormalEquations":
        """The products of changes that tell what they explain.

        Args:
            changes: Changes of the residuals, shape (changes, screened).
        """
        undone = changes @ self.basis.T
        return NormalEquations(
            changes @ changes.T - undone @ undone.T,
            -(changes @ self.residual),
            float(self.residual @ self.residual),
            self.residual.size,
        )


class NormalEquations(NamedTuple):
    """Changes of the residuals, less what calibrations can undo, by their products.

    Attributes:
        normal: With each other, shape (changes, changes).
        pull: With the residual, turned round: above zero where the change takes off from it.
        power: The residual's with itself.
        entries: Number of entries.
    """

    normal: FloatArray
    pull: FloatArray
    power: float
    entries: int

    @property
    def rms(self) -> FloatArray:
        """Root mean square of each change, in floors."""
        found: FloatArray = np.sqrt(np.maximum(np.diag(self.normal), 0.0) / self.entries)
        return found

    def of(self, some: slice) -> "NormalEquations":
        """Those of some of the changes."""
        return self._replace(normal=self.normal[some, some], pull=self.pull[some])

    def explained(self, *, only_up: bool) -> tuple[float, FloatArray]:
        """Share of the residual that the changes explain when scaled, and their weights.

        Args:
            only_up: Whether weights must not be negative.
        """
        size = np.sqrt(np.maximum(np.diag(self.normal), 1e-300))
        value, directions = np.linalg.eigh(self.normal / size / size[:, None])
        large = value > 1e-9
        root = (np.sqrt(value[large]) * directions[:, large]).T  # root^T root is the scaled normal
        goal = (directions[:, large] / np.sqrt(value[large])).T @ (self.pull / size)
        scaled = nnls(root, goal)[0] if only_up else np.linalg.lstsq(root, goal, rcond=None)[0]
        weights: FloatArray = scaled / size
        curve, gained = float(weights @ self.normal @ weights), float(weights @ self.pull)
        return (gained**2 / (curve * self.power) if curve * self.power > 0.0 else 0.0), weights


def orthonormal(rows: FloatArray) -> FloatArray:
    """Orthonormal rows that span the same space, shape (rank, entries)."""
    size = np.sqrt(np.einsum("ij,ij->i", rows, rows))
    kept = size > 1e-9 * max(float(size.max(initial=0.0)), 1e-300)
    scaled = rows[kept] / size[kept, None]
    value, directions = np.linalg.eigh(scaled @ scaled.T)
    large = value > 1e-9
    basis: FloatArray = (directions[:, large] / np.sqrt(value[large])).T @ scaled
    return basis
