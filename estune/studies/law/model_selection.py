"""Which curve a gain follows: candidates judged on lengths they were not fitted on.

Each length is left out in turn, each candidate fitted to the others, and the gains tuned there
foretold; the score is the mean over lengths of the squared miss per variance. Of the candidates
within one standard error of the best score the simplest is taken (Breiman et al. 1984), so that a
curve has to earn each coefficient, and the paper's straight line each departure from it.
"""

from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.core.schedule import FORMS, Form, of_length
from estune.errors import InvalidInput
from estune.studies.law.robust_regression import WeightedFit, fit_weighted

LEAST_LENGTHS = 3
"""With fewer, leaving one out leaves no slope to be fitted."""

_MISS_MAX = 4.0
"""Standard deviations beyond which a miss counts no further: one wild tuning decides nothing."""


class CurveForm(NamedTuple):
    """A form in length, with or without a straight line in tension."""

    form: Form
    with_tension: bool = False

    @property
    def coefficients(self) -> int:
        """How many it has."""
        return 1 + (self.form != "constant") + self.with_tension

    def design(self, length_m: FloatArray, tension_N: FloatArray) -> FloatArray:
        """The regression's rows, shape (n, p): one, f(L), T."""
        columns = [np.ones_like(length_m)]
        if self.form != "constant":
            columns.append(np.asarray(of_length(self.form, length_m)))
        if self.with_tension:
            columns.append(tension_N)
        return np.stack(columns, axis=-1)

    def __str__(self) -> str:
        return f"{self.form} + tension" if self.with_tension else self.form


SHAPES = tuple(CurveForm(form, tension) for tension in (False, True) for form in FORMS)
"""All candidates, simplest first, and the straight line before the bent ones."""


def shape_named(name: str) -> CurveForm:
    """The shape of a name such as "linear" or "log + tension".

    Raises:
        InvalidInput: there is none of that name.
    """
    known = {str(shape): shape for shape in SHAPES}
    if name not in known:
        raise InvalidInput(f"there is no form {name!r}; the forms are {', '.join(known)}")
    return known[name]


class Points(NamedTuple):
    """The tunings of one gain.

    Attributes:
        length_m: Shape (n,).
        tension_N: Same shape.
        gain: What was found, same shape.
        own_error: Standard error of each by its own tuning, zero where unknown, same shape.
    """

    length_m: FloatArray
    tension_N: FloatArray
    gain: FloatArray
    own_error: FloatArray

    @property
    def tension_varies(self) -> bool:
        """Whether more than one tension was tuned at."""
        return bool(np.ptp(self.tension_N) > 0.0)

    def fit(self, shape: CurveForm) -> WeightedFit:
        """The robust fit of a shape; as `fit_weighted`."""
        return fit_weighted(shape.design(self.length_m, self.tension_N), self.gain, self.own_error)


class Score(NamedTuple):
    """How well a shape foretells lengths it was not fitted on.

    Attributes:
        shape: Which.
        mean: Mean over the lengths of the squared miss per variance; about one is as good as the
            points' own errors and scatter allow.
        error: Standard error of that mean, from its differences between lengths.
    """

    shape: CurveForm
    mean: float
    error: float


def candidates(points: Points) -> tuple[CurveForm, ...]:
    """The shapes that these points can tell apart."""
    lengths = len(np.unique(points.length_m))
    return tuple(
        shape
        for shape in SHAPES
        if (points.tension_varies or not shape.with_tension)
        and shape.coefficients < len(points.gain)
        and (lengths >= LEAST_LENGTHS or shape.form == "constant")
    )


def scores(points: Points, yardstick: WeightedFit) -> tuple[Score, ...]:
    """The score of each candidate, in the order of `SHAPES`; empty below `LEAST_LENGTHS`.

    Args:
        points: The tunings.
        yardstick: The fit whose variances and doubts all candidates are held to.
    """
    groups = np.unique(points.length_m)
    if len(groups) < LEAST_LENGTHS:
        return ()
    found = []
    for shape in candidates(points):
        design = shape.design(points.length_m, points.tension_N)
        misses = [_miss(design, points, yardstick, points.length_m == left) for left in groups]
        if all(np.isfinite(misses)):
            error = float(np.std(misses, ddof=1)) / len(misses) ** 0.5
            found.append(Score(shape, float(np.mean(misses)), error))
    return tuple(found)


def choose(
    points: Points,
    judged: tuple[Score, ...],
    yardstick: WeightedFit,
    *,
    slopes: bool,
    pulled: bool,
) -> CurveForm:
    """The simplest shape within one standard error of the best that stays usable in the range.

    Args:
        points: The tunings.
        judged: Scores of the candidates; with fewer than three lengths there are none, and a
            straight line is taken where there is one.
        yardstick: What they were judged by.
        slopes: Whether the gain goes with length at all; else only constants are usable.
        pulled: The same of tension.
    """
    if not judged:
        return CurveForm("linear" if slopes else "constant")
    usable = [
        score
        for score in judged
        if (slopes or score.shape.form == "constant")
        and (pulled or not score.shape.with_tension)
        and _stays_above_zero(points, score.shape, yardstick)
    ]
    if not usable:
        return CurveForm("constant")
    best = min(usable, key=lambda score: score.mean)
    return next(s.shape for s in usable if s.mean <= best.mean + best.error)


def _miss(design: FloatArray, points: Points, by: WeightedFit, left_out: FloatArray) -> float:
    """Mean squared miss per variance of what is left out; not a number where not foretold."""
    kept = ~np.asarray(left_out, dtype=bool)
    root = np.sqrt(by.weights[kept])
    beta, _, rank, _ = np.linalg.lstsq(design[kept] * root[:, None], points.gain[kept] * root)
    if rank < design.shape[1]:
        return float("nan")
    u = (points.gain[~kept] - design[~kept] @ beta) / by.deviations[~kept]
    return float(np.mean(np.minimum(np.abs(u), _MISS_MAX) ** 2))


def _stays_above_zero(points: Points, shape: CurveForm, by: WeightedFit) -> bool:
    """Whether the fitted curve is a gain over all of the range: monotone, so at its corners."""
    ends = [(float(x.min()), float(x.max())) for x in (points.length_m, points.tension_N)]
    length, tension = (corner.ravel() for corner in np.meshgrid(*ends))
    design, root = shape.design(points.length_m, points.tension_N), np.sqrt(by.weights)
    beta = np.linalg.lstsq(design * root[:, None], points.gain * root)[0]
    lowest = (shape.design(length, tension) @ beta).min()
    return bool(lowest > 0.0 or (points.gain == 0.0).all())
