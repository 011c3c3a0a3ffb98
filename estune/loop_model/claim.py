"""Margins that the records of a run allow to be claimed, or the reason why none are.

A linear model fits timid trials whatever the plant is, and then predicts margins that do not hold.
The misfit rho of trials at the gains in question shows it.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.loop_model.identification import LoopFit
from estune.loop_model.prediction import (
    PredictedMargins,
    StepTrial,
    predict,
    predict_with_intervals,
)

MISFIT_MAX = 0.005
"""Misfit up to which margins are claimed, as a share of the step."""

TRIALS_MIN = 4
"""Trials at or near the gains in question that a claim needs."""

COST_ERROR = 0.02
"""Error of a predicted cost that is always allowed: on the emulated reel the costs of trials up
to 3.3 logarithms away were predicted to 1.2 %, where the cost itself scatters by 1.5 %."""

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


class CostCheck(NamedTuple):
    """Repeats of the gains in question, and what was known before the first of them.

    Attributes:
        fit: The loop identified from the earlier records.
        costs: Costs of the repeats.
    """

    fit: LoopFit
    costs: tuple[float, ...]

    def fault(self, trial: StepTrial, gains: Gains) -> str:
        """A sentence on a mean cost outside the prediction's interval; empty where it agrees.

        Three standard errors of the mean and `COST_ERROR` are allowed beside the interval.
        """
        costs = np.array(self.costs)
        cost = float(costs.mean())
        predicted = predict_with_intervals(self.fit, trial, gains).cost
        if not math.isfinite(predicted.value):
            return f"they cost {cost:.3g} where the trials before foretold an unstable loop"
        scatter = float(costs.std(ddof=1)) / math.sqrt(costs.size) if costs.size > 1 else 0.0
        allowed = 3.0 * scatter + COST_ERROR * cost
        if predicted.low - allowed <= cost <= predicted.high + allowed:
            return ""
        return (
            f"these gains cost {cost:.3g} where the trials before foretold {predicted.low:.3g} to "
            f"{predicted.high:.3g}"
        )


def claim(
    fit: LoopFit,
    trial: StepTrial,
    gains: Gains,
    tried: Sequence[Gains],
    check: CostCheck | None = None,
) -> Claim:
    """The claims that the fit allows about the loop with these gains.

    Args:
        fit: The identified loop.
        trial: The step trial.
        gains: The gains in question.
        tried: Gains of the records that were fitted, in their order.
        check: The cost of these gains as predicted before they ran; None without a prediction.
    """
    pairs = zip(fit.misfits, tried, strict=True)
    near = [rho for rho, other in pairs if _distance(gains, other) < NEAR]
    misfit = float(np.sqrt(np.mean(np.square(near)))) if near else float("nan")
    if len(near) < TRIALS_MIN:
        return Claim(
            None, f"{len(near)} trials near these gains where {TRIALS_MIN} are needed", misfit
        )
    if not misfit <= MISFIT_MAX:
        return Claim(None, unexplained(misfit), misfit)
    if not fit.responds:
        return Claim(None, "the measurement does not follow the effort within a trial", misfit)
    fault = check.fault(trial, gains) if check and check.costs else ""
    if fault:
        return Claim(None, fault, misfit)
    if not math.isfinite(predict(fit.model, trial, gains).cost):
        return Claim(None, "the identified loop is unstable with these gains", misfit)
    return Claim(predict_with_intervals(fit, trial, gains), "", misfit)


def unexplained(misfit: float) -> str:
    """A sentence on a misfit that allows no claim."""
    return (
        f"a linear model leaves {misfit:.1%} of the step unexplained, more than {MISFIT_MAX:.1%}; "
        "find what is missing with estune explain"
    )


def _distance(one: Gains, other: Gains) -> float:
    """Largest difference in the logarithm of a gain that is above zero in both."""
    a, b = _logarithms(one), _logarithms(other)
    both = np.isfinite(a) & np.isfinite(b)
    return float(np.abs(a[both] - b[both]).max(initial=0.0))


def _logarithms(gains: Gains) -> FloatArray:
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(gains.as_tuple()))
