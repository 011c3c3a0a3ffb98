"""Whether records are of the plant that a loop was identified with.

With the plant held, the sizes of load and noise that suit a record are found: another load is no
change of the plant. The slopes of its prediction errors along the plant's parameters, less what
the noise explains, then give the score of another plant and its information. Both add up over
records, each weighed by its own load, and so does what they show of a change too small for one of
them. With scores s, S and information m, M of the new records and of those known before, without
a change

    d = s - m (m + M)^-1 (s + S)     has the covariance     m - m (m + M)^-1 m

and its chi-squared statistic is tested along all parameters and, as one number is told from chance
with less than half of what five need, along the gain alone.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.friction_motion import friction_of, less_friction
from estune.loop_model.least_squares import Solution
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.records import LoopRecord

LOADS = (-14.0, 8.0)
"""Range of the logarithm of the size of the load against the white noise."""

APART = 1e-10
"""Least information along a direction, over the largest: below it is rounding."""


class PlantEvidence(NamedTuple):
    """What a record shows of another plant than the identified one.

    Attributes:
        score: Slopes of the log likelihood along the plant's parameters, shape (parameters,).
        information: Its covariance without a change, shape (parameters, parameters).
    """

    score: FloatArray
    information: FloatArray


def evidence(fit: LoopFit, record: LoopRecord) -> PlantEvidence:
    """What a record shows of another plant than that of a fit."""
    from scipy.optimize import minimize_scalar  # noqa: PLC0415  slow to import

    model = fit.model
    signals = fit.signals([record])
    signals = less_friction(signals, friction_of(model, signals, record))

    def at(log_load: float) -> Solution:
        noise = fit.noise._replace(load=math.exp(log_load))
        return fit._replace(noise=noise).solution(signals)

    found = minimize_scalar(
        lambda k: at(k).squares, bounds=LOADS, method="bounded", options={"xatol": 0.1}
    )
    here = at(float(found.x))
    slopes, plant = here.slopes(signals), model.order + len(model.numerator)
    noise = np.linalg.qr(slopes[:, plant:])[0]
    slopes = slopes[:, :plant] - noise @ (noise.T @ slopes[:, :plant])
    variance = here.squares / here.residual.size
    return PlantEvidence(slopes.T @ here.residual / variance, slopes.T @ slopes / variance)


def chance(fit: LoopFit, known: Sequence[PlantEvidence], new: Sequence[PlantEvidence]) -> float:
    """Probability that records differ as much from those known before, without a change."""
    from scipy.special import chdtrc  # noqa: PLC0415  slow to import

    before, now = _sum(known), _sum(new)
    total = before.information + now.information
    scale = np.sqrt(np.maximum(np.diag(total), 1e-300))
    values, vectors = np.linalg.eigh(total / np.outer(scale, scale))
    kept = values > APART * values[-1]
    whitened = vectors[:, kept] / np.sqrt(values[kept]) / scale[:, np.newaxis]
    m = whitened.T @ now.information @ whitened  # M + m is one
    difference = whitened.T @ now.score - m @ whitened.T @ (before.score + now.score)
    spread = m - m @ m
    shares, axes = np.linalg.eigh(spread)
    kept = shares > APART
    every = np.sum((axes[:, kept].T @ difference) ** 2 / shares[kept])
    model = fit.model
    gain = np.linalg.pinv(whitened) @ np.array([*np.zeros(model.order), *model.numerator])
    alone = float(gain @ difference) ** 2 / max(float(gain @ spread @ gain), 1e-300)
    tested = chdtrc(int(kept.sum()), float(every)), chdtrc(1, alone)
    return min(1.0, len(tested) * float(min(tested)))


def _sum(shown: Sequence[PlantEvidence]) -> PlantEvidence:
    return PlantEvidence(*(np.sum(parts, axis=0) for parts in zip(*shown, strict=True)))
