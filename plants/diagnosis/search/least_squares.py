"""Bounded least squares of whitened residuals, with what is known of values beforehand.

    T = J + (max(J - 1, 0) + J/n) sum ln(1 + z^2),    z = (x - x_0)/s

J is the mean square of the residuals, z the distance of a value from the model's in its prior
standard deviations, n the number of independent samples in a record. A value that is known costs
as much as it is moved only while the model leaves an error: where it leaves none, the records
decide, but for what n samples weigh. The logarithm is that of Cauchy's distribution, for what is
stated is now and then plainly wrong: a value far off is not held back more than one at z = 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.models.free_parameters import prior_deviation
from plants.diagnosis.prediction.prediction import Predictor

Numbers = NDArray[np.int64]
Point = tuple[FloatArray, FloatArray]
"""Values, and the residuals there."""


@dataclass(frozen=True, slots=True, eq=False)
class WhitenedFit:
    """A predictor with values, held against some entries.

    Attributes:
        moved: Numbers of the values that were free to move.
        converged: Whether a last round lowered hardly anything.
    """

    predictor: Predictor
    values: FloatArray
    entries: Numbers
    residuals: FloatArray
    moved: Numbers
    converged: bool

    @property
    def mean_square(self) -> float:
        """J: mean square of the whitened residuals; 1 is the floor."""
        return float(self.residuals @ self.residuals) / max(self.residuals.size, 1)

    @property
    def penalised(self) -> float:
        """T: the mean square with what the moves of known values cost."""
        cost = Coordinates.of(self.predictor, self.moved).cost(self.values)
        return self.mean_square + prior_weight(self.mean_square) * cost


def prior_weight(mean_square: float) -> float:
    """Weight of the distances from what is known, relative to a mean square of residuals."""
    return max(mean_square - 1.0, 0.0) + mean_square / CONSTANTS.effective


class Coordinates(NamedTuple):
    """The values that move as a search sees them, and what is known of them beforehand.

    Attributes:
        log: Which of them move by their logarithm.
        centre: Their logarithms or values in the model as given.
        precision: Inverse standard deviations, 0 where nothing is known.
    """

    moves: Numbers
    log: NDArray[np.bool_]
    low: FloatArray
    high: FloatArray
    centre: FloatArray
    precision: FloatArray

    @classmethod
    def of(cls, predictor: Predictor, moves: Numbers) -> "Coordinates":
        """The coordinates of some values of a predictor."""
        free = [predictor.free[n] for n in moves]
        log = np.array([f.scale == "log" for f in free], bool)
        low, high, start = np.array([(f.low, f.high, f.start) for f in free]).reshape(-1, 3).T
        precision = np.array([0.0 if f.prior is None else 1.0 / f.prior for f in free])
        return cls(moves, log, low, high, _coordinate(start, log), precision)

    def distances(self, values: FloatArray) -> FloatArray:
        """Distances z from what is known, shape (moves,), of values of shape (free,)."""
        z: FloatArray = (_coordinate(values[self.moves], self.log) - self.centre) * self.precision
        return z

    def cost(self, values: FloatArray) -> float:
        """The sum of ln(1 + z^2)."""
        return float(np.log1p(self.distances(values) ** 2).sum())

    def equations(self, values: FloatArray, weight: float) -> FloatArray:
        """Slope and residual of a least-squares term with the cost's gradient, (2, moves)."""
        z = self.distances(values)
        rows: FloatArray = np.sqrt(weight / (1.0 + z**2)) * np.array([self.precision, z])
        return rows

    def inner(self, values: FloatArray) -> FloatArray:
        """Derivative of the values by what is searched, dx/dz."""
        return np.where(self.log, values[self.moves], 1.0)

    @property
    def span(self) -> FloatArray:
        """Change of each searched coordinate that is large for it: e, or all of its range."""
        return np.where(self.log, 1.0, self.high - self.low)

    def bounded(self, values: FloatArray) -> FloatArray:
        """The values, those that move no further than their bounds."""
        bounded = values.copy()
        bounded[self.moves] = np.clip(values[self.moves], self.low, self.high)
        return bounded

    def unbounded(self, x: FloatArray, delta: FloatArray) -> FloatArray:
        """The values that move, after a change of the searched coordinates."""
        # A logarithm may not move further than e^3 at once.
        grown = x * np.exp(np.where(self.log, np.clip(delta, -3.0, 3.0), 0.0))
        after: FloatArray = np.where(self.log, grown, x + delta)
        return after

    def apart(self, x: FloatArray, after: FloatArray) -> FloatArray:
        """The change of the searched coordinates from some values that move to others."""
        # No ratio of the two: of values in another unit it may be beyond any float.
        grown = np.log(np.maximum(after, 1e-300)) - np.log(np.maximum(x, 1e-300))
        return np.where(self.log, grown, after - x)

    def beyond(self, begun: FloatArray, values: FloatArray, strides: float) -> FloatArray:
        """Extrapolation of the values beyond the last step by a factor."""
        x = values[self.moves]
        further = values.copy()
        further[self.moves] = self.unbounded(x, strides * self.apart(begun[self.moves], x))
        return self.bounded(further)


def _coordinate(values: FloatArray, log: NDArray[np.bool_]) -> FloatArray:
    return np.where(log, np.log(np.where(log, np.maximum(values, 1e-300), 1.0)), values)


def fit(
    predictor: Predictor,
    start: FloatArray,
    moves: Numbers,
    entries: Numbers,
    rounds: int = 15,
    *,
    tolerance: float = 1e-3,  # models are compared by tens of per cent
    informed: bool = True,
    over: FloatArray | None = None,
) -> WhitenedFit:
    """Lowers the sum of squares of some residuals: Levenberg-Marquardt within the bounds.

    Values on a log scale move by their logarithm. In every round several dampings are tried in
    one batch; the best is kept (Marquardt 1963; the bounds by fixing what would leave them).

    Args:
        predictor: Gives residuals and their derivative.
        start: Values to begin with, shape (free,).
        moves: Numbers of the values that may move.
        entries: Numbers of the residuals that count.
        rounds: Most rounds.
        tolerance: Share of the sum of squares that the last round lowers it by at most.
        informed: Whether what is known of values counts.
        over: Least steps of the differences that are the derivative, shape (moves,).
    """
    scale = Coordinates.of(predictor, moves)
    values, residuals, converged, weight = scale.bounded(start), None, False, 0.0

    def cost(values: FloatArray, residuals: FloatArray) -> float:
        return float(residuals @ residuals) + weight * scale.cost(values)

    def lowest(trials: Sequence[FloatArray], otherwise: Point) -> Point:
        tried = zip(trials, predictor.residuals(np.array(trials), entries), strict=True)
        best = min(tried, key=lambda point: cost(*point))
        return best if cost(*best) < cost(*otherwise) else otherwise

    for _ in range(rounds):
        residuals, jacobian = predictor.linearise(values, moves, entries, residuals, over)
        begun = values, residuals
        mean_square = float(residuals @ residuals) / max(residuals.size, 1)
        weight = residuals.size * prior_weight(mean_square) if informed else 0.0
        known = scale.equations(values, weight)
        columns = jacobian.T * scale.inner(values)[:, None]
        slope = _Slope.of(columns, residuals, scale, known)
        # As many as are predicted side by side; the fine ones are for narrow valleys.
        dampings = (0.0, 1e-4, 1e-3, 1e-2, 0.03, 0.1, 1.0, 30.0)
        reached = lowest([slope.step(values, d) for d in dampings], begun)
        converged = cost(*begun) - cost(*reached) < tolerance * cost(*begun)
        # A valley: further steps along it are tried.
        if not converged and cost(*reached) > 0.5 * cost(*begun):
            further = [scale.beyond(values, reached[0], n) for n in (1.0, 3.0)]
            reached = lowest(further, reached)
        values, residuals = reached
        if converged:
            break
    if residuals is None:
        residuals = predictor.residuals(values[None, :], entries)[0]
    return WhitenedFit(predictor, values, entries, residuals, moves, converged)


def smoothing_steps(fitted: WhitenedFit) -> FloatArray:
    """Differences over which residuals that jump have a slope, shape (moved,).

    Where a drive sticks, over a millionth of a value the residuals' jumps are their slope, and a
    fit ends where rounding sends it: of records multiplied by 1 + 1e-12 at a Stribeck velocity a
    third of its interval away, leaving 9 % more power. Over 0.3 standard errors, and 0.03 of the
    value at most, both are mended; 0.1, 0.5 and 1 standard errors agree less.
    """
    values = fitted.values[fitted.moved]
    free = [fitted.predictor.free[n] for n in fitted.moved]
    prior = np.array([prior_deviation(f, v) for f, v in zip(free, values.tolist(), strict=True)])
    widest = spread = 0.1 * prior
    for _ in range(2):
        _, jacobian = fitted.predictor.linearise(
            fitted.values, fitted.moved, fitted.entries, fitted.residuals, spread
        )
        columns = jacobian.T * prior[:, None]
        known = np.linalg.inv(columns @ columns.T + np.eye(values.size))
        error = prior * np.sqrt(np.diag(known) * max(fitted.mean_square, 1.0))
        spread = np.minimum(error, widest)
    return 0.3 * spread


class _Slope(NamedTuple):
    """Normal equations of some residuals by what is searched, columns scaled to one length.

    Attributes:
        normal: Products of the scaled columns, shape (moves, moves).
        pull: Their products with the residuals, negative, shape (moves,).
        curvature: Eigenvalues of `normal`, shape (moves,).
    """

    scale: Coordinates
    size: FloatArray
    normal: FloatArray
    pull: FloatArray
    curvature: FloatArray
    directions: FloatArray

    @classmethod
    def of(
        cls, columns: FloatArray, residuals: FloatArray, scale: Coordinates, known: FloatArray
    ) -> "_Slope":
        """The equations, with a residual of each value's own that is known, and its derivative.

        Args:
            columns: Derivative of the residuals by what is searched, shape (moves, entries).
            residuals: Shape (entries,).
            scale: How the values move.
            known: Derivatives and residuals of what is known, shape (2, moves).
        """
        normal = columns @ columns.T + np.diag(known[0] ** 2)
        squares = np.diag(normal)
        # Below 1e-9 of the greatest length a derivative does nothing: its value stays. Lengths are
        # those over a span, or else units would decide: of a bend of 1e-10 N m s2 the derivative
        # was 3e9 times any other's, and it alone was fitted.
        lengths = squares * scale.span**2
        dead = lengths <= 1e-18 * float(lengths.max(initial=0.0))
        size = np.where(dead, np.inf, np.sqrt(np.where(dead, 1.0, squares)))
        scaled = normal / size / size[:, None]
        pull = -(columns @ residuals + known[0] * known[1]) / size
        return cls(scale, size, scaled, pull, *np.linalg.eigh(scaled))

    def step(self, values: FloatArray, damping: float) -> FloatArray:
        """The values after a damped step, no further than the bounds.

        Args:
            values: Where it begins.
            damping: Relative to the diagonal of `normal`.
        """
        scale = self.scale
        x = values[scale.moves]
        fixed = np.zeros(x.size, bool)
        fixed_steps = np.zeros(x.size)  # steps of those that are fixed
        after, curvature, directions = x, self.curvature, self.directions
        for _ in range(3):
            open_ = ~fixed
            if not open_.any():
                break
            if fixed.any():
                curvature, directions = np.linalg.eigh(self.normal[np.ix_(open_, open_)])
            held = fixed_steps[fixed] * self.size[fixed]
            pull = self.pull[open_] - self.normal[np.ix_(open_, fixed)] @ held
            delta = fixed_steps.copy()
            delta[open_] = _solution(curvature, directions, pull, damping) / self.size[open_]
            wanted = scale.unbounded(x, delta)
            after = np.clip(wanted, scale.low, scale.high)
            out = open_ & (wanted != after)
            if not out.any():
                break
            fixed |= out
            fixed_steps = np.where(fixed, scale.apart(x, after), 0.0)
        moved = values.copy()
        moved[scale.moves] = after
        return moved


def _solution(
    curvature: FloatArray, directions: FloatArray, pull: FloatArray, damping: float
) -> FloatArray:
    """Solution of (normal + damping) x = pull that leaves flat directions alone."""
    kept = curvature > 1e-10 * max(float(curvature[-1]), 1e-300)
    weights = np.where(kept, 1.0 / np.where(kept, curvature + damping, 1.0), 0.0)
    solution: FloatArray = directions @ (weights * (directions.T @ pull))
    return solution
