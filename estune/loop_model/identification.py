"""Output-error identification of the loop model from step records.

For given poles the output is linear in the numerator, and for each record in the state it begins
from and in the offsets of effort and measurement. Only the two poles are searched (variable
projection: Golub and Pereyra, SIAM Journal on Numerical Analysis 10, 1973), and the dead time, a
whole number of samples, beside the last one found.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from estune.core.filtering import lfilter
from estune.core.quantities import FloatArray
from estune.loop_model.model import LoopModel

NUISANCE = 4
"""Parameters of each record: two of the start state, the offsets of effort and measurement."""


LONGER = 2.0
"""Least gain in chi-squared that a sample of dead time more must bring. Without it the fit takes
noise for dead time where the numerator covers it: sd of ln Ms 2.3 % instead of 1.7 % after ten
timid trials of `tests/test_loop_model.py`."""

FEWEST_BEFORE = 8
"""Samples before the step that are enough to tell the noise."""

NORMAL_MEDIAN = 0.6745
"""Median of the size of a normal variable, over its standard deviation."""

RESPONSE_MIN = 10.0
"""Least response in standard deviations of the noise: a trial below 95 is refused as ill-posed."""

FASTEST = 1e-20
"""Least magnitude of a pole of z: the start of a fit has the logarithm of each."""

NUISANCE_APART = 1e-7
"""Least share of the largest singular value by which start state and offsets differ."""


by_cost = attrgetter("cost")


class LoopRecord(NamedTuple):
    """The data of one trial that the identification uses.

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
        covariance: Of its n real parameters, shape (n, n): white residuals.
        clustered: The same from the scatter between records (sandwich estimate).
        noise_N: Standard deviation of the measurement noise, from first differences.
        residual_N: Standard deviation of the residual.
        misfits: rho of each record, the residual beyond the noise as a share of its step.
        response_N: Largest deviation of the fitted measurement.
    """

    model: LoopModel
    covariance: FloatArray
    clustered: FloatArray
    noise_N: float
    residual_N: float
    misfits: tuple[float, ...]
    response_N: float

    @property
    def responds(self) -> bool:
        """Whether the measurement follows the effort, beyond the noise."""
        return self.response_N > RESPONSE_MIN * self.noise_N

    @property
    def misfit(self) -> float:
        """Root mean square of rho over the records."""
        return math.sqrt(math.fsum(rho * rho for rho in self.misfits) / len(self.misfits))

    @property
    def quantile(self) -> float:
        """Quantile of Student's t for a 95 % interval from the scatter between records."""
        from scipy.special import stdtrit  # noqa: PLC0415  slow to import

        return float(stdtrit(max(len(self.misfits) - 1, 1), 0.975))


def noise_of(record: LoopRecord) -> float:
    """Standard deviation of the measurement noise, N.

    From first differences before the step; where few samples precede it, from the median of third
    differences of the whole record, in which the response itself hardly counts.
    """
    before = record.measurement_N[: record.step_index]
    if before.size >= FEWEST_BEFORE:
        return float(np.std(np.diff(before)) / math.sqrt(2.0))
    third = np.diff(record.measurement_N, 3)
    return float(np.median(np.abs(third)) / (NORMAL_MEDIAN * math.sqrt(20.0)))


def fit_linear_loop(
    records: Sequence[LoopRecord],
    sampling_Hz: float,
    settling_time_s: float,
    last: LoopModel | None = None,
) -> LoopFit:
    """The linear loop model that fits records best.

    Args:
        records: At least one; all of one step trial.
        sampling_Hz: Sampling rate.
        settling_time_s: Settling time asked for, which sets the scale of the search.
        last: Model of an earlier fit to start from.
    """
    signals = _signals(records)
    start = (
        _cold_start(_signals(records[:2]), sampling_Hz, settling_time_s)
        if last is None
        else PoleFit(math.inf, pole_coordinates(last), last.dead_samples)
    )
    _, coordinates, dead = _searched_dead_time(signals, start)
    return _summarise(records, signals, coordinates, dead)


class _Signals(NamedTuple):
    """Effort and measurement of the records as deviations, shape (records, samples) each."""

    effort: FloatArray
    measurement: FloatArray


def _signals(records: Sequence[LoopRecord]) -> _Signals:
    rest = [r.measurement_N[: max(r.step_index, 1)].mean() for r in records]
    return _Signals(
        np.array([r.effort_N - r.rest_effort_N for r in records]),
        np.array([r.measurement_N - level for r, level in zip(records, rest, strict=True)]),
    )


class PoleFit(NamedTuple):
    """A fit of the poles at one dead time.

    Attributes:
        cost: Half the sum of squared residuals, with the price of dead time where it has one.
        coordinates: Of the poles, and of the friction where there is any.
        dead: Whole samples of dead time.
    """

    cost: float
    coordinates: FloatArray
    dead: int


def _cold_start(signals: _Signals, sampling_Hz: float, settling_time_s: float) -> PoleFit:
    """The best of several starts, the poles on a coarse grid, each with its best dead time."""
    scale = 2.0 * math.pi / (settling_time_s * sampling_Hz)  # rad/sample
    longest = max(2, round(settling_time_s * sampling_Hz))
    delays = sorted({0, 1, 2, *np.geomspace(3, longest, 8).astype(int).tolist()})
    starts = [np.log([scale * f, z]) for f in (0.1, 0.5, 1.5) for z in (0.2, 1.0)]
    coarse = [
        min((PoleFit(_Solution.at(signals, x, d).cost, x, d) for d in delays), key=by_cost)
        for x in starts
    ]
    found = [_fit_poles(signals, *one[1:]) for one in sorted(coarse, key=by_cost)[:3]]
    return _searched_dead_time(signals, min(found, key=by_cost))


def _searched_dead_time(signals: _Signals, start: PoleFit) -> PoleFit:
    fit = partial(_fit_poles, signals)
    return search_dead_time(fit, fit(start.coordinates, start.dead), max(1, start.dead // 8))


def search_dead_time(
    fit: Callable[[FloatArray, int], PoleFit], best: PoleFit, step: int = 1
) -> PoleFit:
    """The best dead time about a fit, by steps that shrink to one sample."""
    while True:
        beside = [d for d in (best.dead - step, best.dead + step) if d >= 0]
        better = min((fit(best.coordinates, d) for d in beside), key=by_cost)
        if better.cost < best.cost:
            best = better
        elif step == 1:
            return best
        else:
            step = max(1, step // 3)


def denominator(coordinates: FloatArray) -> FloatArray:
    """A for logarithms of natural frequency (rad/sample) and damping ratio."""
    w, z = np.exp(np.minimum(np.maximum(coordinates, -25.0), 6.0))  # np.clip takes longer
    if z < 1.0:
        radius, angle = math.exp(-z * w), w * math.sqrt(1.0 - z * z)
        return np.array([1.0, -2.0 * radius * math.cos(angle), radius * radius])
    spread = w * math.sqrt(z * z - 1.0)
    slow, fast = math.exp(-w * w / (z * w + spread)), math.exp(-(z * w + spread))
    return np.array([1.0, -(slow + fast), slow * fast])


def pole_coordinates(model: LoopModel) -> FloatArray:
    """Inverse of `denominator`; a pole at zero is taken as one that decays within a sample."""
    roots = np.roots(model.denominator).astype(complex)
    poles = np.log(np.where(np.abs(roots) < FASTEST, FASTEST, roots))
    product, total = abs((poles[0] * poles[1]).real), -(poles[0] + poles[1]).real
    w = math.sqrt(max(product, 1e-20))
    return np.log([w, max(total / (2.0 * w), 1e-6)])


def _fit_poles(signals: _Signals, start: FloatArray, dead: int) -> PoleFit:
    """The poles of least squares from a start, by Levenberg and Marquardt."""
    from scipy.optimize import least_squares  # noqa: PLC0415  slow to import

    last = _Solution.at(signals, start, dead)

    def at(x: FloatArray) -> _Solution:
        nonlocal last
        if not np.array_equal(x, last.coordinates):
            last = _Solution.at(signals, x.copy(), dead)
        return last

    found = least_squares(
        lambda x: at(x).residual.ravel(),
        start,
        jac=lambda x: at(x).pole_jacobian(),
        method="lm",
        xtol=1e-6,
        ftol=1e-8,
        max_nfev=40,
    )
    return PoleFit(at(found.x).cost, found.x, dead)


class _Solution(NamedTuple):
    """Best numerator, start states and offsets at given poles and dead time.

    Attributes:
        coordinates: Of the poles.
        dead: Whole samples of dead time.
        nuisance: Orthonormal basis of start states and offsets, shape (samples, 4).
        regressors: Of the numerator, without the nuisance, shape (3, records, samples).
        basis: Orthonormal basis of the regressors, shape (samples of all, 3).
        numerator: b0, b1 and b2.
        residual: Shape (records, samples).
        output: Fitted measurement without its offset, shape (records, samples).
    """

    coordinates: FloatArray
    dead: int
    nuisance: FloatArray
    regressors: FloatArray
    basis: FloatArray
    numerator: FloatArray
    residual: FloatArray
    output: FloatArray

    @classmethod
    def at(cls, signals: _Signals, coordinates: FloatArray, dead: int) -> "_Solution":
        """The solution at these poles and this dead time."""
        a, n = denominator(coordinates), signals.effort.shape[1]
        filtered = lfilter([1.0], a, signals.effort)
        raw = np.stack([delayed(filtered, dead + 1 + j) for j in range(3)])
        Q, level = _nuisance(float(a[1]), float(a[2]), n)
        X, y = _projected(raw, Q), _projected(signals.measurement, Q)
        basis, triangle = np.linalg.qr(X.reshape(3, -1).T)  # almost collinear: not by X'X
        b = np.linalg.lstsq(triangle, basis.T @ y.ravel(), rcond=1e-10)[0]
        residual = y - _combined(b, X)
        rest = (signals.measurement - _combined(b, raw)) @ Q
        output = signals.measurement - residual - rest @ level
        return cls(coordinates, dead, Q, X, basis, b, residual, output)

    @property
    def cost(self) -> float:
        """Half the sum of squared residuals, with the price of dead time."""
        price = math.exp(LONGER * self.dead / self.residual.size)
        return 0.5 * float(np.vdot(self.residual, self.residual)) * price

    @property
    def denominator_slopes(self) -> FloatArray:
        """Slopes of the residual along a1 and a2, shape (2, records, samples)."""
        again = lfilter([1.0], denominator(self.coordinates), self.output)
        slopes = np.stack([delayed(again, 1), delayed(again, 2)])
        return _projected(slopes, self.nuisance)

    def pole_jacobian(self) -> FloatArray:
        """Slopes of the residual along the coordinates, shape (samples of all, 2).

        The numerator follows the poles, as by Kaufman (BIT 15, 1975).
        """
        x = self.coordinates
        moved = [denominator(x + s * step) for step in 1e-6 * np.eye(2) for s in (1, -1)]
        per_coordinate = np.array([moved[0] - moved[1], moved[2] - moved[3]])[:, 1:] / 2e-6
        slopes = (per_coordinate @ self.denominator_slopes.reshape(2, -1)).T
        return np.asarray(slopes - self.basis @ (self.basis.T @ slopes))


def _combined(weights: FloatArray, signals: FloatArray) -> FloatArray:
    """Weighted sum of signals, shape of one; np.tensordot takes a tenth of a fit for it."""
    return np.asarray((weights @ signals.reshape(len(weights), -1)).reshape(signals.shape[1:]))


@lru_cache(maxsize=4)
def _nuisance(a1: float, a2: float, samples: int) -> tuple[FloatArray, FloatArray]:
    """Basis Q of start states and offsets, and the level that each of its columns contains.

    Returns:
        Arrays of shape (samples, up to 4) and (up to 4, 1).
    """
    free = lfilter([1.0], [1.0, a1, a2], np.eye(1, samples)[0])
    columns = np.array([free, delayed(free, 1), np.cumsum(free), np.ones(samples)])
    columns /= np.maximum(np.linalg.norm(columns, axis=1, keepdims=True), 1e-300)
    # Start state and level span the response to an offset of the effort, but for integrators.
    left, sizes, right = np.linalg.svd(columns.T, full_matrices=False)
    apart = sizes > NUISANCE_APART * sizes[0]
    level = right[apart, -1:] / sizes[apart, np.newaxis] * columns[-1, 0]
    return left[:, apart], level


def delayed(signals: FloatArray, samples: int) -> FloatArray:
    """Signals so many samples later, zero before, shape (..., samples)."""
    later = np.zeros_like(signals)
    later[..., samples:] = signals[..., : signals.shape[-1] - samples]
    return later


def _projected(signals: FloatArray, basis: FloatArray) -> FloatArray:
    """Signals less their part in an orthonormal basis, shape (..., samples)."""
    return np.asarray(signals - (signals @ basis) @ basis.T)


def _summarise(
    records: Sequence[LoopRecord], signals: _Signals, coordinates: FloatArray, dead: int
) -> LoopFit:
    """The fit with its covariances and its misfit."""
    at = _Solution.at(signals, coordinates, dead)
    a, b = denominator(coordinates), at.numerator
    slopes = np.concatenate([at.denominator_slopes, -at.regressors]).transpose(1, 2, 0)
    return summarise(
        records,
        LoopModel((float(a[1]), float(a[2])), (float(b[0]), float(b[1]), float(b[2])), dead),
        slopes,
        at.residual,
        response_N=float(np.abs(_combined(b, at.regressors)).max()),
        nuisance=NUISANCE,
    )


def summarise(
    records: Sequence[LoopRecord],
    model: LoopModel,
    slopes: FloatArray,
    residual: FloatArray,
    *,
    response_N: float,
    nuisance: int,
) -> LoopFit:
    """The fit of a model with its covariances and its misfit.

    Args:
        records: The records.
        model: The model.
        slopes: Of the output, or of the residual, along the model's real parameters and further
            ones that all records share, shape (records, samples, parameters).
        residual: Shape (records, samples).
        response_N: Largest deviation of the fitted measurement.
        nuisance: Parameters of each record.
    """
    J, (count, samples) = slopes.reshape(-1, slopes.shape[2]), residual.shape
    weight = np.linalg.norm(J, axis=0)
    weight = np.maximum(weight, 1e-12 * weight.max())
    inverse = np.linalg.pinv((J / weight).T @ (J / weight), rcond=1e-12) / np.outer(weight, weight)
    squares = np.sum(residual**2, axis=1)
    variance = float(squares.sum()) / max(residual.size - J.shape[1] - nuisance * count, 1)
    scores = np.einsum("rnp,rn->rp", slopes, residual)
    noise = math.sqrt(float(np.mean([noise_of(record) ** 2 for record in records])))
    beyond = np.maximum(squares / max(samples - nuisance, 1) - noise**2, 0.0)
    n = model.parameters.size
    return LoopFit(
        model=model,
        covariance=(variance * inverse)[:n, :n],
        clustered=(inverse @ (scores.T @ scores) @ inverse)[:n, :n],
        noise_N=noise,
        residual_N=math.sqrt(variance),
        response_N=response_N,
        misfits=tuple((np.sqrt(beyond) / np.abs([r.step_N for r in records])).tolist()),
    )
