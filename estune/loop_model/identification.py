"""Output-error identification of the loop model from step records.

For given poles the output is linear in the numerator, and for each record in the state it begins
from and in the offsets of effort and measurement. Only the two poles are searched (variable
projection: Golub and Pereyra, SIAM Journal on Numerical Analysis 10, 1973), and the dead time, a
whole number of samples, beside the last one found.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter
from scipy.stats import t as student_t

from estune.core.quantities import FloatArray
from estune.loop_model.model import LoopModel

NUISANCE = 4
"""Parameters of each record: two of the start state, the offsets of effort and measurement."""


class LoopRecord(NamedTuple):
    """What the identification uses of one trial.

    Attributes:
        effort_N: Effort of the controller, shape (samples,).
        measurement_N: Measurement, shape (samples,).
        step_N: Size of the setpoint step.
        step_index: First sample of the step.
    """

    effort_N: FloatArray
    measurement_N: FloatArray
    step_N: float
    step_index: int

    @property
    def rest_effort_N(self) -> float:
        """Mean effort before the step, N."""
        return float(self.effort_N[: max(self.step_index, 1)].mean())


class LoopFit(NamedTuple):
    """An identified loop.

    Attributes:
        model: The model.
        covariance: Of its five real parameters, shape (5, 5): white residuals.
        clustered: The same from the scatter between records (sandwich estimate).
        noise_N: Standard deviation of the measurement noise, from first differences.
        residual_N: Standard deviation of the residual.
        misfits: rho of each record, the residual beyond the noise as a share of its step.
    """

    model: LoopModel
    covariance: FloatArray
    clustered: FloatArray
    noise_N: float
    residual_N: float
    misfits: tuple[float, ...]

    @property
    def misfit(self) -> float:
        """Root mean square of rho over the records."""
        return math.sqrt(math.fsum(rho * rho for rho in self.misfits) / len(self.misfits))

    @property
    def quantile(self) -> float:
        """Quantile of Student's t for a 95 % interval from the scatter between records."""
        return float(student_t.ppf(0.975, max(len(self.misfits) - 1, 1)))


def noise_of(record: LoopRecord) -> float:
    """Standard deviation of the noise from first differences before the step, N."""
    before = record.measurement_N[: record.step_index]
    if before.size < 8:
        before = record.measurement_N
    return float(np.std(np.diff(before)) / math.sqrt(2.0))


def fit_loop(
    records: Sequence[LoopRecord],
    sampling_Hz: float,
    settling_time_s: float,
    last: LoopModel | None = None,
) -> LoopFit:
    """The loop model that fits records best.

    Args:
        records: At least one; all at one sampling rate.
        sampling_Hz: Sampling rate.
        settling_time_s: Settling time asked for, which sets the scale of the search.
        last: Model of an earlier fit to start from.
    """
    start = (
        _cold_start(records, sampling_Hz, settling_time_s)
        if last is None
        else _Try(math.inf, _pole_coordinates(last), last.dead_samples)
    )
    _, coordinates, dead = _searched_dead_time(records, start)
    a = _denominator(coordinates)
    model = LoopModel((float(a[1]), float(a[2])), (0.0, 0.0, 0.0), dead)
    b = _solve(records, a, dead)[1]
    return _summarise(records, model._replace(zeros=(float(b[0]), float(b[1]), float(b[2]))))


class _Try(NamedTuple):
    """A fit of the poles at one dead time."""

    cost: float
    coordinates: FloatArray
    dead: int


def _cold_start(records: Sequence[LoopRecord], sampling_Hz: float, settling_time_s: float) -> _Try:
    """The best of several starts of the poles, each from its best dead time on a coarse grid.

    Only the first two records are used: the fit to all follows.
    """
    records = records[:2]
    scale = 2.0 * math.pi / (settling_time_s * sampling_Hz)  # rad/sample
    longest = max(2, round(settling_time_s * sampling_Hz))
    delays = sorted({0, 1, 2, *np.geomspace(3, longest, 8).astype(int).tolist()})
    starts = [np.log([scale * f, z]) for f in (0.1, 0.5, 1.5) for z in (0.2, 1.0)]
    found = []
    for x in starts:
        dead = min(delays, key=lambda d, x=x: _cost_at(records, x, d))  # type: ignore[misc]
        found.append(_fit_poles(records, x, dead))
    best = sorted(found, key=_cost)[:2]
    return min((_searched_dead_time(records, one) for one in best), key=_cost)


def _searched_dead_time(records: Sequence[LoopRecord], start: _Try) -> _Try:
    """The best dead time from a start, by steps that shrink to one sample."""
    best = _fit_poles(records, start.coordinates, start.dead)
    step = max(1, start.dead // 8)
    while True:
        beside = [d for d in (best.dead - step, best.dead + step) if d >= 0]
        better = min((_fit_poles(records, best.coordinates, d) for d in beside), key=_cost)
        if better.cost < best.cost:
            best = better
        elif step == 1:
            return best
        else:
            step = max(1, step // 3)


def _cost(one: _Try) -> float:
    return one.cost


def _denominator(coordinates: FloatArray) -> FloatArray:
    """A for logarithms of natural frequency (rad/sample) and damping ratio."""
    w, z = np.exp(np.clip(coordinates, -25.0, 6.0))
    if z < 1.0:
        radius, angle = math.exp(-z * w), w * math.sqrt(1.0 - z * z)
        return np.array([1.0, -2.0 * radius * math.cos(angle), radius * radius])
    spread = w * math.sqrt(z * z - 1.0)
    slow, fast = math.exp(-w * w / (z * w + spread)), math.exp(-(z * w + spread))
    return np.array([1.0, -(slow + fast), slow * fast])


def _pole_coordinates(model: LoopModel) -> FloatArray:
    """Inverse of `_denominator`."""
    poles = np.log(np.roots(model.denominator).astype(complex))
    product, total = abs((poles[0] * poles[1]).real), -(poles[0] + poles[1]).real
    w = math.sqrt(max(product, 1e-20))
    return np.log([w, max(total / (2.0 * w), 1e-6)])


def _fit_poles(records: Sequence[LoopRecord], start: FloatArray, dead: int) -> _Try:
    found = least_squares(
        lambda x: _solve(records, _denominator(x), dead)[0],
        start,
        method="lm",
        xtol=1e-6,
        ftol=1e-8,
        max_nfev=40,
    )
    return _Try(float(found.cost), found.x, dead)


def _cost_at(records: Sequence[LoopRecord], x: FloatArray, dead: int) -> float:
    residual = _solve(records, _denominator(x), dead)[0]
    return 0.5 * float(residual @ residual)


def _solve(
    records: Sequence[LoopRecord], a: FloatArray, dead: int
) -> tuple[FloatArray, FloatArray]:
    """Residual over all records and the best numerator, shape (samples of all,) and (3,)."""
    rows, targets = [], []
    for record in records:
        X, y = _projected(record, a, dead)
        rows.append(X)
        targets.append(y)
    X, y = np.concatenate(rows), np.concatenate(targets)
    G, g = X.T @ X, X.T @ y
    b = np.linalg.lstsq(G, g, rcond=1e-13)[0]
    return np.asarray(y - X @ b), np.asarray(b)


def _projected(record: LoopRecord, a: FloatArray, dead: int) -> tuple[FloatArray, FloatArray]:
    """Regressors of the numerator and the measurement, with start state and offsets projected out.

    Returns:
        Arrays of shape (samples, 3) and (samples,).
    """
    u = record.effort_N - record.rest_effort_N
    y = record.measurement_N - record.measurement_N[: max(record.step_index, 1)].mean()
    n = y.size
    filtered = lfilter([1.0], a, u)
    X = np.zeros((n, 3))
    for j in range(3):
        X[dead + 1 + j :, j] = filtered[: n - dead - 1 - j]
    free = lfilter([1.0], a, np.eye(1, n)[0])
    offset = np.zeros(n)
    offset[dead + 1 :] = np.cumsum(free)[: n - dead - 1]
    nuisance = np.column_stack([free, np.concatenate([[0.0], free[:-1]]), np.ones(n), offset])
    Q = np.linalg.qr(nuisance / np.maximum(np.linalg.norm(nuisance, axis=0), 1e-300)).Q
    return np.asarray(X - Q @ (Q.T @ X)), np.asarray(y - Q @ (Q.T @ y))


def _summarise(records: Sequence[LoopRecord], model: LoopModel) -> LoopFit:
    """The fit with its covariances and its misfit."""
    theta = model.parameters
    scale = np.maximum(np.abs(theta), 1e-3 * np.abs(theta).max()) * 1e-5
    residuals, jacobians = [], []
    for record in records:
        r0 = _residual(record, model)
        J = np.column_stack(
            [
                (_residual(record, model.with_parameters(theta + step)) - r0) / step[j]
                for j, step in enumerate(np.diag(scale))
            ]
        )
        residuals.append(r0)
        jacobians.append(J)
    r, J = np.concatenate(residuals), np.concatenate(jacobians)
    weight = np.linalg.norm(J, axis=0)
    inverse = np.linalg.pinv((J / weight).T @ (J / weight), rcond=1e-12) / np.outer(weight, weight)
    variance = float(r @ r) / max(r.size - theta.size - NUISANCE * len(records), 1)
    scores = np.array([j.T @ e for j, e in zip(jacobians, residuals, strict=True)])
    noise = math.sqrt(float(np.mean([noise_of(record) ** 2 for record in records])))
    return LoopFit(
        model=model,
        covariance=variance * inverse,
        clustered=inverse @ (scores.T @ scores) @ inverse,
        noise_N=noise,
        residual_N=math.sqrt(variance),
        misfits=tuple(
            math.sqrt(max(float(e @ e) / max(e.size - NUISANCE, 1) - noise**2, 0.0))
            / abs(record.step_N)
            for record, e in zip(records, residuals, strict=True)
        ),
    )


def _residual(record: LoopRecord, model: LoopModel) -> FloatArray:
    X, y = _projected(record, model.denominator, model.dead_samples)
    return np.asarray(y - X @ np.array(model.zeros))
