"""The strength of the effort in each trial, of a loop whose gain is not the same in all.

A supply, a temperature or a load changes the gain of a drive between trials. With g_i the gain in
trial i over the present one,

    y_i = G (g_i u_i):

ln g_i is one more parameter of each trial. The present one is the mean of all, or where they
drift the end of the line through them. What is not known of it adds to the covariance of G.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.bend_fit import Fits, explains, is_plain, may_explain
from estune.loop_model.loop_fit import NORMAL_QUANTILE, LoopFit
from estune.loop_model.records import LoopRecord

FEWEST = 3
"""Step trials from which their strengths are told from another plant."""

ROUNDS, MOVED, MOST = 4, 1e-3, 0.3
"""Most rounds, the change of ln g at which they end, and the most that one round changes it by."""

DRIFTS_FROM = 3.5
"""Slope of the strengths over its standard error from which they drift: by chance in one of 100
runs of eight trials."""


class Present(NamedTuple):
    """The logarithm of the present strength, and the standard deviation of what is known of it."""

    value: float
    deviation: float

    @classmethod
    def of(cls, logs: FloatArray) -> "Present":
        """That of trials in their order; the deviation is of a normal variable of its interval."""
        from scipy.special import stdtrit  # noqa: PLC0415  slow to import

        count, at = logs.size, np.arange(logs.size) - 0.5 * (logs.size - 1)
        value, free = float(logs.mean()), count - 1
        left, spread = logs - value, 1.0 / count
        slope, squares = float(at @ logs / (at @ at)), float(at @ at)
        straight = left - slope * at
        error = float(np.sqrt(straight @ straight / max(count - 2, 1) / squares))
        if count > FEWEST and abs(slope) > DRIFTS_FROM * error:
            value, left, free = value + slope * float(at[-1]), straight, count - 2
            spread += float(at[-1]) ** 2 / squares
        deviation = float(np.sqrt(left @ left / free * spread))
        return cls(value, deviation * float(stdtrit(free, 0.975)) / NORMAL_QUANTILE)


def with_strengths(
    fit: LoopFit | None, records: Sequence[LoopRecord], fits: Fits
) -> LoopFit | None:
    """The fit of records of different strength; None where that does not explain them.

    Args:
        fit: That of equal strengths; None where fewer records are known to differ.
        records: The records, the step trials in their order.
        fits: How records are fitted.
    """
    out = set(fit.left_out) if fit else set[int]()
    steps = [i for i, record in enumerate(records) if record.is_step and i not in out]
    if len(steps) < FEWEST or not all(record.at_rest for record in records):
        return None
    logs = np.zeros(len(records))
    found = two = fits.by_two_poles(records)
    for again in (lambda scaled, _: fits.by_two_poles(scaled), fits.again):
        if again == fits.again and not may_explain(found, two):
            return None
        for _ in range(ROUNDS):
            step = _step(found, _scaled(records, logs))
            if step is None:
                return None
            logs = logs + np.clip(step, -MOST, MOST)
            found = again(_scaled(records, logs), found)
            if np.abs(step).max() < MOVED:
                break
    present = Present.of(logs[steps])
    logs -= present.value
    found = fits.again(_scaled(records, logs), found)
    if not (explains(found, fit) if fit else is_plain(found)):
        return None
    # The gain is that of the numerator: an error of it is one along the numerator.
    along = np.zeros(found.model.parameters.size)
    along[found.order :] = present.deviation * np.array(found.model.numerator)
    further = np.outer(along, along)
    return found._replace(
        covariance=found.covariance + further,
        clustered=found.clustered + further,
        strengths=tuple(np.exp(logs).tolist()),
    )


def _scaled(records: Sequence[LoopRecord], logs: FloatArray) -> list[LoopRecord]:
    """The records with the effort that a plant of equal strength would see."""
    pairs = zip(records, np.exp(logs).tolist(), strict=True)
    return [record._replace(effort=g * record.effort) for record, g in pairs]


def _step(fit: LoopFit, records: Sequence[LoopRecord]) -> FloatArray | None:
    """The step of ln g of all records, shape (records,); None of a model of another kind."""
    if not fit.is_output_error:
        return None
    kept = fit.fitted(range(len(records)))
    signals = fit.signals(fit.fitted(records))
    at = fit.solution(signals)
    answer = at.regressors @ at.numerator
    columns = np.zeros((answer.size, len(kept)))
    for number, rows in signals.rows():
        columns[rows, number] = -answer[rows]
    slopes = np.column_stack([at.slopes(signals), columns])
    size = np.linalg.norm(slopes, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    found = np.linalg.lstsq(slopes / size, -at.residual, rcond=1e-9)[0] / size
    step = np.zeros(len(records))
    step[kept] = found[-len(kept) :]
    return np.asarray(step - step[kept].mean())
