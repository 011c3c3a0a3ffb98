"""The bend of a plant, fitted beside its linear model.

Its terms are linear in the prediction error, beside the slopes of the model: each round finds
them by least squares, then the model anew of the records without them.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.bend import POWERS, Bend, level_of, unbent
from estune.loop_model.fit_signals import FitSignals, RecordGroup
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.records import LoopRecord
from estune.loop_model.whiteness import beyond_chance

SPRING, SENSOR = (0, 1), (2, 3)
"""Terms that are free: of one of the two. With both free the steps of slow trials, which hardly
tell them apart, led to terms ten thousand times the slope."""

FEWEST = 2
"""Trials from which a bend is sought: to one alone many are the same."""

POLES_MOST = 4
"""Most poles beside a bend that does not leave white errors: more of them explain anything."""

STEEPEST = 4.0
"""Largest ratio of the slopes at the beginning and the end of the step, either way."""

ROUNDS, GAIN, SHARES = 8, 0.01, (1.0, 0.5, 0.25)
"""Most rounds, the share of the squared errors below which a further one is not worth it, and the
shares of a step that are tried until it lowers them."""

LEFT_FIRST, LEFT_MOST = 0.3, 0.25
"""Shares of the squared errors of a linear model beyond the noise that the first step towards a
bend may leave, and the bend in the end. On five loops of `experiments.loop_claims.mild` whose
spring or sensor bends it leaves 0 to 6 %, where the gain of a drive drifts or varies 85 to
100 %."""

EXPLAINED = 0.002
"""Misfit up to which a bend explains records that are not white, as friction does."""

Again = Callable[[Sequence[LoopRecord], LoopFit | None], LoopFit]


class Fits(NamedTuple):
    """How records are fitted.

    Attributes:
        by_two_poles: By a linear model of two poles.
        again: By any model of a straight plant, from an earlier fit; from a cold start without.
    """

    by_two_poles: Callable[[Sequence[LoopRecord]], LoopFit]
    again: Again


class Correction(NamedTuple):
    """A step of least squares towards the bend that records show beside a linear model.

    Attributes:
        step: Change of the bend's terms.
        squares: Sum of the squared errors before it and after it.
        noise: What white noise has of it.
        covariance: Of the model's parameters where the terms are free, as a `LoopFit` has it.
        clustered: The same from the scatter between records.
    """

    step: FloatArray
    squares: tuple[float, float]
    noise: float
    covariance: FloatArray
    clustered: FloatArray

    @property
    def left(self) -> float:
        """Share of the squared errors beyond the noise that it leaves."""
        before, after = (each - self.noise for each in self.squares)
        return after / before if before > 0.0 else math.inf


def with_bend(
    fit: LoopFit, records: Sequence[LoopRecord], fits: Fits, bend: Bend | None = None
) -> LoopFit | None:
    """The fit of records with the bend that they show; None where none explains them.

    Args:
        fit: That of the records without the bend that is known.
        records: The records as they are, all from rest.
        fits: How records are fitted.
        bend: The bend that is known; None before one is.
    """
    if bend is not None:
        own = np.flatnonzero(bend.terms).tolist()
        found = _settled(fit, records, bend, own, fits.again)
        return found if found is not None and is_plain(found) else None
    level = level_of(records)
    if level is None or len(records) < FEWEST:
        return None
    # By two poles: further ones take up the bend, and the first step from them leads astray.
    two = fits.by_two_poles(records)
    level = level._replace(ahead=two.model.dead_samples)
    first = _correction(two, records, level, SPRING + SENSOR)
    if first is None or first.left > LEFT_FIRST:
        return None
    singly = [
        (
            kind,
            _settled(two, records, level, kind, lambda straight, _: fits.by_two_poles(straight)),
        )
        for kind in (SPRING, SENSOR)
    ]
    # The likelier one first: slow trials hardly tell a spring from a sensor.
    known = [(kind, bent) for kind, bent in singly if bent and may_explain(bent, two)]
    for kind, bent in sorted(known, key=lambda pair: _squares(pair[1])):
        whole = fits.again([unbent(record, bent.model.bend) for record in records], None)
        if not may_explain(whole, two):
            continue
        found = _settled(whole, records, bent.model.bend, kind, fits.again)
        if found is not None and found.order > two.order:
            # Poles that took up what was left of the bend are not needed any more.
            whole = fits.again([unbent(record, found.model.bend) for record in records], None)
            found = _settled(whole, records, found.model.bend, kind, fits.again)
        if found is not None and explains(found, fit):
            return found
    return None


def _squares(fit: LoopFit) -> float:
    """Sum of the squared errors."""
    return sum(float(errors @ errors) for errors in fit.errors)


def may_explain(found: LoopFit, linear: LoopFit) -> bool:
    """Whether more fits are worth it: one leaves much less than a linear one.

    Where a load acts in some trials they took 10 s a trial, and explained nothing.
    """
    return _beyond(found) < LEFT_FIRST * _beyond(linear)


def explains(found: LoopFit, linear: LoopFit) -> bool:
    """Whether a fit explains what a linear one leaves, and is one that can be.

    A load of its noise model makes white what a bend leaves, with a misfit of 1 % and more: where
    a fit without one predicts as well, there is none.
    """
    if linear.noise.is_white:
        return is_plain(found) and _beyond(found) < LEFT_MOST * _beyond(linear)
    size = sum(errors.size for errors in found.errors)
    as_well = _squares(found) < beyond_chance(size) * _squares(linear)
    return is_plain(found) and found.is_white and found.noise.is_white and as_well


def is_plain(fit: LoopFit) -> bool:
    """Whether a fit explains its records, with few poles and a bend that can be."""
    few = fit.misfit < EXPLAINED and fit.order <= POLES_MOST
    can_be = fit.model.bend.steepness(fit.model.static_gain) < STEEPEST
    return can_be and (fit.is_white or few)


def _beyond(fit: LoopFit) -> float:
    """Sum of the squared errors beyond the noise."""
    of_noise = fit.noise_std**2
    return sum(float(e @ e) - of_noise * e.size for e in fit.fitted(fit.errors))


def _settled(
    fit: LoopFit, records: Sequence[LoopRecord], bend: Bend, kind: Sequence[int], again: Again
) -> LoopFit | None:
    """The fit at the bend that no further round changes; None of a model of another kind."""
    found = _correction(fit, records, bend, kind)
    for _ in range(ROUNDS):
        if found is None or found.squares[1] > (1.0 - GAIN) * found.squares[0]:
            break
        for share in SHARES:
            moved = bend.with_terms(bend.terms + share * found.step)
            tried = moved._replace(ahead=fit.model.dead_samples)
            other = again([unbent(record, tried) for record in records], fit)
            following = _correction(other, records, tried, kind)
            if following is None or following.squares[0] < found.squares[0]:
                break
        else:
            break
        fit, bend, found = other, tried, following
    if found is None:
        return None
    return fit._replace(
        model=fit.model._replace(bend=bend),
        covariance=found.covariance,
        clustered=found.clustered,
    )


def _correction(
    fit: LoopFit, records: Sequence[LoopRecord], bend: Bend, kind: Sequence[int]
) -> Correction | None:
    """The step from a fit and its bend in the terms of a kind; None of a model of another kind."""
    if not fit.is_output_error:
        return None
    chosen = fit.fitted(records)
    signals = fit.signals([unbent(record, bend) for record in chosen])
    at = fit.solution(signals)
    terms = [fit.solution(_with(signals, chosen, bend, term)).residual for term in kind]
    slopes, e = np.column_stack([at.slopes(signals), *terms]), at.residual
    size = np.linalg.norm(slopes, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    A = slopes / size
    step = -np.linalg.lstsq(A, e, rcond=1e-9)[0] / size
    left = e + slopes @ step
    after = float(left @ left)
    inverse = np.linalg.pinv(A.T @ A, rcond=1e-12) / np.outer(size, size)
    count, n = max(e.size - step.size, 1), fit.model.parameters.size
    whole = np.zeros(2 * len(POWERS))
    whole[list(kind)] = step[-len(kind) :]
    scores = np.array([slopes[rows].T @ left[rows] for _, rows in signals.rows()])
    return Correction(
        whole,
        (float(e @ e), after),
        e.size * fit.noise_std**2,
        (after / count * inverse)[:n, :n],
        (inverse @ (scores.T @ scores) @ inverse)[:n, :n],
    )


def _with(signals: FitSignals, records: Sequence[LoopRecord], bend: Bend, term: int) -> FitSignals:
    """Signals that are the shape of one term of a bend alone."""
    of_measurement = term >= len(POWERS)

    def alone(group: RecordGroup) -> RecordGroup:
        rows = [bend.shapes(records[i].measurement)[term] for i in group.members]
        shape = np.array([row - row[0] for row in rows])
        pair = np.zeros_like(shape), shape
        return group._replace(effort=pair[1 - of_measurement], measurement=pair[of_measurement])

    return signals._replace(groups=tuple(map(alone, signals.groups)))
