"""Share of a residual that depends on a variable, less the share expected from noise.

The share is the partial eta squared: of the residual's variance, what a mean for each bin of the
variable explains when the base-model parameters are free too. (Friction that the base fit absorbed
in its viscous coefficient is thus counted in full.)
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.residual.angle_periods import ResidualOverAngle, per_turn

SIMPLER: Mapping[str, tuple[str, ...]] = {
    "velocity sign and tension": ("velocity sign", "tension"),
    "velocity": ("velocity sign",),
    "angle": ("tension",),
    "position period": ("tension", "angle"),
    "time": ("tension", "velocity sign"),
}


@dataclass(frozen=True, slots=True, eq=False)
class ResidualDependence:
    """Dependence of a block's residual on one variable.

    Attributes:
        name: The variable: time, velocity sign, velocity, tension, velocity sign and tension,
            angle, position period, length, command rate.
        share: Share of the residual's variance explained by the variable (eta squared, less that
            expected from noise), 0 to 1.
        mean: Mean residual there, shape (bins,), in the block's unit.
        detail: The period in the position, if any.
    """

    name: str
    unit: str
    share: float
    at: FloatArray
    mean: FloatArray
    detail: str = ""


class Variable(NamedTuple):
    """A variable that a residual may follow.

    Attributes:
        of: Its values over all records, shape (samples,); nan where not known.
        label: Bin of each sample, below zero where not known; None: those of its quantiles.
    """

    name: str
    unit: str
    of: FloatArray
    label: NDArray[np.int64] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A fitted residual whose dependence on variables is computed.

    Attributes:
        residual: At the chosen samples, shape (chosen,).
        noise: Residual of noise alone, same shape.
        basis: Orthonormal basis of the base-model parameters, shape (chosen, parameters).
        spread: Smooths columns over all samples, shape (samples, columns), as the block's terms
            were smoothed.
        independent: Number of independent samples in the residual.
    """

    residual: FloatArray
    noise: FloatArray
    basis: FloatArray
    chosen: NDArray[np.int64]
    spread: Callable[[FloatArray], FloatArray]
    independent: float

    def explained(self, by: FloatArray, freedom: float) -> tuple[float, FloatArray]:
        """Share of the residual that columns explain beside the base-model parameters.

        Args:
            by: Shape (chosen, columns).
            freedom: Their degrees of freedom.

        Returns:
            Partial eta squared less that expected by chance (epsilon squared, Kelley 1935), and
            the columns' coefficients.
        """
        beside = by - self.basis @ (self.basis.T @ by)
        inverse = np.linalg.pinv(beside.T @ beside, rcond=1e-9, hermitian=True)
        both = np.array([self.residual, self.noise])
        pull = both @ beside
        share, of_noise = np.sum(pull @ inverse * pull, axis=1) / np.maximum(
            np.sum(both**2, axis=1), 1e-300
        )
        chance = min(max(of_noise, freedom / max(self.independent - 1.0, 1.0)), 1.0 - 1e-9)
        return max(0.0, float((share - chance) / (1.0 - chance))), inverse @ pull[0]

    def binned(self, variable: Variable, bins: int = 8) -> ResidualDependence:
        """Share explained by a mean for each bin of a variable."""
        name, unit, of, label = variable
        label = quantiles(of, bins) if label is None else label
        known = label >= 0
        _, within, count = np.unique(label[known], return_inverse=True, return_counts=True)
        member = np.zeros((label.size, count.size))
        member[np.flatnonzero(known), within] = 1.0
        share, mean = self.explained(self.spread(member)[self.chosen], count.size - 1.0)
        at = np.bincount(within, of[known]) / count
        return ResidualDependence(name, unit, share, at, mean - float(mean @ count) / count.sum())

    def along(self, variable: Variable) -> ResidualDependence:
        """Share explained by a straight line."""
        x = variable.of[self.chosen]
        share, _ = self.explained((x - x.mean())[:, None], 1.0)
        return replace(self.binned(variable), share=share)

    def periodic(self, angle: Variable) -> ResidualDependence:
        """Share explained by the best sine of the angle, as of ripple or an eccentric drum."""
        from_start = angle.of - np.nanmin(angle.of)
        span = max(float(np.nanmax(from_start)), 1e-300)
        turning = ResidualOverAngle(from_start[self.chosen], self.residual)
        # A period must fit twice into the angles seen; of 512 cells a quarter are told apart.
        cells = 512
        orders = per_turn([turning], span / cells, 2.0)
        period = 2.0 * math.pi / orders[0] if orders else span
        phase = np.nan_to_num(2.0 * np.pi * from_start / period)
        wave = self.spread(np.column_stack([np.cos(phase), np.sin(phase)]))
        # Mean of the maximum of so many exponential draws, two degrees of freedom each.
        share, _ = self.explained(wave[self.chosen], 2.0 * (math.log(0.25 * cells) + 0.577))
        sine = self.binned(Variable("position period", angle.unit, from_start % period), 16)
        return replace(sine, share=share, detail=f"{period:.3g} {angle.unit}")

    def by_length(self, length: Variable, slope: FloatArray) -> ResidualDependence:
        """Share explained when every length has an offset and a slope of its own."""
        lengths, label = np.unique(length.of[self.chosen], return_inverse=True)
        member = (label[:, None] == np.arange(lengths.size)).astype(np.float64)
        own_slope = member * slope[self.chosen][:, None]
        share, _ = self.explained(np.hstack([member, own_slope]), 2.0 * lengths.size - 2.0)
        mean = np.bincount(label, self.residual) / np.bincount(label)
        return ResidualDependence(length.name, length.unit, share, lengths, mean)


def views(
    fitted: Fit, variables: Sequence[Variable], slope: FloatArray
) -> list[ResidualDependence]:
    """All views of a residual, the strongest first."""
    listed = []
    for variable in variables:
        if variable.name == "command rate":
            listed.append(fitted.along(variable))
        elif variable.name == "length":
            listed.append(fitted.by_length(variable, slope))
        else:
            listed.append(fitted.binned(variable))
        if variable.name == "angle":
            listed.append(fitted.periodic(variable))
    return sorted(listed, key=lambda view: -view.share)


def strongest(listed: Sequence[ResidualDependence]) -> ResidualDependence:
    """The view to report: the best, or a simpler one nested in it that is nearly as good."""
    best = max(listed, key=lambda view: view.share)
    by_name = {view.name: view for view in listed}
    nearly = [
        by_name[name]
        for name in SIMPLER.get(best.name, ())
        if name in by_name and by_name[name].share >= (1.0 - CONSTANTS.small) * best.share
    ]
    return max(nearly, key=lambda view: view.share, default=best)


def independent_share(residual: FloatArray) -> float:
    """Independent samples in a series, as a share of them: 1 / sum of rho^2 (Bartlett 1946)."""
    from scipy.signal import correlate  # noqa: PLC0415  slow to import

    n = residual.size
    x = residual - residual.mean()
    covariance = correlate(x, x, method="fft")[n - 1 :][: n // 2]
    if not covariance[0] > 0.0:
        return 1.0
    rho = covariance / covariance[0]
    # Sums of chance correlations would grow with the length of the record: stop at the noise.
    below = np.flatnonzero(np.abs(rho) < 2.0 / math.sqrt(n))
    reach = int(below[0]) if below.size else rho.size
    return float(1.0 / (1.0 + 2.0 * (rho[1:reach] ** 2).sum()))


def quantiles(of: FloatArray, bins: int) -> NDArray[np.int64]:
    """Index of each value's quantile bin; -1 where it is not known."""
    known = np.isfinite(of)
    edges = np.unique(np.quantile(of[known], np.linspace(0.0, 1.0, bins + 1)[1:-1]))
    return np.where(known, np.searchsorted(edges, of, side="right"), -1).astype(np.int64)
