"""Drawn models that the records do not contradict.

A covariance is the likelihood's curvature at its top. Along a direction that the records hardly
tell, as a pole faster than the sampling, it allows steps beyond the reach of any curvature, and
some of these loops are unstable, though the records refuse them outright. So a draw whose own
prediction errors contradict the records is halved until they do not. Of four single runs of a
heated chamber (Ms 1.35 to 1.40, pooled with others 1.31 to 1.37) the plain draws allow unstable
loops in three; those that are left in two of these give Ms to 5 %.
"""

from collections.abc import Sequence

import numpy as np

from estune.loop_model.drawn_models import (
    INFLATION,
    clustered_factor,
    drawn_models,
    white_factor,
)
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.model import LoopModel
from estune.loop_model.records import LoopRecord

DRAWS = 48
"""Models drawn by each covariance."""

HALVINGS = 12
"""Halvings of a draw at most; then it is the fit itself."""

CHANCE = 0.05
"""Probability that a model as far from the best as allowed is the true one, before inflation."""

Draws = tuple[tuple[LoopModel, ...], ...]
"""Models drawn by the white and by the between-record covariance."""


def plain_draws(fit: LoopFit) -> Draws:
    """The models that the covariances of a fit allow."""
    factors = white_factor(fit), clustered_factor(fit)
    return tuple(drawn_models(fit, factor, DRAWS, seed=0) for factor in factors)


def allowed_draws(fit: LoopFit, records: Sequence[LoopRecord], draws: Draws) -> Draws:
    """Draws of a fit without friction, each halved until the records do not contradict it."""
    from scipy.special import chdtri  # noqa: PLC0415  slow to import

    model = fit.model
    signals = fit.signals(fit.fitted(records))

    def squares(one: LoopModel) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            return fit._replace(model=one).solution(signals).squares

    further = float(chdtri(model.parameters.size, CHANCE)) * INFLATION**2
    most = squares(model) * (1.0 + further / signals.samples)

    def allowed(one: LoopModel) -> LoopModel:
        for _ in range(HALVINGS):
            if squares(one) <= most:
                return one
            one = _half_way(model, one)
        return model

    return tuple(tuple(allowed(one) for one in drawn) for drawn in draws)


def _half_way(one: LoopModel, other: LoopModel) -> LoopModel:
    pairs = (
        (one.coordinates, other.coordinates),
        (one.numerator, other.numerator),
    )
    coordinates, numerator = (
        tuple((0.5 * (np.array(a) + np.array(b))).tolist()) for a, b in pairs
    )
    return other._replace(coordinates=coordinates, numerator=numerator)
