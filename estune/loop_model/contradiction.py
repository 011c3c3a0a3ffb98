"""Records that a loop model was not fitted to: how it foretells them, and which contradict it."""

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.bend import unbent
from estune.loop_model.fit_signals import signals_of
from estune.loop_model.friction_motion import friction_of, less_friction
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.records import LoopRecord
from estune.loop_model.whiteness import beyond_chance

APART = 3.0
"""Residual of a record, predicted by the others, over the largest of theirs, from which it is left
out; records of loops that no linear model explains differ by less, for their trials grow step by
step."""

LINEAR = 0.1
"""Largest step of a logarithm, of poles or noise, that slopes are believed for: to 5 % or so."""

OTHERS = 3
"""Records that have to agree against each one that is left out."""


def standing_out(fit: LoopFit) -> list[int]:
    """The records of the largest residuals by far, beyond what chance gives.

    All at once: with two disturbed records of nine the fit without one is as wrong as with both.
    """
    powers = [power_of(errors) for errors in fit.errors]
    order = sorted(range(len(powers)), key=powers.__getitem__, reverse=True)
    for count in range(len(powers) // (OTHERS + 1), 0, -1):
        least, next_one = order[count - 1], order[count]
        if powers[least] > beyond_chance(fit.errors[least].size) * powers[next_one]:
            return sorted(order[:count])
    return []


def foretold_by_others(
    fit: LoopFit, records: Sequence[LoopRecord], suspects: Sequence[int]
) -> bool:
    """Whether a linear step to the fit of the other records says that they foretell the suspects.

    It costs one set of slopes instead of a search. A record that spoils a fit moves it further
    than slopes reach, or the others do not know some direction of it: then nothing is said.
    """
    if fit.model.friction:
        return False
    signals = signals_of(records, fit.settling_samples)
    here = fit.solution(signals)
    J = here.slopes(signals)
    of_record = np.concatenate([np.repeat(g.members, g.length) for g in signals.groups])
    out = np.isin(of_record, suspects)
    size = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    step, _, rank, _ = np.linalg.lstsq(J[~out] / size, -here.residual[~out], rcond=None)
    step /= size
    logarithms = np.delete(step, range(fit.order, fit.order + here.numerator.size))
    if rank < step.size or np.abs(logarithms).max() > LINEAR:
        return False
    moved = here.residual + J @ step
    most = max(power_of(moved[of_record == i]) for i in {*of_record[~out].tolist()})
    return all(power_of(moved[of_record == i]) <= APART**2 * most for i in suspects)


def power_of(errors: FloatArray) -> float:
    """Mean square of errors; zeros stand where nothing is predicted."""
    return float(errors @ errors) / max(int(np.count_nonzero(errors)), 1)


def prediction_error(fit: LoopFit, record: LoopRecord) -> FloatArray:
    """Prediction error of a fit on a record that was not fitted, shape (samples,)."""
    model, record = fit.model, unbent(record, fit.model.bend)
    signals = fit.signals([record])
    forces = friction_of(model, signals, record)
    errors = fit.solution(less_friction(signals, forces)).residual
    return np.concatenate([np.zeros(record.samples - errors.size), errors])


def with_predicted(fit: LoopFit, records: Sequence[LoopRecord]) -> LoopFit:
    """The fit with the errors of further records by it, which it was not fitted to."""
    errors = tuple(prediction_error(fit, record) for record in records)
    return fit._replace(
        misfits=(*fit.misfits, *(map(partial(_misfit, fit), errors, records))),
        unexplained=(*fit.unexplained, *errors),
        errors=(*fit.errors, *errors),
        is_white=False,
    )


def _misfit(fit: LoopFit, error: FloatArray, record: LoopRecord) -> float:
    """The rho of a record that was not fitted."""
    beyond = max(power_of(error) - fit.residual_std**2, 0.0)
    return math.sqrt(beyond) / max(record.span, 1e-300)


def with_all(
    fit: LoopFit, records: Sequence[LoopRecord], fitted: list[int], out: tuple[int, ...]
) -> LoopFit:
    """A fit of some of the records with the errors of those left out."""
    misfits = [math.nan] * len(records)
    unexplained, errors = [np.zeros(0)] * len(records), [np.zeros(0)] * len(records)
    for i, number in enumerate(fitted):
        misfits[number], errors[number] = fit.misfits[i], fit.errors[i]
        unexplained[number] = fit.unexplained[i]
    for number in out:
        unexplained[number] = errors[number] = prediction_error(fit, records[number])
        misfits[number] = _misfit(fit, errors[number], records[number])
    return fit._replace(
        misfits=tuple(misfits), unexplained=tuple(unexplained), errors=tuple(errors), left_out=out
    )
