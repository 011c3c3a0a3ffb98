"""The loop as the trials near some gains show it.

A loop that is not linear, or that changes, is another one in a timid trial than at the gains in
question, and no linear model explains both. On 16 such loops (`experiments.loop_claims.mild`,
seeds 3 to 17) the model of all trials gave Ms 0.75 to 1.08 times the true one, and an unstable
loop for three; that of the trials near the gains 0.97 to 1.06 times for all but one.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.loop_model.contradiction import with_predicted
from estune.loop_model.fitting import FRICTION_DONE, fit_with_excitations
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.records import LoopRecord

NEAR = 0.5
"""Distance in the logarithm of P, I and D up to which a trial counts as near."""

OF_MISFIT, NEAR_ERROR, NOT_EXCITED = 14.0, 0.04, 0.09
"""Error of ln Ms by the trials near some gains over the misfit of the fit of all, the most that it
is, and where no trial near them excites the loop. On six loops of `experiments.loop_claims.mild`
of misfits of 0.2 to 2.3 % the error was 2 to 14 times the misfit, and at most 2.8 % but where a
spring or sensor bends, which the fit of all shows."""

TRIALS_MIN = 2
"""Trials at or near the gains in question that a claim needs: without any, friction that timid
trials hide is not seen, and one alone may be disturbed."""


class NearFit(NamedTuple):
    """A fit of the trials near some gains.

    Attributes:
        fit: The fit, which holds the errors of excitations near them that it was not fitted to.
        steps: Numbers of its step trials.
        excitations: The excitations that it holds.
    """

    fit: LoopFit
    steps: tuple[int, ...]
    excitations: tuple[LoopRecord, ...]


def fit_near(
    gains: Gains,
    steps: Sequence[LoopRecord],
    excitations: Sequence[LoopRecord],
    sampling_Hz: float,
    settling_time_s: float,
    *,
    misfit: float,
) -> NearFit | None:
    """The fit of the trials near some gains, by the misfit of all; None where these are too few.

    Excitations of other gains are fitted too where there are none near, and these spoil nothing.
    Those near that spoil the fit of the steps stay in it, with their errors by it.
    """
    numbers = tuple(i for i, record in enumerate(steps) if is_near(record, gains))
    if len(numbers) < TRIALS_MIN:
        return None
    own = [steps[i] for i in numbers]
    near = tuple(record for record in excitations if is_near(record, gains))
    fit, kept = fit_with_excitations(own, near or excitations, sampling_Hz, settling_time_s)
    if near and not kept:
        fit, kept = with_predicted(fit, near), near
    error = near_error(misfit) if near else NOT_EXCITED
    return NearFit(fit._replace(near_error=error), numbers, kept)


def near_error(misfit: float) -> float:
    """Error of ln Ms by the trials near some gains, by the misfit of the fit of all."""
    return min(OF_MISFIT * misfit, NEAR_ERROR)


def lacks_excitation(
    fit: LoopFit, records: Sequence[LoopRecord], gains: Gains, tried: Gains
) -> bool:
    """Whether no model explains all trials, and none excites the loop near gains tried there."""
    if is_explained(fit) or not are_near(tried, gains):
        return False
    return not any(is_near(record, gains) and not record.is_step for record in records)


def is_explained(fit: LoopFit) -> bool:
    """Whether a fit explains its records: no linear model is needed that explains fewer."""
    if fit.is_white or fit.strengths or not fit.model.bend.is_straight:
        return True
    return fit.model.friction > 0.0 and fit.misfit < FRICTION_DONE


def is_near(record: LoopRecord, gains: Gains) -> bool:
    """Whether a record is of gains near some; the setpoint filter is not the loop's."""
    return record.gains is not None and are_near(record.gains, gains)


def are_near(one: Gains, other: Gains) -> bool:
    """Whether gains are near others."""
    a, b = np.array(one.as_tuple()[:3]), np.array(other.as_tuple()[:3])
    both = (a > 0.0) & (b > 0.0)
    return float(np.abs(np.log(a[both] / b[both])).max(initial=0.0)) < NEAR
