"""Margins that the records of a run allow to be claimed, or the reason why none are.

A linear model fits timid trials whatever the plant is, and then predicts margins that do not hold:
so trials at the gains in question are needed. Nothing is claimed of a loop in a band that the
records do not excite, or in which they do not follow the model (`plant_error`).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.loop_model.agreement import contradicting_sensitivities
from estune.loop_model.intervals import (
    PredictedMargins,
    margins_by_records,
)
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.near_fit import TRIALS_MIN, is_near
from estune.loop_model.peak import load_deviation, shown_overshoot
from estune.loop_model.plant_error import ErrorMargin, error_margin, plant_error, unknown_band
from estune.loop_model.prediction import StepTrial, predict
from estune.loop_model.records import LoopRecord


class Claim(NamedTuple):
    """Margins of a loop, or why none are claimed.

    Attributes:
        margins: Predictions with their intervals; None where nothing is claimed.
        reason: Why nothing is claimed; empty where something is.
        misfit: rho of the trials near the gains; NaN without one.
        is_white: Whether the model explains the records but for white noise.
        others: Ms by the trials of each gains that contradict the model.
        load: Standard deviation of a measurement by load and drift, as a share of the step; zero
            where none are known.
    """

    margins: PredictedMargins | None
    reason: str
    misfit: float
    is_white: bool = False
    others: tuple[float, ...] = ()
    load: float = 0.0


def claim(
    fit: LoopFit,
    records: Sequence[LoopRecord],
    trial: StepTrial,
    gains: Gains,
) -> Claim:
    """The claims that the fit allows about the loop with these gains.

    The interval of Ms contains what the error of the plant may add to it, and Ms by the trials of
    each gains that contradict the fit (`agreement`).
    """
    near = near_trials(fit, records, gains)
    misfit = float(np.sqrt(np.mean(np.square(near)))) if near else float("nan")
    settings = trial.controller
    if len(near) < TRIALS_MIN:
        reason = f"{len(near)} trials near these gains where {TRIALS_MIN} are needed"
    elif not fit.responds:
        reason = "the measurement does not follow the effort within a trial"
    elif not math.isfinite(predict(fit.model, trial, gains).cost):
        what = "the identified loop is unstable with these gains"
        reason = what if fit.is_white else f"{what}; {unexplained(fit.misfit)}"
    else:
        margin = error_margin(fit, plant_error(fit, records), gains, settings)
        reason = _unknown(fit, margin, settings.sampling_Hz)
        if not reason:
            others = contradicting_sensitivities(fit, records, gains, settings)
            margins = _widened(margins_by_records(fit, records, trial, gains), margin, others)
            overshoot = shown_overshoot(fit, records, trial, gains, margins.overshoot)
            margins = margins._replace(overshoot=overshoot)
            if math.isfinite(margins.sensitivity.high):
                load = load_deviation(fit, trial, gains)
                return Claim(margins, "", misfit, fit.is_white, others, load)
            reason = "the records leave open whether the loop is stable with these gains"
            if math.inf in others:
                reason = (
                    f"no one model explains the trials of all gains: {unexplained(fit.misfit)}"
                )
    return Claim(None, reason, misfit)


def near_trials(fit: LoopFit, records: Sequence[LoopRecord], gains: Gains) -> list[float]:
    """The misfit of each of the trials at or near some gains that were fitted."""
    fitted = zip(fit.fitted(fit.misfits), fit.fitted(records), strict=True)
    return [rho for rho, record in fitted if is_near(record, gains)]


def _unknown(fit: LoopFit, margin: ErrorMargin, sampling_Hz: float) -> str:
    """A sentence on the band in which the loop is not known; empty without one."""
    if margin.unknown is None:
        return ""
    band = unknown_band(margin.unknown, sampling_Hz)
    if margin.excited:
        return f"the loop is not known {band}: {unexplained(fit.misfit)}"
    return f"nothing is known {band}: the records do not excite it"


def _widened(
    margins: PredictedMargins, margin: ErrorMargin, others: Sequence[float]
) -> PredictedMargins:
    """The margins with an interval of Ms that holds other values, too."""
    Ms = margins.sensitivity
    low, high = min((Ms.low, *others)), max(Ms.high, margin.sensitivity, *others)
    return margins._replace(sensitivity=Ms._replace(low=low, high=high))


def unexplained(misfit: float) -> str:
    """A sentence on what a model leaves of the records."""
    return (
        f"the model leaves {misfit:.1%} of the step unexplained beyond the noise; find what is "
        "missing with estune explain"
    )
