"""Share of a residual that depends on a variable, on stretches of time that are left out.

The share is what a mean for each bin of the variable takes off the residual's power where it was
not fitted, when the base-model parameters are free too. (Friction that the base fit absorbed in
its viscous coefficient is thus counted in full.) By chance it is below zero: then it is none.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.residual.angle_periods import ResidualOverAngle, per_turn

SIMPLER: Mapping[str, tuple[str, ...]] = {
    "velocity sign and tension": ("velocity sign", "tension"),
    "velocity sign and load": ("velocity sign", "load"),
    "velocity": ("velocity sign",),
    "angle": ("tension",),
    "position period": ("tension", "angle"),
    "time": ("tension", "velocity sign"),
    "frequency": (
        *("velocity sign", "velocity", "tension", "velocity sign and tension", "command rate"),
        *("load", "velocity sign and load", "angle", "position period", "time"),
    ),
}
"""Simpler variables beside those that contain them."""


@dataclass(frozen=True, slots=True, eq=False)
class ResidualDependence:
    """Dependence of a block's residual on one variable.

    Attributes:
        name: The variable: time, velocity sign, velocity, tension, load, either of them and the
            velocity sign, angle, position period, length, command rate, frequency.
        share: Share of the residual's power that the variable takes off data left out, 0 to 1.
        mean: Mean residual there, shape (bins,), in the block's unit; over frequency that part of
            it which follows the load.
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


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted residual whose dependence on variables is computed.

    Attributes:
        residual: At the chosen samples, shape (chosen,).
        basis: Orthonormal basis of the base-model parameters, shape (chosen, parameters).
        fold: Part of the data that each is left out with, same shape.
        spread: Smooths columns over all samples, shape (samples, columns), as the block's terms
            were smoothed.
    """

    residual: FloatArray
    basis: FloatArray
    chosen: NDArray[np.int64]
    fold: NDArray[np.int64]
    spread: Callable[[FloatArray], FloatArray]

    @cached_property
    def _alone(self) -> float:
        """Power on data left out with the base-model parameters alone."""
        return self._left_out([self.basis] * CONSTANTS.folds)

    def _left_out(self, columns: Sequence[FloatArray]) -> float:
        """Sum of squares on each part, with columns fitted to the others; those of each part."""
        power = 0.0
        for n, X in enumerate(columns):
            out = self.fold == n
            size = np.sqrt(np.sum(X[~out] ** 2, axis=0))
            size[size == 0.0] = 1.0
            terms, pull = X[~out].T @ X[~out], X[~out].T @ self.residual[~out]
            inverse = np.linalg.pinv(terms / np.outer(size, size), rcond=1e-9, hermitian=True)
            left = self.residual[out] - X[out] @ (inverse @ (pull / size) / size)
            power += float(left @ left)
        return power

    def share(self, *by: FloatArray) -> float:
        """Share of the residual that columns, (chosen, columns), take off data left out.

        Args:
            by: The columns, or those that are chosen without each part.
        """
        each = by * CONSTANTS.folds if len(by) == 1 else by
        left = self._left_out([np.hstack([self.basis, one]) for one in each])
        return max(0.0, 1.0 - left / max(self._alone, 1e-300))

    def sizes(self, by: FloatArray) -> FloatArray:
        """Coefficients of columns beside the base-model parameters, shape (columns,)."""
        beside = by - self.basis @ (self.basis.T @ by)
        inverse = np.linalg.pinv(beside.T @ beside, rcond=1e-9, hermitian=True)
        sizes: FloatArray = inverse @ (beside.T @ self.residual)
        return sizes

    def binned(self, variable: Variable, bins: int = 8) -> ResidualDependence:
        """Share explained by a mean for each bin of a variable."""
        name, unit, of, label = variable
        label = quantiles(of, bins) if label is None else label
        known = label >= 0
        _, within, count = np.unique(label[known], return_inverse=True, return_counts=True)
        member = np.zeros((label.size, count.size))
        member[np.flatnonzero(known), within] = 1.0
        by = self.spread(member)[self.chosen]
        mean, at = self.sizes(by), np.bincount(within, of[known]) / count
        mean = mean - float(mean @ count) / count.sum()
        return ResidualDependence(name, unit, self.share(by), at, mean)

    def along(self, variable: Variable) -> ResidualDependence:
        """Share explained by a straight line."""
        x = variable.of[self.chosen]
        return replace(self.binned(variable), share=self.share((x - x.mean())[:, None]))

    def by_load(self, variable: Variable) -> ResidualDependence:
        """Share explained by a straight line over the load in each direction."""
        label = np.zeros(variable.of.size, np.int64) if variable.label is None else variable.label
        known = np.flatnonzero(label >= 0)
        member = np.zeros((label.size, int(label.max()) // CONSTANTS.levels + 1))
        member[known, label[known] // CONSTANTS.levels] = 1.0
        load = np.nan_to_num(variable.of)[:, None]
        lines = self.spread(np.hstack([member, member * load]))[self.chosen]
        return replace(self.binned(variable), share=self.share(lines))

    def periodic(self, angle: Variable) -> ResidualDependence:
        """Share explained by the best sine of the angle, as of ripple or an eccentric drum.

        The best is chosen without the part that it is judged on.
        """
        from_start = angle.of - np.nanmin(angle.of)
        span = max(float(np.nanmax(from_start)), 1e-300)

        def period(samples: NDArray[np.bool_]) -> float:
            turning = ResidualOverAngle(from_start[self.chosen[samples]], self.residual[samples])
            # A period must fit twice into the angles seen; of 512 cells a quarter are told apart.
            orders = per_turn([turning], span / 512.0, 2.0)
            return 2.0 * math.pi / orders[0] if orders else span

        def wave(length: float) -> FloatArray:
            phase = np.nan_to_num(2.0 * np.pi * from_start / length)
            return self.spread(np.column_stack([np.cos(phase), np.sin(phase)]))[self.chosen]

        lengths = [period(self.fold != n) for n in range(CONSTANTS.folds)]
        waves = {length: wave(length) for length in lengths}
        best = period(self.fold >= 0)
        sine = self.binned(Variable("position period", angle.unit, from_start % best), 16)
        share = self.share(*(waves[length] for length in lengths))
        return replace(sine, share=share, detail=f"{best:.3g} {angle.unit}")

    def classed(self, variable: Variable, slope: FloatArray, bins: int = 8) -> ResidualDependence:
        """Share explained when each class has an offset and a slope of its own.

        Classes are lengths, or stretches of time: friction that changes as a machine warms has no
        mean over time, but another slope. The larger part of both is shown.
        """
        x = variable.of[self.chosen]
        label = quantiles(variable.of, bins)[self.chosen] if variable.name == "time" else x
        _, label = np.unique(label, return_inverse=True)
        member = np.eye(int(label.max()) + 1)[label]
        both = np.hstack([member, member * slope[self.chosen][:, None]])
        offset, slopes = np.split(self.sizes(both), 2)
        slopes = slopes * float(np.sqrt(np.mean(slope[self.chosen] ** 2)))
        turns = bool(slopes.std() > offset.std())
        mean, unit = (
            (slopes, f"{variable.unit}, along the motion") if turns else (offset, variable.unit)
        )
        at = np.bincount(label, x) / np.bincount(label)
        return ResidualDependence(variable.name, unit, self.share(both), at, mean - mean.mean())


def over_frequency(
    residual: Sequence[FloatArray],
    carried: Sequence[FloatArray],
    noise: Sequence[FloatArray],
    sampling_Hz: float,
) -> ResidualDependence | None:
    """Share of a residual that follows what the model explains by some response over frequency.

    So do a mode, a lag or a delay that the model lacks. The response is that of segments (Welch
    1967) to others of the same record; None of records too short to have them.

    Args:
        residual: Of each record, shape (samples,).
        carried: What the model explains of the same balance, alike.
        noise: That of noise alone: where it is as large both are made of one noise.
        sampling_Hz: Their rate.
    """
    triples = [np.array(one) for one in zip(residual, carried, noise, strict=True)]
    known = [one[:, np.isfinite(one).all(0)] for one in triples]
    size = 2 ** int(math.log2(max(sum(one.shape[1] for one in known) / CONSTANTS.segments, 1.0)))
    if size < CONSTANTS.stretches:
        return None
    bell, folds, spectra = np.hanning(size), list[int](), []
    for one in known:
        begins = range(0, one.shape[1] - size + 1, size)
        folds += [n % CONSTANTS.folds for n in range(len(begins))]
        spectra += [np.fft.rfft(bell * one[:, n : n + size])[:, 1:] for n in begins]
    if len(folds) < 2 * CONSTANTS.folds:  # a part of one segment is told by its noise
        return None
    fold, (r_f, u_f, n_f) = np.array(folds), np.moveaxis(np.array(spectra), 1, 0)
    of_motion, of_noise = (np.mean(np.abs(one) ** 2, axis=0) for one in (u_f, n_f))
    u_f = u_f * (of_motion > CONSTANTS.above_noise**2 * of_noise)

    def response(chosen: NDArray[np.bool_]) -> NDArray[np.complex128]:
        power = np.sum(np.abs(u_f[chosen]) ** 2, axis=0)
        shown = np.sum(r_f[chosen] * u_f[chosen].conj(), axis=0) / np.maximum(power, 1e-300)
        return np.asarray(shown)

    left = sum(
        float(np.sum(np.abs(r_f[fold == n] - response(fold != n) * u_f[fold == n]) ** 2))
        for n in range(CONSTANTS.folds)
    )
    share = max(0.0, 1.0 - left / max(float(np.sum(np.abs(r_f) ** 2)), 1e-300))
    frequency = np.arange(1, size // 2 + 1) * sampling_Hz / size
    label = np.searchsorted(
        np.geomspace(1.0, size / 2.0, 4 * CONSTANTS.folds), np.arange(1, size // 2 + 1)
    )
    label = np.unique(label, return_inverse=True)[1]
    follows = np.mean(np.abs(response(fold >= 0) * u_f) ** 2, axis=0)
    # Of a Hann window 3/8 of the power are left; each line stands for one of negative frequency.
    mean = np.sqrt(2.0 * np.bincount(label, follows) / (0.375 * size**2))
    at = np.bincount(label, frequency) / np.bincount(label)
    return ResidualDependence("frequency", "Hz", share, at, mean)


def views(
    fitted: Fit, variables: Sequence[Variable], slope: FloatArray
) -> list[ResidualDependence]:
    """All views of a residual over variables."""
    listed = []
    for variable in variables:
        if variable.name == "command rate":
            listed.append(fitted.along(variable))
        elif variable.name in ("length", "time"):
            listed.append(fitted.classed(variable, slope))
        elif variable.name == "velocity sign and load":
            listed.append(fitted.by_load(variable))
        else:
            listed.append(fitted.binned(variable))
        if variable.name == "angle":
            listed.append(fitted.periodic(variable))
    return listed


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


def crossed(way: NDArray[np.int64], load: FloatArray) -> NDArray[np.int64]:
    """Numbers of the directions crossed with levels of a load; -1 where either is unknown."""
    levels = CONSTANTS.levels
    cells = way * levels + quantiles(load, levels)
    return np.where((way < 0) | ~np.isfinite(load), -1, cells)


def quantiles(of: FloatArray, bins: int) -> NDArray[np.int64]:
    """Index of each value's quantile bin; -1 where it is not known."""
    known = np.isfinite(of)
    edges = np.unique(np.quantile(of[known], np.linspace(0.0, 1.0, bins + 1)[1:-1]))
    return np.where(known, np.searchsorted(edges, of, side="right"), -1).astype(np.int64)
