"""The residual that sensitivity directions are compared with, less what base parameters undo."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.search.least_squares import Coordinates, prior_weight
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter, Numbers
from plants.effects import RecordScale


class ScoreContext(NamedTuple):
    """The residual that directions are compared with.

    Attributes:
        residual: The residuals screened, less what base parameters can undo, shape (screened,).
        basis: Orthonormal rows that span what base parameters can undo, shape (rank, screened).
        lowest_Hz: Lowest frequency that the records resolve.
        highest_Hz: Highest frequency that all of them hold.
    """

    model: CandidateFit
    residual: FloatArray
    basis: FloatArray
    entries: Numbers
    lowest_Hz: float
    highest_Hz: float
    records: RecordScale

    @classmethod
    def of(cls, fitter: ModelFitter, model: CandidateFit, records: RecordScale) -> "ScoreContext":
        """The context of a fit."""
        fitted = model.fitted
        sample = fitted.predictor.index.sample[fitted.entries]
        screened = sample % max(1, sample.size // CONSTANTS.screened) == 0
        entries, residual = fitted.entries[screened], fitted.residuals[screened]
        moves = fitter.moves(fitted.predictor)
        slope = fitted.predictor.linearise(fitted.values, moves, entries, residual)[1].T
        # The prior of base parameters is a residual of its own, which no effect changes.
        scale = Coordinates.of(fitted.predictor, moves)
        weight = residual.size * prior_weight(model.J)
        known, apart = scale.equations(fitted.values, weight)
        rows = np.hstack([slope * scale.inner(fitted.values)[:, None], np.diag(known)])
        basis = _orthonormal(rows * scale.span[:, None])
        whole = np.concatenate([residual, apart])
        undone = whole - (basis @ whole) @ basis
        return cls(
            model=model,
            residual=undone[: residual.size],
            basis=basis[:, : residual.size],
            entries=entries,
            lowest_Hz=1.0 / max(m.duration_s for m in fitter.measurements),
            highest_Hz=0.45 * min(m.sampling_Hz for m in fitter.measurements),
            records=records,
        )

    @property
    def size(self) -> float:
        """Root mean square of the residuals, in times the noise floor."""
        return float(np.sqrt(np.mean(self.residual**2)))

    def products(self, changes: FloatArray) -> "NormalEquations":
        """Products of changes of the residuals, (changes, screened), that determine a fit."""
        undone = changes @ self.basis.T
        return NormalEquations(
            changes @ changes.T - undone @ undone.T,
            -(changes @ self.residual),
            float(self.residual @ self.residual),
            self.residual.size,
        )


class NormalEquations(NamedTuple):
    """Changes of the residuals, less what base parameters can undo, by their products.

    Attributes:
        normal: With each other, shape (changes, changes).
        pull: With the residual, negative: above zero where the change takes off from it.
    """

    normal: FloatArray
    pull: FloatArray
    power: float
    entries: int

    @property
    def rms(self) -> FloatArray:
        """Root mean square of each change, in times the noise floor."""
        rms: FloatArray = np.sqrt(np.maximum(np.diag(self.normal), 0.0) / self.entries)
        return rms

    def of(self, chosen: slice) -> "NormalEquations":
        """Those of some of the changes."""
        return self._replace(normal=self.normal[chosen, chosen], pull=self.pull[chosen])

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


def _orthonormal(rows: FloatArray) -> FloatArray:
    """Orthonormal rows that span the same space, shape (rank, entries)."""
    size = np.sqrt(np.einsum("ij,ij->i", rows, rows))
    kept = size > 1e-9 * max(float(size.max(initial=0.0)), 1e-300)
    scaled = rows[kept] / size[kept, None]
    value, directions = np.linalg.eigh(scaled @ scaled.T)
    large = value > 1e-9
    basis: FloatArray = (directions[:, large] / np.sqrt(value[large])).T @ scaled
    return basis
