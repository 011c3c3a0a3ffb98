"""Dependence of resonance, damping, gain and dead time on cable length and tension.

The model is interpolated between the identified conditions by a cubic spline in scattered points
(Duchon 1977; scipy's `RBFInterpolator`). The interpolated quantities are 1/w^2 and 2 zeta w, the
flexibility and the friction over the inertia, which are nearly linear in the cable length. The
second coordinate is 1/T, in which the sag's share of the flexibility is smooth.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from experiments.paper.identify.estimate import Estimate
from experiments.paper.identify.second_order import SecondOrderFit
from experiments.paper.second_order import GaugeMode, SecondOrder

RANGE_RTOL = 1e-6
"""Tolerance of the identified range, for rounding."""


class Condition(NamedTuple):
    """A fit, with the cable length and the preload at which it was made."""

    cable_length_m: float
    tension_N: float
    fit: SecondOrderFit


@dataclass(frozen=True, eq=False)
class Dependence:
    """The identified model at any length and tension between the conditions.

    A coordinate that is the same in all conditions is fixed: identified at one tension, the model
    is defined at that tension only.

    Raises:
        InvalidInput: there are too few conditions, two coincide, length and tension vary together,
            or only some fits have a gauge mode.
    """

    conditions: Sequence[Condition]  # the fits to interpolate

    def __post_init__(self) -> None:
        places = np.array([(c.cable_length_m, c.tension_N) for c in self.conditions])
        if len(places) < 3:
            raise InvalidInput(
                f"{len(places)} conditions: three or more are needed to interpolate; identify at "
                "further lengths or tensions"
            )
        if not (np.isfinite(places).all() and (places > 0.0).all()):
            raise InvalidInput("cable lengths and tensions must be finite and above zero")
        unit = _scaled(places, places)[:, self._varying]
        apart = np.linalg.norm(unit[:, None] - unit[None, :], axis=2) + np.eye(len(unit))
        if apart.min() < 1e-9:
            first, _ = np.unravel_index(apart.argmin(), apart.shape)
            raise InvalidInput(
                f"two conditions are at {places[first, 0]:g} m and {places[first, 1]:g} N; keep "
                "one of them"
            )
        spread = np.linalg.svd(unit - unit.mean(axis=0), compute_uv=False)
        if spread[-1] < 1e-3 * spread[0]:
            raise InvalidInput(
                "length and tension vary together in all conditions, so their effects cannot be "
                "separated; vary one while the other is constant"
            )
        if len({c.fit.model.gauge is None for c in self.conditions}) > 1:
            raise InvalidInput(
                "some fits have a gauge mode and some have none; fit all in the same way"
            )

    @property
    def _varying(self) -> NDArray[np.bool_]:
        places = np.array([(c.cable_length_m, c.tension_N) for c in self.conditions])
        return np.asarray(np.ptp(places, axis=0) > RANGE_RTOL * places.max(axis=0))

    def at(self, cable_length_m: float, tension_N: float) -> SecondOrder:
        """The model at a length and a tension.

        Raises:
            InvalidInput: the place lies outside the conditions.
        """
        w, zeta, gain, dead_time, *gauge = self._values(cable_length_m, tension_N)[0]
        mode = GaugeMode(gauge[0], gauge[1]) if gauge else None
        return SecondOrder(gain, w, zeta, max(0.0, dead_time), mode)

    def estimates(self, cable_length_m: float, tension_N: float) -> dict[str, Estimate]:
        """`natural_frequency_Hz`, `damping`, `gain` and `dead_time_s` there.

        The intervals propagate those of the fits, without the error of the interpolation.

        Raises:
            InvalidInput: the place lies outside the conditions.
        """
        values, covariance = self._values(cable_length_m, tension_N)
        quantile = self.conditions[0].fit.quantile
        errors = np.sqrt(np.diag(covariance))
        names = {
            "natural_frequency_Hz": (0, 1.0 / (2.0 * math.pi), "Hz"),
            "damping": (1, 1.0, ""),
            "gain": (2, 1.0, "N/unit"),
            "dead_time_s": (3, 1.0, "s"),
        }
        return {
            name: Estimate.normal(float(values[n] * f), float(errors[n] * f), quantile, unit)
            for name, (n, f, unit) in names.items()
        }

    def _values(self, cable_length_m: float, tension_N: float) -> tuple[FloatArray, FloatArray]:
        """(w, zeta, gain, dead time, ...) at a length and tension, and their covariance."""
        weights = self._weights(cable_length_m, tension_N)
        rows, covariances = self._linearised
        t = weights @ rows
        covariance = np.einsum("i,ijk->jk", weights**2, covariances)
        if not (t[0] > 0.0 and 0.0 < t[1] * math.sqrt(t[0]) < 2.0):
            raise InvalidInput(
                f"the interpolation fails at {cable_length_m:g} m, {tension_N:g} N: the "
                "conditions are too far apart; identify nearer to it"
            )
        w = 1.0 / math.sqrt(t[0])
        values = np.concatenate([[w, t[1] / (2.0 * w)], t[2:]])
        back = np.eye(t.size)
        back[0, 0] = -0.5 * w**3
        back[1, :2] = t[1] / (4.0 * w * t[0]), 1.0 / (2.0 * w)
        return values, back @ covariance @ back.T

    @cached_property
    def _linearised(self) -> tuple[FloatArray, FloatArray]:
        """(1/w^2, 2 zeta w, gain, dead time, ...) of each condition, and their covariances."""
        values, covariances = [], []
        for condition in self.conditions:
            model, covariance = condition.fit.model, condition.fit.covariance
            w, zeta = model.natural_frequency_rad_s, model.damping
            row = [w**-2, 2.0 * zeta * w, model.gain, model.dead_time_s]
            if model.gauge is not None:
                row += [model.gauge.natural_frequency_rad_s, model.gauge.damping]
            slope = np.eye(len(row))[:, : len(covariance)]  # a gauge held fixed has no variance
            slope[0, 0], slope[1, :2] = -2.0 * w**-3, (2.0 * zeta, 2.0 * w)
            values.append(row)
            covariances.append(slope @ covariance @ slope.T)
        return np.array(values), np.array(covariances)

    def _weights(self, cable_length_m: float, tension_N: float) -> FloatArray:
        """Weight of each condition in the interpolated value, shape (conditions,)."""
        from scipy.interpolate import RBFInterpolator  # noqa: PLC0415  slow to import

        places = np.array([(c.cable_length_m, c.tension_N) for c in self.conditions])
        target = np.array([[cable_length_m, tension_N]], dtype=np.float64)
        for n, (what, unit) in enumerate((("cable length", "m"), ("tension", "N"))):
            low, high = places[:, n].min(), places[:, n].max()
            room = RANGE_RTOL * high
            if not low - room <= target[0, n] <= high + room:
                raise InvalidInput(
                    f"{what} {target[0, n]:g} {unit} lies outside the identified range of {low:g} "
                    f"to {high:g} {unit}; identify there too"
                )
        points = _scaled(places, places)[:, self._varying]
        spline = RBFInterpolator(points, np.eye(len(points)), kernel="cubic", degree=1)
        return np.asarray(spline(_scaled(target, places)[:, self._varying])[0], dtype=np.float64)


def _scaled(points: FloatArray, places: FloatArray) -> FloatArray:
    """Length and inverse tension, each in units of its range over the conditions."""
    points, places = (np.column_stack([p[:, 0], 1.0 / p[:, 1]]) for p in (points, places))
    low, size = places.min(axis=0), np.ptp(places, axis=0)
    return np.asarray((points - low) / np.where(size > 0.0, size, 1.0))
