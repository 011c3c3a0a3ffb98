"""A loop that is watched record by record: its margins, and whether the plant has changed.

Whether a record is of the plant known so far is tested by the score: with the plant held, the
sizes of load and noise that suit the record are found, and the slopes of its prediction errors
along the plant's parameters, less what the noise explains, should carry no more of the errors than
chance does. Another load is no change of the plant. A change is told by two records in a row: one
may be disturbed.
"""

import math
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.loop_model.fitting import fit_loop
from estune.loop_model.intervals import PredictedMargins
from estune.loop_model.least_squares import Solution, signals_of
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.noise_model import NoiseModel
from estune.loop_model.plant_error import plant_error
from estune.loop_model.prediction import StepTrial
from estune.loop_model.records import LoopRecord
from estune.service_records.identification import ServiceLoop
from estune.service_records.judgement import Judgement, judge, margins_of

KEPT = 6
"""Newest records that the loop is identified from."""

FALSE_ALARM = 1e-4
"""Probability that a record without a change is taken for one of another plant. Two in a row are
1e-8: once in two centuries of a record a minute."""

LOADS = (-14.0, 8.0)
"""Range of the logarithm of the size of the load against the white noise."""


class WatchedLoop(NamedTuple):
    """What is known of a loop.

    Attributes:
        records: The newest records of the present plant, at most `KEPT`.
        fit: The loop identified from them; None before the first.
        suspect: A record of another plant, unless the next contradicts it.
    """

    records: tuple[LoopRecord, ...] = ()
    fit: LoopFit | None = None
    suspect: LoopRecord | None = None


class WatchedMargins(NamedTuple):
    """What the records of a watched loop show.

    Attributes:
        loop: The identified loop.
        margins: Of the gains in use.
        judgement: Whether they are known.
    """

    loop: ServiceLoop
    margins: PredictedMargins
    judgement: Judgement


def observe(
    known: WatchedLoop, record: LoopRecord, sampling_Hz: float, settling_time_s: float
) -> tuple[WatchedLoop, bool]:
    """A loop with one record more, and whether its plant has changed."""
    if known.fit is not None and has_changed(known.fit, len(known.records), record):
        if known.suspect is None:
            return known._replace(suspect=record), False
        changed = known.suspect, record
        return WatchedLoop(changed, fit_loop(changed, sampling_Hz, settling_time_s)), True
    records = (*known.records, record)[-KEPT:]
    fit = fit_loop(records, sampling_Hz, settling_time_s, known.fit)
    return WatchedLoop(records, fit), False


def judged_margins(
    known: WatchedLoop, trial: StepTrial, gains: Gains, settings: ControllerSettings
) -> WatchedMargins:
    """The margins of a watched loop with some gains.

    Args:
        known: A loop with at least one record.
        trial: The step that cost and overshoot are predicted for.
        gains: The gains.
        settings: The fixed part of the controller.
    """
    assert known.fit is not None  # noqa: S101  it has a record
    error = plant_error(known.fit, known.records)
    loop = ServiceLoop(known.fit, known.records, settings, error)
    margins, margin = margins_of(loop, trial, gains)
    return WatchedMargins(loop, margins, judge(loop, gains, margins, margin))


def has_changed(fit: LoopFit, records: int, record: LoopRecord) -> bool:
    """Whether a record is of another plant than a fit to so many records."""
    from scipy.special import chdtri  # noqa: PLC0415  slow to import

    statistic, count = score(fit, record)
    spread = 1.0 + 1.0 / records  # the fit is uncertain, too
    return statistic > spread * float(chdtri(count, FALSE_ALARM))


def score(fit: LoopFit, record: LoopRecord) -> tuple[float, int]:
    """Score of another plant: chi-squared with so many degrees of freedom, without a change."""
    from scipy.optimize import minimize_scalar  # noqa: PLC0415  slow to import

    model = fit.model
    signals = signals_of([record], fit.settling_samples, model.dead_samples)
    x, numerator = np.array(model.coordinates), np.array(model.numerator)

    def at(log_load: float) -> Solution:
        noise = NoiseModel(math.exp(log_load), fit.noise.drift)
        return Solution.at(signals, x, model.dead_samples, noise, numerator)

    found = minimize_scalar(
        lambda k: at(k).squares, bounds=LOADS, method="bounded", options={"xatol": 0.1}
    )
    here = at(float(found.x))
    slopes, plant = here.slopes(signals), model.order + numerator.size
    noise = np.linalg.qr(slopes[:, plant:])[0]
    errors = here.residual - noise @ (noise.T @ here.residual)
    slopes = slopes[:, :plant] - noise @ (noise.T @ slopes[:, :plant])
    left, sizes, _ = np.linalg.svd(
        slopes / np.maximum(np.linalg.norm(slopes, axis=0), 1e-300), full_matrices=False
    )
    basis = left[:, sizes > 1e-6 * sizes[0]]
    explained = float(np.sum((basis.T @ errors) ** 2))
    remaining = max(float(errors @ errors) - explained, 1e-300)
    return explained * (errors.size - basis.shape[1]) / remaining, basis.shape[1]
