"""Margins that the records of a run allow to be claimed, or the reason why none are.

A linear model fits timid trials whatever the plant is, and then predicts margins that do not hold.
The misfit rho of trials at the gains in question shows it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.loop_model.identification import LoopFit
from estune.loop_model.prediction import (
    Interval,
    PredictedMargins,
    StepTrial,
    predict_with_intervals,
)

MISFIT_MAX = 0.005
"""Misfit up to which margins are claimed, as a share of the step."""

TRIALS_MIN = 4
"""Trials at or near the gains in question that a claim needs."""

NEAR = 0.5
"""Distance in the logarithm of each gain up to which a trial counts as near."""


class Claim(NamedTuple):
    """Margins of a loop, or why none are claimed.

    Attributes:
        margins: Predictions with their intervals; None where nothing is claimed.
        reason: Why nothing is claimed; empty where something is.
        misfit: rho of the trials near the gains; NaN without one.
    """

    margins: PredictedMargins | None
    reason: str
    misfit: float


def claim(
    fit: LoopFit,
    trial: StepTrial,
    gains: Gains,
    tried: Sequence[Gains],
    last: tuple[Interval, float] | None = None,
) -> Claim:
    """What the fit allows to be claimed of the loop with these gains.

    Args:
        fit: The identified loop.
        trial: The step trial.
        gains: The gains in question.
        tried: Gains of the records that were fitted, in their order.
        last: Cost predicted of a recent trial before it ran, and measured; None where there is
            no prediction to compare with.
    """
    pairs = zip(fit.misfits, tried, strict=True)
    near = [rho for rho, other in pairs if _distance(gains, other) < NEAR]
    misfit = float(np.sqrt(np.mean(np.square(near)))) if near else float("nan")
    if len(near) < TRIALS_MIN:
        return Claim(
            None, f"{len(near)} trials near these gains where {TRIALS_MIN} are needed", misfit
        )
    if not misfit <= MISFIT_MAX:
        return Claim(
            None,
            f"a linear model leaves {misfit:.1%} of the step unexplained, more than "
            f"{MISFIT_MAX:.1%}; find what is missing with estune explain",
            misfit,
        )
    if last is not None and not last[0].low <= last[1] <= last[0].high:
        return Claim(
            None,
            f"the last trial cost {last[1]:.3g} where {last[0].low:.3g} to {last[0].high:.3g} was "
            "predicted",
            misfit,
        )
    return Claim(predict_with_intervals(fit, trial, gains), "", misfit)


def _distance(one: Gains, other: Gains) -> float:
    """Largest difference in the logarithm of a gain that is above zero in both."""
    a, b = _logarithms(one), _logarithms(other)
    both = np.isfinite(a) & np.isfinite(b)
    return float(np.abs(a - b)[both].max(initial=0.0))


def _logarithms(gains: Gains) -> FloatArray:
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(gains.as_tuple()))
