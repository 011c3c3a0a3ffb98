"""One gain over length and tension: its points, the form chosen, and how far to trust it."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.core.schedule import GainCurve
from estune.reel.calibration.regression import LackOfFit
from estune.studies.law.model_selection import CurveForm, Points, Score, choose, scores
from estune.studies.law.robust_regression import WeightedFit, student
from estune.studies.law.tuned import TunedGains

LEVEL = 0.95
"""Of the intervals in words and figures."""

_OUTLIER = 0.1
"""Robust weight below which a tuning is named as an outlier: 5 standard deviations or more."""


class Slope(NamedTuple):
    """A slope of the straight line, and half the width of its 95 % interval."""

    value: float
    half_width: float

    @property
    def differs(self) -> bool:
        """Whether zero lies outside the interval."""
        return abs(self.value) > self.half_width


@dataclass(frozen=True, slots=True, eq=False)
class GainFit:
    """How one gain goes with length and tension.

    Attributes:
        name: Which gain, of `GAIN_NAMES`.
        points: The tunings it was fitted to.
        labels: What they are called, in the same order.
        shape: The form chosen.
        fit: Its fit.
        curve: The same as a curve.
        straight: The straight line a + b L, with + c T where tension was varied.
        scores: How the candidates foretold lengths left out; empty with fewer than three lengths.
        R2: Share of the gains' weighted scatter about their mean that the chosen form explains.
        lack_of_fit: Whether the form misses the means of repeats by more than their scatter
            explains; None where nothing was repeated, or no points are left to tell.
    """

    name: str
    points: Points
    labels: tuple[str, ...]
    shape: CurveForm
    fit: WeightedFit
    curve: GainCurve
    straight: WeightedFit
    scores: tuple[Score, ...]
    R2: float
    lack_of_fit: LackOfFit | None

    @property
    def slope(self) -> Slope:
        """Slope b of the straight line, in the gain's unit per m."""
        return _slope(self.straight, 1)

    @property
    def tension_effect(self) -> Slope | None:
        """Slope c in tension, in the gain's unit per N; None where tension was not varied."""
        return _slope(self.straight, 2) if self.points.tension_varies else None

    @property
    def mean(self) -> float:
        """Mean of the gains, weighted as the fit weighs them."""
        return float(np.average(self.points.gain, weights=self.fit.weights))

    @property
    def outliers(self) -> tuple[str, ...]:
        """Labels of the tunings that the fit all but leaves out."""
        return tuple(
            label
            for label, weight in zip(self.labels, self.fit.robustness, strict=True)
            if weight < _OUTLIER
        )

    def to_json(self) -> dict[str, Any]:
        """The fit's figures as JSON values."""
        lack, tension = self.lack_of_fit, self.tension_effect
        return {
            "form": str(self.shape),
            "curve": str(self.curve),
            "R2": self.R2,
            "scatter": self.fit.scatter,
            "slope_per_m": self.slope._asdict(),
            "slope_per_N": None if tension is None else tension._asdict(),
            "lack_of_fit_p": None if lack is None else lack.p_value,
            "outliers": list(self.outliers),
            "scores": {str(s.shape): {"mean": s.mean, "error": s.error} for s in self.scores},
        }


def fit_gain(
    name: str, n: int, tunings: tuple[TunedGains, ...], asked: CurveForm | None
) -> GainFit:
    """Fits the nth gain in the form asked for, or in the one that foretells best."""
    points, labels = _points(name, n, tunings)
    straight = points.fit(CurveForm("linear", points.tension_varies))
    judged = scores(points, straight)
    shape = asked
    if shape is None:
        # What the straight line does not show beyond doubt is not looked for in a bent one.
        slopes = _slope(straight, 1).differs
        pulled = points.tension_varies and _slope(straight, 2).differs
        shape = choose(points, judged, straight, slopes=slopes, pulled=pulled)
    fit = points.fit(shape)
    offset, *others = fit.coefficients.tolist()
    curve = GainCurve(
        shape.form,
        offset,
        slope=others.pop(0) if shape.form != "constant" else 0.0,
        per_newton=others.pop() if shape.with_tension else 0.0,
    )
    return GainFit(
        *(name, points, labels, shape, fit, curve, straight, judged),
        R2=_explained(points.gain, fit),
        lack_of_fit=_lack_of_fit(points, fit),
    )


def _points(name: str, n: int, tunings: tuple[TunedGains, ...]) -> tuple[Points, tuple[str, ...]]:
    """One gain's points. A tuning that cannot tell this gain at all has no say in it."""
    told = np.array([np.nan if t.log_errors is None else t.log_errors[n] for t in tunings])
    gain = np.array([getattr(t.gains, name) for t in tunings])
    length = np.array([t.length_m for t in tunings])
    tension = np.array([t.tension_N for t in tunings])
    kept = ~np.isinf(told)
    if kept.sum() < 4 or np.ptp(length[kept]) == 0.0:
        kept[:] = True
    known = np.isfinite(told)
    # An error that is not told is taken for as large as those that are.
    typical = float(np.median(told[known])) if known.any() else 0.0
    # d g = g d ln g, at the mean of all g: weights that went with each gain itself would draw the
    # line to those that came out small, and along the range to where the gain is small.
    own = gain.mean() * np.where(known, told, typical)
    points = Points(length[kept], tension[kept], gain[kept], own[kept])
    return points, tuple(t.label for t, k in zip(tunings, kept, strict=True) if k)


def _slope(fit: WeightedFit, place: int) -> Slope:
    error = float(np.sqrt(fit.covariance[place, place]))
    return Slope(float(fit.coefficients[place]), student(LEVEL, fit.degrees) * error)


def _explained(gain: FloatArray, fit: WeightedFit) -> float:
    """R2 with the weights of the fit; one where there is nothing to explain."""
    mean = np.average(gain, weights=fit.weights)
    about = float(fit.weights @ (gain - mean) ** 2)
    left = float(fit.weights @ fit.residuals**2)
    return 1.0 - left / about if about > left else float(about == left == 0.0)


def _lack_of_fit(points: Points, fit: WeightedFit) -> LackOfFit | None:
    """The F test with the weights of the fit: repeats are tunings at one length and tension."""
    places = np.stack([points.length_m, points.tension_N], axis=1)
    _, group = np.unique(places, axis=0, return_inverse=True)
    group, weights = group.ravel(), fit.weights
    total = np.bincount(group, weights=weights)
    if not (total > 0.0).all():  # a place whose every tuning is an outlier
        return None
    mean = np.bincount(group, weights=weights * points.gain) / total
    scatter = float(weights @ (points.gain - mean[group]) ** 2)
    misses, repeats = len(total) - len(fit.coefficients), len(group) - len(total)
    if repeats < 1 or misses < 1 or scatter <= 0.0:
        return None
    from scipy.special import fdtrc  # noqa: PLC0415  slow to load

    F = max(float(weights @ fit.residuals**2) - scatter, 0.0) / misses / (scatter / repeats)
    return LackOfFit(
        F=F,
        p_value=float(fdtrc(misses, repeats, F)),
        pure_error=float(np.sqrt(scatter / repeats / weights.mean())),
        degrees=(misses, repeats),
    )
