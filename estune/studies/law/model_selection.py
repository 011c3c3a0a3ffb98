"""Model selection for a gain's curve over length, by cross-validation over lengths.

Each length is left out in turn, each candidate is fitted to the others and predicts the gains
there. The score is the mean over lengths of the squared prediction error per variance. Of the
candidates within one standard error of the best score, the simplest is selected (Breiman et al.
1984), so that each additional coefficient must improve the prediction.
"""

from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.core.schedule import FORMS, Form, length_term
from estune.errors import InvalidInput
from estune.studies.law.robust_regression import WeightedFit, fit_weighted

LEAST_LENGTHS = 3
"""Least number of lengths; with one of two left out, no slope can be fitted."""

_ERROR_MAX = 4.0
"""Clip of a prediction error, in standard deviations: one outlier does not decide."""


class CurveForm(NamedTuple):
    """A curve over length, with or without a linear term in tension."""

    over_length: Form
    with_tension: bool = False

    @property
    def coefficients(self) -> int:
        """Number of coefficients."""
        return 1 + (self.over_length != "constant") + self.with_tension

    def design(self, length_m: FloatArray, tension_N: FloatArray) -> FloatArray:
        """The design matrix, shape (n, p): columns 1, f(L), T."""
        columns = [np.ones_like(length_m)]
        if self.over_length != "constant":
            columns.append(np.asarray(length_term(self.over_length, length_m)))
        if self.with_tension:
            columns.append(tension_N)
        return np.stack(columns, axis=-1)

    def __str__(self) -> str:
        return f"{self.over_length} + tension" if self.with_tension else self.over_length


CANDIDATES = tuple(CurveForm(form, tension) for tension in (False, True) for form in FORMS)
"""All forms, simplest first, and the straight line before the curved ones."""


def parse_form(name: str) -> CurveForm:
    """The form of a name such as "linear" or "log + tension".

    Raises:
        InvalidInput: there is none of that name.
    """
    forms = {str(form): form for form in CANDIDATES}
    if name not in forms:
        raise InvalidInput(f"there is no form {name!r}; the forms are {', '.join(forms)}")
    return forms[name]


class Points(NamedTuple):
    """The tunings of one gain, in arrays of shape (n,).

    Attributes:
        own_error: Standard error by the tuning itself; zero where unknown.
    """

    length_m: FloatArray
    tension_N: FloatArray
    gain: FloatArray
    own_error: FloatArray

    @property
    def tension_varies(self) -> bool:
        """Whether there is more than one tension."""
        return bool(np.ptp(self.tension_N) > 0.0)

    def fit(self, form: CurveForm) -> WeightedFit:
        """The robust fit of a form; as `fit_weighted`."""
        return fit_weighted(form.design(self.length_m, self.tension_N), self.gain, self.own_error)


class Score(NamedTuple):
    """Cross-validation score of one form.

    Attributes:
        mean: Mean over the lengths of the squared prediction error per variance; about one if the
            form is right.
        error: Standard error of that mean, from its differences between lengths.
    """

    form: CurveForm
    mean: float
    error: float


def cross_validate(points: Points, reference: WeightedFit) -> tuple[Score, ...]:
    """The score of each identifiable form, in the order of `CANDIDATES`.

    Args:
        points: The tunings; with fewer than `LEAST_LENGTHS` lengths there are no scores.
        reference: The fit whose weights and variances hold for all candidates.
    """
    lengths = np.unique(points.length_m)
    if len(lengths) < LEAST_LENGTHS:
        return ()
    scores = []
    for form in CANDIDATES:
        if form.with_tension and not points.tension_varies:
            continue
        if form.coefficients >= len(points.gain):
            continue
        design = form.design(points.length_m, points.tension_N)
        errors = [
            _prediction_error(design, points, reference, points.length_m == length)
            for length in lengths
        ]
        if all(np.isfinite(errors)):
            error = float(np.std(errors, ddof=1)) / len(errors) ** 0.5
            scores.append(Score(form, float(np.mean(errors)), error))
    return tuple(scores)


def select_form(
    points: Points,
    scores: tuple[Score, ...],
    reference: WeightedFit,
    *,
    length_matters: bool,
    tension_matters: bool,
) -> CurveForm:
    """The simplest form within one standard error of the best that is positive over the range.

    Args:
        scores: Scores of the candidates; without any, only a constant and a line are considered.
        reference: The fit they were validated with.
        length_matters: Whether the slope over length is significant; otherwise only constants are
            considered.
        tension_matters: Whether the slope over tension is significant.
    """
    if not scores:
        return CurveForm("linear" if length_matters else "constant")
    usable = [
        score
        for score in scores
        if (length_matters or score.form.over_length == "constant")
        and (tension_matters or not score.form.with_tension)
        and _stays_above_zero(points, score.form, reference)
    ]
    if not usable:
        return CurveForm("constant")
    best = min(usable, key=lambda score: score.mean)
    return next(s.form for s in usable if s.mean <= best.mean + best.error)


def _prediction_error(
    design: FloatArray, points: Points, reference: WeightedFit, left_out: FloatArray
) -> float:
    """Mean squared error per variance at the points left out; nan where not identifiable."""
    training = ~np.asarray(left_out, dtype=bool)
    root = np.sqrt(reference.weights[training])
    beta, _, rank, _ = np.linalg.lstsq(
        design[training] * root[:, None], points.gain[training] * root
    )
    if rank < design.shape[1]:
        return float("nan")
    u = (points.gain[~training] - design[~training] @ beta) / reference.deviations[~training]
    return float(np.mean(np.minimum(np.abs(u), _ERROR_MAX) ** 2))


def _stays_above_zero(points: Points, form: CurveForm, reference: WeightedFit) -> bool:
    """Whether the fitted curve, which is monotone, is positive at the corners of the range."""
    ends = [(float(x.min()), float(x.max())) for x in (points.length_m, points.tension_N)]
    length, tension = (corner.ravel() for corner in np.meshgrid(*ends))
    design = form.design(points.length_m, points.tension_N)
    root = np.sqrt(reference.weights)
    beta = np.linalg.lstsq(design * root[:, None], points.gain * root)[0]
    lowest = (form.design(length, tension) @ beta).min()
    return bool(lowest > 0.0 or (points.gain == 0.0).all())
