"""Least squares of a linear loop model for given poles, noise and dead time (variable projection).

The prediction error of y = q^-(d+1) B/A u + H e is

    e = (A P/C) y - sum_j b_j (1 - q^-1)^j q^-(d+1) (P/C) u - (free response, offsets)

which is linear in B, and for each record in the state it begins from and in the offsets of effort
and measurement (Golub and Pereyra, SIAM Journal on Numerical Analysis 10, 1973). Poles and noise
are searched. With white noise e is the output error y - B/A u. A pole outside the unit circle,
which feedback holds, would have that grow without end. With A* the polynomial A whose poles
outside are replaced by their inverses, A/A* is an all-pass: through it white noise stays white,
and

    e = (A/A*) (y - B/A u) = (A/A*) y - (B/A*) u

is the prediction error of the same model, of the innovations (Forssell and Ljung, IEEE
Transactions on Automatic Control 45, 2000). It is finite wherever the poles are, and needs no
controller.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from estune.core.filtering import lfilter
from estune.core.quantities import FloatArray
from estune.loop_model.compiled import compiled
from estune.loop_model.compiled_errors import (
    CompiledErrors,
    compiled_errors,
    delayed_errors,
    improved,
)
from estune.loop_model.error_filters import (
    delayed,
    differenced,
    filters_of,
    noise_filters,
    regressors_of,
    whiten,
    without,
)
from estune.loop_model.fit_signals import FitSignals
from estune.loop_model.noise_model import WHITE, NoiseModel
from estune.loop_model.nuisance import nuisance_of
from estune.loop_model.poles import sections_of

LONGER = 2.0
"""Least gain in chi-squared that a sample of dead time more must bring. Without it the fit takes
noise for dead time where the numerator covers it: sd of ln Ms 2.3 % instead of 1.7 % after ten
timid trials of `tests/test_loop_model.py`."""

COORDINATE_STEP = 1e-6
NOISE_STEP = 1e-4
"""Steps of numerical slopes, in coordinates of the poles and in those with a noise model."""

EVALUATIONS, NOISE_EVALUATIONS = 40, 15
"""Most evaluations of a search for poles with white noise, and with a load or a drift, where all
slopes are numerical."""


class Solution(NamedTuple):
    """Best numerator, start states and offsets at given poles, noise and dead time.

    Attributes:
        nuisance: Of each group, the orthonormal basis of start states and offsets, (samples, m).
        regressors: Of the numerator, without the nuisance, shape (residuals of all, terms).
        basis: Orthonormal basis of the regressors, shape (residuals of all, terms).
        numerator: B in powers of 1 - q^-1.
        residual: e, shape (residuals of all,).
        compiled: The same, where it was found by compiled code.
    """

    coordinates: FloatArray
    noise: NoiseModel
    dead: int
    nuisance: tuple[FloatArray, ...]
    regressors: FloatArray
    basis: FloatArray
    numerator: FloatArray
    residual: FloatArray
    compiled: CompiledErrors | None = None

    @classmethod
    def at(
        cls,
        signals: FitSignals,
        coordinates: FloatArray,
        dead: int,
        noise: NoiseModel = WHITE,
        numerator: FloatArray | None = None,
    ) -> "Solution":
        """The solution at these poles, this noise and dead time; or with a given numerator."""
        library = compiled("prediction_errors")
        if library is not None:
            asked = _asked(signals, coordinates, noise)
            found = compiled_errors(library, **asked, dead=dead, numerator=numerator)
            return cls(coordinates, noise, dead, *found[:-2], found)
        filters = filters_of(coordinates, noise, signals.settling_samples)
        nuisance, targets, rows = [], [], []
        for group in signals.groups:
            Q = nuisance_of(group, coordinates, noise, signals)
            target = whiten(group.measurement, filters.zeros, filters.poles)
            terms = delayed(regressors_of(group.effort, filters, coordinates.size), dead + 1)
            nuisance.append(Q)
            targets.append(without(target[:, group.history :], Q).ravel())
            rows.append(without(terms[..., group.history :], Q).reshape(len(terms), -1))
        y, X = np.concatenate(targets), np.concatenate(rows, axis=1).T
        size = np.maximum(np.linalg.norm(X, axis=0), 1e-300)
        basis, triangle = np.linalg.qr(X / size)  # almost collinear: not by X'X
        b = numerator
        if b is None:
            b = np.linalg.lstsq(triangle, basis.T @ y, rcond=1e-10)[0] / size
        return cls(coordinates, noise, dead, tuple(nuisance), X, basis, b, y - X @ b)

    @staticmethod
    def least(
        signals: FitSignals, coordinates: FloatArray, delays: Sequence[int], noise: NoiseModel
    ) -> tuple[float, int]:
        """The least cost at some dead times, and the dead time that has it."""
        library, n = compiled("prediction_errors"), signals.samples
        if library is None:
            found = (Solution.at(signals, coordinates, dead, noise).cost for dead in delays)
            return min(zip(found, delays, strict=True))
        squares = delayed_errors(library, **_asked(signals, coordinates, noise), delays=delays)
        return min((_cost(s, d, n), d) for s, d in zip(squares.tolist(), delays, strict=True))

    @staticmethod
    def improved(
        signals: FitSignals,
        coordinates: FloatArray,
        dead: int,
        tolerances: tuple[float, float, float],
    ) -> tuple[float, FloatArray] | None:
        """The least cost and its poles by compiled code, with white noise; None without any."""
        library = compiled("prediction_errors")
        if library is None:
            return None
        groups = [group[:3] for group in signals.groups]
        x, squares = improved(
            *(library, groups, signals.hum, coordinates),
            dead=dead,
            tolerances=tolerances,
            most=EVALUATIONS,
        )
        return _cost(squares, dead, signals.samples), x

    @property
    def squares(self) -> float:
        """Sum of squared residuals."""
        return float(self.residual @ self.residual)

    @property
    def cost(self) -> float:
        """Half the sum of squared residuals, with the price of dead time."""
        return _cost(self.squares, self.dead, self.residual.size)

    @property
    def searched(self) -> FloatArray:
        """What a search moves: coordinates, and the logarithms of what the noise has."""
        return np.array([*self.coordinates, *self.noise.logarithms])

    def split(self, x: FloatArray) -> tuple[FloatArray, NoiseModel]:
        """Coordinates and noise of a vector as `searched`."""
        n = self.coordinates.size
        return x[:n], self.noise.with_logarithms(x[n:])

    def search_slopes(self, signals: FitSignals) -> FloatArray:
        """Slopes of the residual along coordinates and logarithms of the noise.

        Shape (residuals of all, coordinates and noises). The numerator is held. For white noise
        the slopes along a tap a_i of a section are q^-i/A of the fitted output.
        """
        if self.noise.is_white:
            found = self.compiled
            return self._output_slopes(signals) if found is None else found.slopes()
        return self._numerical_slopes(signals)

    def _output_slopes(self, signals: FitSignals) -> FloatArray:
        x = self.coordinates
        columns: list[list[FloatArray]] = [[] for _ in x]
        sections, changes = sections_of(x), _tap_slopes(x)
        parts = zip(signals.groups, self.nuisance, signals.split(self.residual), strict=True)
        for group, Q, left in parts:
            output = np.array(group.measurement)
            output[:, group.history :] -= left
            for i, (change, mirrored) in enumerate(changes):
                own = sections[i // 2]
                slope = lfilter(mirrored, own.mirrored, output)
                if own.grows:  # the measurement is filtered by A over A mirrored, too
                    others = [s for s in sections if s.grows and s is not own]
                    driven = whiten(
                        group.measurement, [s.mirrored for s in others], [s.taps for s in others]
                    )
                    slope += lfilter(change, own.mirrored, driven)
                    slope -= lfilter(mirrored, own.mirrored, group.measurement)
                columns[i].append(without(slope[:, group.history :], Q).ravel())
        return np.stack([np.concatenate(column) for column in columns], axis=1)

    def _numerical_slopes(self, signals: FitSignals) -> FloatArray:
        """Slopes along coordinates and the logarithms of the noise, with the numerator held."""
        start = self.searched
        moved = [self.split(start + NOISE_STEP * axis) for axis in np.eye(start.size)]
        if self.compiled is not None:
            filters = [noise_filters(*at, signals.settling_samples) for at in moved]
            return self.compiled.noise_slopes(filters, NOISE_STEP)
        left = [self._residual_at(signals, *at) - self.residual for at in moved]
        return np.stack(left, axis=1) / NOISE_STEP

    def _residual_at(
        self, signals: FitSignals, coordinates: FloatArray, noise: NoiseModel
    ) -> FloatArray:
        """Residual at other poles and noise with the numerator held, shape (residuals of all,)."""
        filters, parts = filters_of(coordinates, noise, signals.settling_samples), []
        for group in signals.groups:
            late = delayed(group.effort, self.dead + 1)
            driven = self.numerator[-1] * late
            for term in self.numerator[-2::-1]:
                driven = differenced(driven, 1.0) + term * late
            driven = lfilter(filters.effort, [1.0], driven)
            target = whiten(group.measurement, filters.zeros, filters.poles)
            left = target - whiten(driven, filters.free, ())
            Q = nuisance_of(group, coordinates, noise, signals)
            parts.append(without(left[:, group.history :], Q).ravel())
        return np.concatenate(parts)

    def slopes(self, signals: FitSignals) -> FloatArray:
        """Slopes of the residual along coordinates, numerator and noise, (residuals, all)."""
        searched, n = self.search_slopes(signals), self.coordinates.size
        return np.concatenate([searched[:, :n], -self.regressors, searched[:, n:]], axis=1)


def _asked(signals: FitSignals, coordinates: FloatArray, noise: NoiseModel) -> dict[str, Any]:
    """What compiled code is asked for the errors at some poles and noise."""
    settling = signals.settling_samples
    return {
        "groups": [group[:3] for group in signals.groups],
        "hum": signals.hum,
        "coordinates": coordinates,
        "filters": None if noise.is_white else noise_filters(coordinates, noise, settling),
    }


def _cost(squares: float, dead: int, samples: int) -> float:
    return 0.5 * squares * math.exp(LONGER * dead / samples)


def _tap_slopes(x: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Slopes along each coordinate of the taps of its section, and of those mirrored."""
    found = []
    for i, step in enumerate(COORDINATE_STEP * np.eye(x.size)):
        high, low = (sections_of(x + s * step)[i // 2] for s in (1, -1))
        change, mirrored = (high.taps - low.taps), (high.mirrored - low.mirrored)
        found.append((change / (2.0 * COORDINATE_STEP), mirrored / (2.0 * COORDINATE_STEP)))
    return found
