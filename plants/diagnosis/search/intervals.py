"""95 % confidence intervals of fitted values by a delete-a-group jackknife.

    s^2 = (G - 1)/G sum_g d_g^2,    d_g = (H - H_g + 1)^-1 J_g^T r_g

J is the derivative of the residuals r by the values in prior deviations, H = J^T J, g one of G
groups of entries that belong together: blocks of time, or whole records. Residuals may have any
colour within a group, and a group that alone determines a value counts in full, where the sandwich
of White (1980) has it near zero.
"""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from plants.diagnosis.data.noise_floor import ALLOWANCE
from plants.diagnosis.models.diagnosed_model import BASE, Free
from plants.diagnosis.result import Interval
from plants.diagnosis.search.constants import CONSTANTS
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter, record_of

FURTHEST = 2.0
"""Prior deviations by which a group may move a value."""


def intervals(
    fitter: ModelFitter, one: CandidateFit, base: CandidateFit
) -> Mapping[str, Interval]:
    """Values and 95 % confidence intervals of all that the records share.

    Args:
        fitter: Model and records.
        one: The model.
        base: The model without effects: what is left of its error power may shift a value.
    """
    fitted, c = one.fitted, CONSTANTS
    moves = fitter.moves(fitted.predictor)
    residuals, jacobian = fitted.predictor.linearise(
        fitted.values, moves, fitted.entries, fitted.residuals
    )
    free = [fitted.predictor.free[n] for n in moves]
    values = fitted.values[moves]
    prior = np.array([_deviation(f, v) for f, v in zip(free, values.tolist(), strict=True)])
    columns = jacobian.T * prior[:, None]
    record = fitted.predictor.index.measurement[fitted.entries]
    spread = np.maximum(
        jackknife(columns, residuals, fitter.group[fitted.entries]),
        jackknife(columns, residuals, record),
    )
    left = max(one.J - 1.0, 0.0) / max(base.J, 1e-300)
    taken_up = c.form_taken_up * math.sqrt(min(left, 1.0))
    found = {}
    for f, value, s in zip(free, values.tolist(), (spread * prior).tolist(), strict=True):
        if record_of(f.owner) is not None:
            continue
        # A limit is neutral far up, a ratio at one: what counts is the nearer of that and zero.
        size = min(abs(value - (f.neutral or 0.0)), abs(value))
        least = ALLOWANCE / c.student if f.owner == BASE else c.form_least
        form = max(least, taken_up)
        half = c.student * math.hypot(s, form * size)
        if f.scale == "log" and value > 0.0:
            factor = math.exp(min(half / value, 50.0))
            low, high = value / factor, value * factor
        else:
            low, high = value - half, value + half
        found[f.name] = Interval(value, max(low, f.low), min(high, f.high), f.unit)
    return found


def _deviation(free: Free, value: float) -> float:
    """Prior deviation of a value: itself where it is fitted on a log scale."""
    if free.scale == "log":
        return abs(value)
    return max(abs(value), abs(free.start), 1e-3 * (free.high - free.low))


def jackknife(
    columns: FloatArray, residuals: FloatArray, group: NDArray[np.int64] | NDArray[np.int32]
) -> FloatArray:
    """Standard errors by leaving out one group at a time, shape (values,).

    Args:
        columns: Derivative of the residuals by the values in prior deviations, (values, entries).
        residuals: Shape (entries,).
        group: Number of each entry's group, same shape.
    """
    normal = columns @ columns.T
    groups = np.unique(group)
    total = np.zeros(len(columns))
    for n in groups:
        mine = columns[:, group == n]
        rest = normal - mine @ mine.T + np.eye(len(columns))
        moved = np.linalg.solve(rest, mine @ residuals[group == n])
        total += np.clip(moved, -FURTHEST, FURTHEST) ** 2
    count = groups.size
    spread: FloatArray = np.sqrt(total * (count - 1) / max(count, 1))
    return spread
