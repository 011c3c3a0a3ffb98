"""Result warnings: low margins, gains at a bound, flat directions of the cost.

Flat directions follow from a quadratic in the search coordinates, fitted to the safe trials near
the best gains,

    J(z) = c + g' z + z' H z / 2,
    z_i = ln(value_i / best_i), or (value_i - best_i) / (high_i - low_i) on a linear scale,

with a wide Gaussian prior on g and H (ridge regression), so that an unexplored direction is
uncertain and not flat. A direction is flat only over the range of the trials, and only where the
change of the cost, with its uncertainty, is within the repeatability.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations_with_replacement
from typing import Literal, NamedTuple

import numpy as np

from estune.core.gains import GAIN_UNITS
from estune.core.margins import Margins
from estune.core.quantities import FloatArray
from estune.tuners.search_space import Point, SearchSpace

FLAT_FACTOR = 2.0
"""Range, as a factor, from which a flat parameter is reported."""

FLAT_SHARE = 0.25
"""Range from which a flat parameter on a linear scale is reported, relative to its bounds."""

AT_BOUND = 0.02
"""Distance to a bound, relative to the range, within which a parameter is at its bound."""

NEAR_LIMIT = 0.2
"""Constraint margin below which a response is near a limit of the rig."""

LEAST_CHANGE = 0.01
"""Relative change of the cost below which a direction is flat, however small the noise."""

PHASE_MARGIN_LEAST_deg, GAIN_MARGIN_LEAST = 30.0, 2.0
"""Usual minimum margins (Astrom & Hagglund, Advanced PID Control, 2006)."""

_CONFIDENCE = 1.645  # one-sided 95 % of a normal distribution


class _Axis(NamedTuple):
    name: str
    label: str
    unit: str
    low: float
    high: float
    log: bool

    def coordinates(self, values: FloatArray, origin: float) -> FloatArray:
        """Coordinates of values from the origin: logarithms, or shares of the range."""
        if self.log:
            return np.log(values / origin)
        return (values - origin) / (self.high - self.low)

    def value(self, coordinate: float, origin: float) -> float:
        if self.log:
            return origin * math.exp(coordinate)
        return origin + coordinate * (self.high - self.low)

    @property
    def flat_width(self) -> float:
        """Minimum width of a flat range, in the coordinate."""
        return math.log(FLAT_FACTOR) if self.log else FLAT_SHARE


class ResultWarning(NamedTuple):
    """One warning.

    Attributes:
        kind: `margin`, `limit`, `bound`, `flat`, or `unknown` if the trials do not decide.
    """

    kind: Literal["margin", "limit", "bound", "flat", "unknown"]
    parameters: tuple[str, ...]
    sentence: str


def low_margins(
    margins: Margins | None, *, limited: bool = False, by_records: bool = True
) -> tuple[ResultWarning, ...]:
    """Warning of low margins or instability; none without a model.

    Args:
        margins: Of the rig's own linear model.
        limited: Whether the run had a limit of the sensitivity already.
        by_records: Whether the tuner identifies the loop, without which it keeps no such limit.
    """
    if margins is None:
        return ()
    remedy = "limit the sensitivity: --max-sensitivity 1.6"
    if limited:
        remedy = (
            "the loop is not linear enough for the search to keep its limit of the sensitivity"
        )
    if not by_records:
        remedy = (
            "the tuner searches without limits; tune with --tuner model_based, which keeps them"
        )
    if not margins.stable:
        sentence = f"these gains make the rig's own linear model unstable; {remedy}"
    elif margins.phase_margin_deg < PHASE_MARGIN_LEAST_deg:
        sentence = (
            f"the phase margin of {margins.phase_margin_deg:.0f}° is low "
            f"(under {PHASE_MARGIN_LEAST_deg:.0f}°); {remedy}"
        )
    elif 1.0 / GAIN_MARGIN_LEAST < margins.gain_margin < GAIN_MARGIN_LEAST:
        sentence = (
            f"the gain margin of {_dB(margins.gain_margin):.2g} dB is low "
            f"(within {_dB(GAIN_MARGIN_LEAST):.0f} dB); {remedy}"
        )
    else:
        return ()
    return (ResultWarning("margin", (), sentence),)


def _dB(factor: float) -> float:
    return 20.0 * math.log10(factor)


def near_limits(share: float, signals: str) -> tuple[ResultWarning, ...]:
    """Warning of a response near a limit of the rig's signals; by its `constraint_margin`."""
    if share >= NEAR_LIMIT:
        return ()
    sentence = (
        f"the constraint margin of these gains is {max(share, 0.0):.0%} of the rig's limits of "
        f"{signals}: the limits, not the cost, may determine these gains"
    )
    return (ResultWarning("limit", (), sentence),)


def at_bounds(
    space: SearchSpace, best: Point, units: Mapping[str, str] = GAIN_UNITS
) -> tuple[ResultWarning, ...]:
    """Warnings of parameters at a bound, with the units of the gains."""
    sides = space.at_bound(best, AT_BOUND)
    warnings = []
    for axis in _axes(space, units):
        if axis.name in sides:
            low = sides[axis.name] == "low"
            side, bound = ("lower", axis.low) if low else ("upper", axis.high)
            sentence = (
                f"{axis.label} is at its {side} bound of {_shown(axis, bound)}: "
                "the bound determines it, not the cost"
            )
            warnings.append(ResultWarning("bound", (axis.name,), sentence))
    return tuple(warnings)


def flat_directions(
    space: SearchSpace,
    best: Point,
    best_cost: float,
    *,
    points: FloatArray,
    costs: FloatArray,
    noise: float,
    units: Mapping[str, str] = GAIN_UNITS,
) -> tuple[ResultWarning, ...]:
    """Warnings of parameters, alone or together, without effect on the cost.

    Args:
        space: The tuned parameters.
        best: Their values at the best gains.
        best_cost: The cost there.
        points: Parameters of the safe trials, shape (trials, parameters).
        costs: Their costs, shape (trials,).
        noise: Standard deviation of the cost between repeats.
        units: Units of the gains, by name.

    Returns:
        Flat directions, then one warning of the parameters on which the trials do not decide.
    """
    axes = _axes(space, units)
    if not math.isfinite(noise):
        sentence = "without repeats flat directions cannot be determined"
        return (ResultWarning("unknown", space.names, sentence),)
    tolerance = max(2.0 * noise, LEAST_CHANGE * abs(best_cost))
    columns = np.asarray(points, dtype=np.float64).reshape(-1, len(axes)).T
    z = np.column_stack(
        [axis.coordinates(c, origin) for axis, c, origin in zip(axes, columns, best, strict=True)]
    )
    fit = _fit_near(z, np.asarray(costs, dtype=np.float64), best_cost, tolerance, noise)
    if fit is None:
        return (_unknown(axes),)
    within = (
        f"its repeatability ({tolerance:.2g})"
        if tolerance == 2.0 * noise
        else f"{LEAST_CHANGE:.0%}"
    )
    warnings, flat, unknown = [], [], []
    for i, axis in enumerate(axes):
        low, high, decided = _flat_interval(fit, np.eye(len(axes))[i], tolerance)
        if high - low >= axis.flat_width:
            warnings.append(
                ResultWarning("flat", (axis.name,), _flat(axis, best[i], low, high, within))
            )
            flat.append(i)
        elif not decided:
            unknown.append(axis)
    joint = list(_joint(axes, fit, tolerance, within, set(flat)))
    warnings.extend(joint)
    unknown = [axis for axis in unknown if not any(axis.name in f.parameters for f in joint)]
    if unknown:
        warnings.append(_unknown(unknown))
    return tuple(warnings)


def _axes(space: SearchSpace, units: Mapping[str, str]) -> list[_Axis]:
    units = {**units, "K": units["P"], "Ti": "s", "Td": "s"}
    labels = {"setpoint_filter_s": "the setpoint filter"}
    return [
        _Axis(name, labels.get(name, name), units[name], low, high, space.scale == "log")
        for name, low, high in zip(space.names, space.low, space.high, strict=True)
    ]


class _Fit(NamedTuple):
    """The quadratic near the best: coefficients of `_terms` without the constant."""

    z: FloatArray  # trials it rests on
    beta: FloatArray
    covariance: FloatArray

    def change(self, steps: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Change of the cost from the best to each of `steps`, and its standard error."""
        terms = _terms(steps)[:, 1:]
        variance = np.einsum("ni,ij,nj->n", terms, self.covariance, terms)
        return terms @ self.beta, np.sqrt(np.maximum(variance, 0.0))


def _terms(z: FloatArray) -> FloatArray:
    """1, z_i, and z_i z_j for i <= j (halved on the diagonal), shape (trials, terms)."""
    pairs = combinations_with_replacement(range(z.shape[1]), 2)
    squares = [z[:, i] * z[:, j] * (0.5 if i == j else 1.0) for i, j in pairs]
    return np.column_stack([np.ones(len(z)), z, *squares])


def _fit_near(
    z: FloatArray, costs: FloatArray, best_cost: float, tolerance: float, noise: float
) -> _Fit | None:
    """Fits the trials whose cost is near the best; None with too few trials.

    The neighbourhood is a level set of the cost, wide relative to the noise, and is halved until
    the quadratic describes it to within the tolerance.
    """
    fit, cost_range = None, max(8.0 * tolerance, float(np.ptp(costs)) if len(costs) else 0.0)
    while cost_range >= 4.0 * tolerance:
        near = costs <= best_cost + cost_range
        terms = _terms(z[near])
        freedom = len(terms) - terms.shape[1]
        if freedom < terms.shape[1] // 2:
            break
        # Prior: per unit of a coordinate, the cost may change by several times its range.
        prior = (4.0 * cost_range) ** 2
        precision = np.eye(terms.shape[1]) / prior
        precision[0, 0] = 0.0  # the constant is free
        variance = max(noise, 1e-3 * tolerance) ** 2
        for _ in range(3):  # the lack of fit counts as noise
            posterior_precision = precision + terms.T @ terms / variance
            covariance = np.linalg.inv(posterior_precision).astype(np.float64)
            beta = covariance @ (terms.T @ costs[near]) / variance
            lack_of_fit = float(np.sum((costs[near] - terms @ beta) ** 2)) / freedom
            variance = max(noise**2, lack_of_fit, 1e-6 * tolerance**2)
        fit = _Fit(z[near], beta[1:], covariance[1:, 1:])
        if lack_of_fit <= tolerance**2:
            break
        cost_range /= 2.0
    return fit


def _flat_interval(
    fit: _Fit, direction: FloatArray, tolerance: float
) -> tuple[float, float, bool]:
    """Range along a unit direction in which the cost changes by less than the tolerance.

    Returns:
        Its lower and upper end, within the range of the trials, and whether the trials decide:
        not if they covered too little, or leave the change of the cost uncertain.
    """
    covered = fit.z @ direction
    ends, decided = [], False
    for limit in (min(0.0, float(covered.min())), max(0.0, float(covered.max()))):
        steps = np.linspace(0.0, limit, 41)
        change, error = fit.change(np.outer(steps, direction))
        free = np.abs(change) + _CONFIDENCE * error <= tolerance
        ends.append(float(steps[np.argmin(free) - 1] if not free.all() else limit))
        decided = decided or bool(np.any(np.abs(change) - _CONFIDENCE * error > tolerance))
    return ends[0], ends[1], decided


def _joint(
    axes: Sequence[_Axis], fit: _Fit, tolerance: float, within: str, flat: set[int]
) -> Iterable[ResultWarning]:
    """Flat directions of several parameters, none of which is flat by itself."""
    rest = [i for i in range(len(axes)) if i not in flat]
    if len(rest) < 2:
        return
    d = len(axes)
    hessian = np.zeros((d, d))
    for value, (i, j) in zip(
        fit.beta[d:], combinations_with_replacement(range(d), 2), strict=True
    ):
        hessian[i, j] = hessian[j, i] = value
    _, vectors = np.linalg.eigh(hessian[np.ix_(rest, rest)])
    for vector in vectors.T:
        direction = np.zeros(d)
        direction[rest] = vector
        lead = int(np.argmax(np.abs(direction)))
        direction *= np.sign(direction[lead])
        low, high, _ = _flat_interval(fit, direction, tolerance)
        moved = [i for i in rest if abs(direction[i]) >= 0.3 * direction[lead]]
        if len(moved) > 1 and (high - low) * direction[lead] >= axes[lead].flat_width:
            ways = _listed([_way(axes[i], direction[i] * (high - low)) for i in moved])
            sentence = (
                f"{_listed([axes[i].label for i in moved])} are not identifiable separately: "
                f"{ways} together changes the cost by no more than {within}"
            )
            yield ResultWarning("flat", tuple(axes[i].name for i in moved), sentence)


def _flat(axis: _Axis, origin: float, low: float, high: float, within: str) -> str:
    bottom, top = axis.value(low, origin), axis.value(high, origin)
    factor = f" by a factor {top / bottom:.2g}" if axis.log else ""
    return (
        f"{axis.label} may change{factor}, from {bottom:.2g} to {_shown(axis, top)}, "
        f"while the cost changes by no more than {within}"
    )


def _way(axis: _Axis, moved: float) -> str:
    verb = "raising" if moved > 0 else "lowering"
    size = f"a factor {math.exp(abs(moved)):.2g}" if axis.log else f"{abs(moved):.0%} of its range"
    return f"{verb} {axis.label} by {size}"


def _unknown(axes: Sequence[_Axis]) -> ResultWarning:
    listed = _listed([axis.label for axis in axes])
    sentence = (
        f"too few trials near the best gains to determine the effect of {listed} on the cost"
    )
    return ResultWarning("unknown", tuple(axis.name for axis in axes), sentence)


def _shown(axis: _Axis, value: float) -> str:
    return f"{value:.2g} {axis.unit}".rstrip()


def _listed(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
