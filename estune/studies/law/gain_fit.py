"""Fit of one gain over length and tension: its points, the selected form, its uncertainty."""

from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from estune.core.comparison import interval_factor
from estune.core.quantities import FloatArray
from estune.core.schedule import GainCurve
from estune.reel.calibration.regression import LackOfFit
from estune.studies.law.model_selection import (
    CurveForm,
    Points,
    Score,
    cross_validate,
    select_form,
)
from estune.studies.law.robust_regression import WeightedFit
from estune.studies.law.tuned import TunedColumns
from estune.support.lazy_sequence import LazySequence

_OUTLIER = 0.1
"""Robust weight below which a tuning is reported as an outlier: 5 standard deviations."""


class Slope(NamedTuple):
    """A slope of the straight line, and half the width of its 95 % interval."""

    value: float
    half_width: float

    @property
    def is_significant(self) -> bool:
        """Whether zero lies outside the interval."""
        return abs(self.value) > self.half_width


@dataclass(frozen=True, slots=True, eq=False)
class GainFit:
    """The fit of one gain over length and tension.

    Attributes:
        slope: Slope b of the straight line a + b L, in the gain's unit per m.
        tension_effect: Slope c in tension, in the gain's unit per N, of the line a + b L + c T;
            None where tension was not varied.
        scores: Cross-validation scores; empty with fewer than three lengths.
        R2: Share of the gains' weighted variance that the form explains.
        lack_of_fit: The test of the form against repeats; None without repeats, or without more
            places than coefficients.
    """

    name: str
    points: Points
    labels: Sequence[str]
    form: CurveForm
    fit: WeightedFit
    curve: GainCurve
    slope: Slope
    tension_effect: Slope | None
    scores: tuple[Score, ...]
    R2: float
    lack_of_fit: LackOfFit | None

    @property
    def mean(self) -> float:
        """Mean of the gains, with the weights of the fit."""
        return float(np.average(self.points.gain, weights=self.fit.weights))

    @property
    def outliers(self) -> tuple[str, ...]:
        """Labels of the tunings that the fit down-weights to almost nothing."""
        return tuple(
            self.labels[n] for n in np.flatnonzero(self.fit.robustness < _OUTLIER).tolist()
        )

    def to_json(self) -> dict[str, Any]:
        """The fit's figures as JSON values."""
        lack, tension = self.lack_of_fit, self.tension_effect
        return {
            "form": str(self.form),
            "curve": str(self.curve),
            "R2": self.R2,
            "scatter": self.fit.between_sd,
            "slope_per_m": self.slope._asdict(),
            "slope_per_N": None if tension is None else tension._asdict(),
            "lack_of_fit_p": None if lack is None else lack.p_value,
            "outliers": list(self.outliers),
            "scores": {str(s.form): {"mean": s.mean, "error": s.error} for s in self.scores},
        }


def fit_gain(
    name: str,
    index: int,
    tunings: TunedColumns,
    labels: LazySequence[str],
    form: CurveForm | None,
) -> GainFit:
    """Fits one gain, in a given form or in the one selected by cross-validation."""
    points, labels = _points(index, tunings, labels)
    varies = points.tension_varies
    line = CurveForm("linear", varies)
    straight = points.fit(line)
    slope, tension_effect = _slope(straight, 1), _slope(straight, 2) if varies else None
    scores = cross_validate(points, straight)
    if form is None:
        # A curve is considered only where the straight line has a significant slope.
        form = select_form(
            points, scores, straight,
            length_matters=slope.is_significant,
            tension_matters=tension_effect is not None and tension_effect.is_significant,
        )  # fmt: skip
    fit = straight if form == line else points.fit(form)
    offset, *others = fit.coefficients.tolist()
    curve = GainCurve(
        form.over_length,
        offset,
        slope=others.pop(0) if form.over_length != "constant" else 0.0,
        per_newton=others.pop() if form.with_tension else 0.0,
    )
    return GainFit(
        *(name, points, labels, form, fit, curve, slope, tension_effect, scores),
        R2=_explained(points.gain, fit),
        lack_of_fit=_lack_of_fit(points, fit),
    )


def _points(
    index: int, tunings: TunedColumns, labels: LazySequence[str]
) -> tuple[Points, LazySequence[str]]:
    """The points of one gain, and their labels; without tunings that do not determine it."""
    length, tension = tunings.length_m, tunings.tension_N
    gain, log_error = tunings.gains[:, index], tunings.log_errors[:, index]
    used = ~np.isinf(log_error)
    if used.sum() < 4 or np.ptp(length[used]) == 0.0:
        used[:] = True
    known = np.isfinite(log_error)
    # The median of the known errors stands in for an unknown one.
    typical = float(np.median(log_error[known])) if known.any() else 0.0
    # d g = g d ln g, at the mean of all g: with the gain itself as the factor, small gains would
    # have larger weights and bias the line.
    own = gain.mean() * np.where(known, log_error, typical)
    if used.all():
        return Points(length, tension, gain, own), labels
    points = Points(length[used], tension[used], gain[used], own[used])
    return points, LazySequence(array("q", np.flatnonzero(used)), labels.__getitem__)


def _slope(fit: WeightedFit, column: int) -> Slope:
    error = float(np.sqrt(fit.covariance[column, column]))
    return Slope(float(fit.coefficients[column]), interval_factor(fit.degrees) * error)


def _explained(gain: FloatArray, fit: WeightedFit) -> float:
    """R2 with the weights of the fit; one for gains without any variance."""
    mean = np.average(gain, weights=fit.weights)
    total = float(fit.weights @ (gain - mean) ** 2)
    residual = float(fit.weights @ fit.residuals**2)
    return 1.0 - residual / total if total > residual else float(total == residual == 0.0)


def _lack_of_fit(points: Points, fit: WeightedFit) -> LackOfFit | None:
    """The F test with the weights of the fit: repeats are tunings at one length and tension."""
    places = np.stack([points.length_m, points.tension_N], axis=1)
    _, group = np.unique(places, axis=0, return_inverse=True)
    group, weights = group.ravel(), fit.weights
    total = np.bincount(group, weights=weights)
    if not (total > 0.0).all():  # a place whose every tuning is an outlier
        return None
    mean = np.bincount(group, weights=weights * points.gain) / total
    pure = float(weights @ (points.gain - mean[group]) ** 2)
    lacking, repeats = len(total) - len(fit.coefficients), len(group) - len(total)
    if repeats < 1 or lacking < 1 or pure <= 0.0:
        return None
    from scipy.special import fdtrc  # noqa: PLC0415  slow to load

    F = max(float(weights @ fit.residuals**2) - pure, 0.0) / lacking / (pure / repeats)
    return LackOfFit(
        F=F,
        p_value=float(fdtrc(lacking, repeats, F)),
        pure_error=float(np.sqrt(pure / repeats / weights.mean())),
        degrees=(lacking, repeats),
    )
