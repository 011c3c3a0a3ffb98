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

BINS = 8
LEVELS = 3
"""Bins of a variable, and of one that is crossed with the sign of the velocity."""
SIGN_NOISE = 3.0
"""A velocity within so many times its noise has no sign."""
CELLS = 512
"""Cells of the angle in which a residual is averaged before the search for its period."""
ORDERS = 400
"""Number of periods that are tried."""
NESTED = 0.9
"""Share of the best view's that a simpler view must explain to be named in its place."""
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
        unit: Unit of `at`.
        share: Share of the residual's variance explained by the variable (eta squared, less that
            expected from noise), 0 to 1.
        at: Values of the variable, shape (bins,).
        mean: Mean residual there, shape (bins,), in the block's unit.
        detail: The period in the position, if any.
    """

    name: str
    unit: str
    share: float
    at: FloatArray
    mean: FloatArray
    detail: str = ""


class Regime(NamedTuple):
    """Regime of a plant over all records, shape (samples,) each; None if not known.

    Attributes:
        part: Time since the start of the record, as a share of it.
        velocity: Rate of angle or output.
        velocity_noise: Its noise rms.
        tension: Tension, or the output of a plant that is no reel.
        angle: Drum angle.
        command_rate: Rate of the command.
        length: Cable length.
        slope: Regressor of a slope per cable length.
        units: Of velocity, tension, angle and command rate.
    """

    part: FloatArray
    velocity: FloatArray | None
    velocity_noise: float
    tension: FloatArray | None
    angle: FloatArray | None
    command_rate: FloatArray
    length: FloatArray | None
    slope: FloatArray
    units: Mapping[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A fitted residual whose dependence on variables is computed.

    Attributes:
        residual: At the chosen samples, shape (chosen,).
        noise: Residual of noise alone, same shape.
        basis: Orthonormal basis of the base-model parameters, shape (chosen, parameters).
        chosen: Indices of the chosen samples.
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

    def explained(self, by: FloatArray) -> tuple[float, float, FloatArray]:
        """Shares of residual and noise that columns explain beside the base-model parameters.

        Args:
            by: Shape (chosen, columns).

        Returns:
            Share of the residual (partial eta squared), that of the noise, and the columns'
            coefficients.
        """
        own = by - self.basis @ (self.basis.T @ by)
        inverse = np.linalg.pinv(own.T @ own, rcond=1e-9, hermitian=True)
        shares = []
        for r in (self.residual, self.noise):
            with_columns = own.T @ r
            power = max(float(r @ r), 1e-300)
            shares.append(float(with_columns @ inverse @ with_columns) / power)
        return shares[0], shares[1], inverse @ (own.T @ self.residual)

    def binned(self, name: str, unit: str, of: FloatArray, bins: int) -> ResidualDependence:
        """Share explained by a function of a variable, constant between its quantiles."""
        return self.by_label(name, unit, of, quantiles(of, bins))

    def by_label(
        self, name: str, unit: str, of: FloatArray, label: NDArray[np.int64]
    ) -> ResidualDependence:
        """Share explained by a mean for each label (below zero: not known), less that of noise."""
        known = label >= 0
        _, within, count = np.unique(label[known], return_inverse=True, return_counts=True)
        member = np.zeros((label.size, count.size))
        member[np.flatnonzero(known), within] = 1.0
        share, by_chance, mean = self.explained(self.spread(member)[self.chosen])
        share = self._above_chance(share, by_chance, count.size - 1.0)
        at = np.bincount(within, of[known]) / count
        return ResidualDependence(name, unit, share, at, mean - float(mean @ count) / count.sum())

    def along(self, name: str, unit: str, of: FloatArray) -> ResidualDependence:
        """Share explained by a straight line."""
        line = self.binned(name, unit, of, BINS)
        x = of[self.chosen]
        share, by_chance, _ = self.explained((x - x.mean())[:, None])
        return replace(line, share=self._above_chance(share, by_chance, 1.0))

    def periodic(self, angle: FloatArray, unit: str) -> ResidualDependence:
        """Share explained by the best sine of the angle, as of ripple or an eccentric drum."""
        span = max(float(np.nanmax(angle) - np.nanmin(angle)), 1e-300)
        from_start = angle - np.nanmin(angle)
        # A period must fit twice into the angles seen, and hold four cells.
        orders = np.linspace(2.0, CELLS / 4.0, ORDERS)
        cell = np.minimum(from_start[self.chosen] / span * CELLS, CELLS - 1).astype(np.int64)
        total = np.bincount(cell, self.residual, CELLS)
        place = (np.arange(CELLS) + 0.5) / CELLS
        power = np.abs(np.exp(2j * np.pi * orders[:, None] * place) @ total)
        period = span / float(orders[power.argmax()])
        phase = np.nan_to_num(2.0 * np.pi * from_start / period)
        wave = self.spread(np.column_stack([np.cos(phase), np.sin(phase)]))
        share, by_chance, _ = self.explained(wave[self.chosen])
        # Mean of the maximum of so many exponential draws, two degrees of freedom each.
        share = self._above_chance(share, by_chance, 2.0 * (math.log(ORDERS) + 0.577))
        sine = self.binned("position period", unit, from_start % period, 2 * BINS)
        return replace(sine, share=share, detail=f"{period:.3g} {unit}")

    def by_length(self, length: FloatArray, slope: FloatArray) -> ResidualDependence:
        """Share explained when every length has an offset and a slope of its own."""
        lengths, label = np.unique(length[self.chosen], return_inverse=True)
        member = (label[:, None] == np.arange(lengths.size)).astype(np.float64)
        own_slope = member * slope[self.chosen][:, None]
        share, by_chance, _ = self.explained(np.hstack([member, own_slope]))
        share = self._above_chance(share, by_chance, 2.0 * lengths.size - 2.0)
        mean = np.bincount(label, self.residual) / np.bincount(label)
        return ResidualDependence("length", "m", share, lengths, mean)

    def _above_chance(self, share: float, of_noise: float, freedom: float) -> float:
        """The share less that expected by chance (epsilon squared, Kelley 1935)."""
        chance = min(max(of_noise, freedom / max(self.independent - 1.0, 1.0)), 1.0 - 1e-9)
        return max(0.0, (share - chance) / (1.0 - chance))


def views(fitted: Fit, regime: Regime) -> list[ResidualDependence]:
    """All views of a residual, the strongest first."""
    found = [fitted.binned("time", "of the record", regime.part, BINS)]
    sign = None
    if regime.velocity is not None:
        unit, velocity = regime.units["velocity"], regime.velocity
        moves = np.abs(velocity) > SIGN_NOISE * regime.velocity_noise
        sign = np.where(np.isfinite(velocity), np.where(moves, np.sign(velocity), 0.0), np.nan)
        found.append(fitted.by_label("velocity sign", "", sign, _whole(sign + 1.0)))
        found.append(fitted.binned("velocity", unit, velocity, BINS))
    if regime.tension is not None:
        unit, tension = regime.units["tension"], regime.tension
        found.append(fitted.binned("tension", unit, tension, BINS))
        if sign is not None:
            crossed = (sign + 1.0) * LEVELS + quantiles(tension, LEVELS)
            crossed[~np.isfinite(tension)] = np.nan
            name = "velocity sign and tension"
            found.append(fitted.by_label(name, unit, tension, _whole(crossed)))
    if regime.angle is not None:
        unit = regime.units["angle"]
        found.append(fitted.binned("angle", unit, regime.angle, BINS))
        found.append(fitted.periodic(regime.angle, unit))
    found.append(fitted.along("command rate", regime.units["command_rate"], regime.command_rate))
    if regime.length is not None and np.unique(regime.length).size > 1:
        found.append(fitted.by_length(regime.length, regime.slope))
    return sorted(found, key=lambda view: -view.share)


def strongest(found: Sequence[ResidualDependence]) -> ResidualDependence:
    """The view to report: the best, or a simpler one nested in it that is nearly as good."""
    best = max(found, key=lambda view: view.share)
    by_name = {view.name: view for view in found}
    nearly = [
        by_name[name]
        for name in SIMPLER.get(best.name, ())
        if name in by_name and by_name[name].share >= NESTED * best.share
    ]
    return max(nearly, key=lambda view: view.share, default=best)


def independent_share(residual: FloatArray) -> float:
    """Independent samples in a series, as a share of them: 1 / sum of rho^2 (Bartlett 1946)."""
    n = residual.size
    x = residual - residual.mean()
    size = 1 << (2 * n - 1).bit_length()
    covariance = np.fft.irfft(np.abs(np.fft.rfft(x, size)) ** 2, size)[: n // 2]
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


def _whole(label: FloatArray) -> NDArray[np.int64]:
    return np.where(np.isfinite(label), label, -1.0).astype(np.int64)
