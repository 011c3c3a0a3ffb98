"""Least squares on a torque balance, judged on the stretch of time that is left out.

Sums of products of each stretch give the fit to all others, and its error on the one left out, of
any set of terms at once. A share c of the load leaves K_t i - c K_t |i| sign(v) for the others.
What remains of the torque is less, and so is any error of it, and the inertia. The torque being
given, what is predicted is the acceleration: errors are relative to the inertia that they come
with, so that a share of all the torque, c = 1, explains nothing by itself.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.torque_balance.balance import BASE, TorqueBalance
from plants.diagnosis.torque_balance.laws import LOAD, TorqueLaw


class LeftOut(NamedTuple):
    """What a set of laws leaves.

    Attributes:
        error: Sum of squares on each stretch of time, left out of the fit, shape (stretches,).
        sizes: Of its terms, fitted to all, by name; the share of the load among them.
        names: The terms in the order of `shifted`.
        shifted: Sizes without each stretch, shape (stretches, terms).
    """

    laws: tuple[TorqueLaw, ...]
    error: FloatArray
    sizes: dict[str, float]
    names: tuple[str, ...]
    shifted: FloatArray

    @property
    def total(self) -> float:
        """Sum of squares over all stretches."""
        return float(self.error.sum())

    @property
    def deviations(self) -> dict[str, float]:
        """Standard error of each size by the jackknife over stretches, whatever their colour."""
        n = len(self.shifted)
        spread = np.sqrt((n - 1.0) / n * np.square(self.shifted - self.shifted.mean(0)).sum(0))
        return dict(zip(self.names, spread.tolist(), strict=True))


def rest_Nm(balance: TorqueBalance, fit: LeftOut) -> float:
    """What a fit to other records leaves of a balance, rms."""
    sizes = {name: size for name, size in fit.sizes.items() if name != LOAD}
    torque = balance.torque_Nm - fit.sizes.get(LOAD, 0.0) * balance.loaded_Nm
    left = torque - sum(size * balance.columns[name] for name, size in sizes.items())
    return float(np.sqrt(np.mean(np.square(left))))


class BalanceFits:
    """Fits of sets of laws to one balance."""

    def __init__(self, balance: TorqueBalance) -> None:
        self.balance = balance
        names = [name for name in balance.columns if name != "angle"]
        self._place = {name: n for n, name in enumerate(names)}
        X = np.column_stack([balance.columns[name] for name in names])
        # The torque, and what of it a share of the load takes.
        Y = np.column_stack([balance.torque_Nm, balance.loaded_Nm])
        ends = np.flatnonzero(np.diff(balance.block)) + 1
        parts = list(zip(np.split(X, ends), np.split(Y, ends), strict=True))
        self._terms = np.array([x.T @ x for x, _ in parts])
        self._pull = np.array([x.T @ y for x, y in parts])
        self._power = np.array([y.T @ y for _, y in parts])

    def left_out(self, laws: Sequence[TorqueLaw]) -> LeftOut:
        """A fit of some laws, and its error on each stretch left out."""
        columns = list(dict.fromkeys([*BASE, *(c for law in laws for c in law.columns)]))
        loaded = LOAD in columns
        columns = [name for name in columns if name != LOAD]
        of = [self._place[name] for name in columns]
        terms, pull = self._terms[:, of][:, :, of], self._pull[:, of]
        # Sizes per unit of torque and of its loaded part, without each stretch and with all.
        left = np.concatenate([terms.sum(0) - terms, terms.sum(0)[None]])
        right = np.concatenate([pull.sum(0) - pull, pull.sum(0)[None]])
        scale = np.sqrt(np.maximum(np.diagonal(terms.sum(0)), 1e-300))
        # Terms that no stretch tells apart share what they explain.
        inverse = np.linalg.pinv(left / np.outer(scale, scale), rcond=1e-9, hermitian=True)
        sizes = np.einsum("kij,kjl->kil", inverse, right / scale[:, None]) / scale[:, None]
        kept, shares = self._shares(right, sizes) if loaded else _unloaded(len(sizes))
        fitted = np.einsum("kil,kl->ki", sizes, kept)
        outside, by = fitted[:-1], kept[:-1]
        error = np.einsum("kl,klm,km->k", by, self._power, by)
        error -= 2.0 * np.einsum("ki,kil,kl->k", outside, pull, by)
        error += np.einsum("ki,kij,kj->k", outside, terms, outside)
        if loaded:
            columns, fitted = [*columns, LOAD], np.column_stack([fitted, shares])
            error /= np.square(1.0 - shares[:-1] * self._loaded(sizes))
        # Of terms that fit to the last digit rounding leaves less than nothing.
        error = np.maximum(error, 0.0)
        whole = dict(zip(columns, fitted[-1].tolist(), strict=True))
        return LeftOut(tuple(laws), error, whole, tuple(columns), fitted[:-1])

    def _loaded(self, sizes: FloatArray) -> float:
        """Part of the inertia that a share of all the load would take, at the most all of it."""
        inertia, loaded = sizes[-1, 0]
        n = len(sizes) - 1
        apart = sizes[:-1, 0, 0] - sizes[:-1, 0, 0].mean()
        error = np.sqrt((n - 1.0) / n * np.square(apart).sum())
        # Where the inertia is not known nothing tells a share of the load from a smaller torque.
        return (
            float(min(loaded / inertia, 1.0)) if inertia > CONSTANTS.above_noise * error else 1.0
        )

    def _shares(self, right: FloatArray, sizes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The share of the load that leaves the least inside each fit.

        Returns:
            1 and -c of each fit, shape (fits, 2), and c, shape (fits,).
        """
        of_all = self._power.sum(0)
        power = np.concatenate([of_all - self._power, of_all[None]])
        explained = np.einsum("kil,kim->klm", sizes, right)
        rest = power - 0.5 * (explained + explained.transpose(0, 2, 1))
        tried = np.linspace(CONSTANTS.load_least, CONSTANTS.load_most, CONSTANTS.loads)
        by = np.column_stack([np.ones(tried.size), -tried])
        inside = np.einsum("cl,klm,cm->kc", by, rest, by) / np.square(
            1.0 - tried * self._loaded(sizes)
        )
        shares = np.array([_least(tried, row) for row in inside])
        return np.column_stack([np.ones(shares.size), -shares]), shares


def _unloaded(fits: int) -> tuple[FloatArray, FloatArray]:
    return np.tile([1.0, 0.0], (fits, 1)), np.zeros(fits)


def _least(at: FloatArray, values: FloatArray) -> float:
    """Where a parabola through the least of some values and its neighbours is least."""
    n = int(values.argmin())
    if not 0 < n < at.size - 1:
        return float(at[n])
    x, y = at[n - 1 : n + 2], values[n - 1 : n + 2]
    bend, slope, _ = np.polyfit(x - x[1], y / max(y.max(), 1e-300), 2)
    return float(np.clip(x[1] - slope / (2.0 * bend), x[0], x[2])) if bend > 0.0 else float(x[1])
