"""Output-error identification of a loop with dry friction.

The two poles are a mass on a spring, of position x and unit gain, and friction of constant size F
takes off what it can of each step (a proximal step: Moreau, Numerical aspects of the sweeping
process, 1999), so that it opposes every motion and sticks exactly:

    x(k+1) = x(k) + s - clip(s, -a F, a F),     a = 1 + a1 + a2
    s = -(1 + a1) x(k) - a2 x(k-1) + a u(k)
    y(k) = (b0 x(k-d) + b1 x(k-d-1) + b2 x(k-d-2))/a

A record begins at rest with friction of an unknown size, the same in all. For given poles,
friction and start the output is linear in the numerator; these four numbers are searched.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.identification import (
    LoopFit,
    LoopRecord,
    PoleFit,
    by_cost,
    delayed,
    denominator,
    pole_coordinates,
    search_dead_time,
    summarise,
)
from estune.loop_model.model import LoopModel

SHARES = (0.01, 0.03, 0.1, 0.25)
"""Sizes of friction that a search begins from, over the effort of a step."""

SCREENED = 2
STARTS = 3
"""Records by which the starts of a search are compared and improved, which with few reversals has
fewer local minima, and number of those that all records then improve."""

DIFFERENCE = 1e-4
"""Half the distance of the points of a numerical slope, in each coordinate."""


MISFIT_DONE = 0.001
"""Misfit from which an earlier fit is not all that a search begins from. Local minima leave 0.17 %
and more, the fits of the reference reel with its own friction 0.05 to 0.09 %."""

KNOWN_MAX = 4
"""Coordinates whose positions are kept: searches at other dead times begin from them."""

FRICTION_MIN = 1e-9
"""Least size of friction, over the effort of a step."""

DIVERGED_N = 1e9
"""Position in place of one that is not a number, of a mass whose poles are unstable."""


class _Signals(NamedTuple):
    """The records.

    Attributes:
        effort: Effort, shape (records, samples).
        measurement: Measurement without its mean, shape (records, samples).
        rest: Position before the step less its mean, in N of effort, shape (records,).
        rest_effort: Mean effort before the step.
        scale: Effort that a step needs, N.
        known: Positions at the last coordinates, by their bytes.
    """

    effort: FloatArray
    measurement: FloatArray
    rest: FloatArray
    rest_effort: float
    scale: float
    known: dict[bytes, FloatArray]

    @classmethod
    def of(cls, records: Sequence[LoopRecord], gain: float) -> "_Signals":
        """The signals of records of a plant of about this gain."""
        rest = np.array([r.measurement_N[: max(r.step_index, 1)].mean() for r in records])
        measurement = np.array([r.measurement_N for r in records])
        return cls(
            np.array([r.effort_N for r in records]),
            measurement - measurement.mean(axis=1, keepdims=True),
            (rest - rest.mean()) / gain,
            float(np.mean([r.rest_effort_N for r in records])),
            abs(records[0].step_N / gain),
            {},
        )


def fit_with_friction(
    records: Sequence[LoopRecord],
    linear: LoopFit,
    sampling_Hz: float,
    settling_time_s: float,
    last: LoopModel | None = None,
) -> LoopFit | None:
    """The loop model with dry friction that fits records best; None where none was found.

    Args:
        records: At least one; all of one step trial.
        linear: The linear model of least squares.
        sampling_Hz: Sampling rate.
        settling_time_s: Settling time asked for, which sets the scale of the search.
        last: Model with friction of an earlier fit to start from.
    """
    gain = (last or linear.model).static_gain
    if not (math.isfinite(gain) and gain != 0.0):
        return None
    signals = _Signals.of(records, gain)
    search, warm = partial(_search, signals), None
    if last is not None:
        x = np.array([*pole_coordinates(last), last.friction_N / signals.scale, 0.0])
        best = search_dead_time(search, search(x, last.dead_samples))
        warm = _summarise(records, signals, best)
        if warm.misfit < MISFIT_DONE:
            return warm
    screened = _Signals.of(records[:SCREENED], gain)
    starts = _starts(screened, linear.model, settling_time_s * sampling_Hz)
    few = sorted((_search(screened, x, dead) for x, dead in starts), key=by_cost)
    found = (search(one.coordinates, one.dead) for one in few[:STARTS])
    best = search_dead_time(search, min(found, key=by_cost))
    cold = _summarise(records, signals, best)
    return warm if warm is not None and warm.residual_N <= cold.residual_N else cold


def _starts(
    signals: _Signals, linear: LoopModel, settling_samples: float
) -> list[tuple[FloatArray, int]]:
    """The best of a coarse grid of poles and friction, at each dead time and of each size."""
    w = 2.0 * math.pi / settling_samples
    poles = [pole_coordinates(linear)]
    poles += [np.log([w * f, z]) for f in (0.3, 0.7, 1.5) for z in (0.2, 0.7)]
    grid = [np.array([*pole, share, 0.0]) for pole in poles for share in SHARES]
    positions = _positions(signals, grid)
    # What sticks until the effort has grown looks like dead time to a linear model.
    delays = sorted({1, 2, 4, linear.dead_samples // 3, linear.dead_samples})
    tried = [
        (_Output.of(signals, x, dead).cost, i, dead)
        for i, x in enumerate(positions)
        for dead in delays
    ]
    best = {min(one for one in tried if one[2] == dead) for dead in delays}
    best |= {min(t for t in tried if t[1] % len(SHARES) == n) for n in range(len(SHARES))}
    return [(grid[i], dead) for _, i, dead in sorted(best)]


def _search(signals: _Signals, start: FloatArray, dead: int) -> PoleFit:
    """Least squares from a start, by Levenberg and Marquardt."""
    from scipy.optimize import least_squares  # noqa: PLC0415  slow to import

    def residual_of(x: FloatArray, positions: FloatArray) -> FloatArray:
        # Without a reversal only the change of the friction shows: then it holds nothing at rest.
        held_N = signals.scale * x[2] * math.tanh(x[3])
        return np.append(_Output.of(signals, positions, dead).residual.ravel(), held_N)

    def jacobian(x: FloatArray) -> FloatArray:
        moved = zip(_beside(x), _about(signals, x)[1:], strict=True)
        ends = [residual_of(*pair) for pair in moved]
        pairs = zip(ends[::2], ends[1::2], strict=True)
        return np.stack([(up - down) / (2.0 * DIFFERENCE) for up, down in pairs], axis=1)

    def residual(x: FloatArray) -> FloatArray:
        return residual_of(x, _about(signals, x)[0])

    found = least_squares(
        residual, start, jac=jacobian, method="lm", xtol=1e-5, ftol=1e-6, max_nfev=25
    )
    return PoleFit(float(found.cost), found.x, dead)


def _about(signals: _Signals, x: FloatArray) -> FloatArray:
    """Positions at a point and to both sides of it along each coordinate, all in one run."""
    key = x.tobytes()
    if key not in signals.known:
        if len(signals.known) >= KNOWN_MAX:
            del signals.known[next(iter(signals.known))]
        signals.known[key] = _positions(signals, [x, *_beside(x)])
    return signals.known[key]


def _beside(x: FloatArray) -> list[FloatArray]:
    """Points to both sides along each coordinate."""
    return [x + s * e for e in DIFFERENCE * np.eye(4) for s in (1, -1)]


def _positions(signals: _Signals, coordinates: Sequence[FloatArray]) -> FloatArray:
    """Position x less its value at rest, shape (coordinates, records, samples).

    Coordinates are the logarithms of natural frequency and damping ratio, the size of friction
    over the effort of a step, and the share of it that holds at rest, as an area tangent.
    """
    a = np.array([denominator(x[:2]) for x in coordinates])
    friction = signals.scale * np.abs([x[2] for x in coordinates])
    held = friction * np.tanh([x[3] for x in coordinates])
    rest = signals.rest_effort + held[:, np.newaxis] + signals.rest
    return simulate(signals.effort, a, friction, rest) - rest[..., np.newaxis]


def simulate(
    effort: FloatArray, a: FloatArray, friction: FloatArray, rest: FloatArray
) -> FloatArray:
    """Positions of masses on springs with dry friction, shape (masses, records, samples).

    Args:
        effort: Shape (records, samples).
        a: Denominators of the two poles, shape (masses, 3).
        friction: Sizes of the friction, N, shape (masses,).
        rest: Position before the first sample, N, shape (masses, records).
    """
    unit = a.sum(axis=1)[:, np.newaxis]
    first, second = -(1.0 + a[:, 1:2]), -a[:, 2:3]
    most = unit * friction[:, np.newaxis]
    columns = np.multiply.outer(effort.T, unit[:, 0]).transpose(0, 2, 1)
    x = np.empty((effort.shape[1], *rest.shape))
    now = before = rest
    with np.errstate(over="ignore", invalid="ignore"):
        for k, push in enumerate(columns):
            x[k] = now
            step = first * now + second * before + push
            before, now = now, now + step - np.minimum(np.maximum(step, -most), most)
    x = np.nan_to_num(x, nan=DIVERGED_N, posinf=DIVERGED_N, neginf=-DIVERGED_N)
    return x.transpose(1, 2, 0)


class _Output(NamedTuple):
    """Best numerator for given positions.

    Attributes:
        numerator: Over the sum of the denominator, shape (3,).
        regressors: Positions at the three delays without their means, (3, records, samples).
        residual: Shape (records, samples).
    """

    numerator: FloatArray
    regressors: FloatArray
    residual: FloatArray

    @classmethod
    def of(cls, signals: _Signals, x: FloatArray, dead: int) -> "_Output":
        """The output of positions, shape (records, samples), at this dead time."""
        regressors = np.stack([delayed(x, dead + j) for j in range(3)])
        regressors -= regressors.mean(axis=2, keepdims=True)
        flat, y = regressors.reshape(3, -1).T, signals.measurement
        b = np.asarray(np.linalg.lstsq(flat, y.ravel(), rcond=1e-10)[0], float)
        return cls(b, regressors, y - (flat @ b).reshape(y.shape))

    @property
    def cost(self) -> float:
        """Half the sum of squared residuals."""
        return 0.5 * float(np.vdot(self.residual, self.residual))


def _summarise(records: Sequence[LoopRecord], signals: _Signals, best: PoleFit) -> LoopFit:
    """The fit with its covariances and its misfit."""
    x = best.coordinates
    at = _Output.of(signals, _positions(signals, [x])[0], best.dead)
    a1, a2 = denominator(x[:2])[1:].tolist()
    b0, b1, b2 = (at.numerator * (1.0 + a1 + a2)).tolist()
    friction_N = max(signals.scale * abs(float(x[2])), FRICTION_MIN * signals.scale)
    model = LoopModel((a1, a2), (b0, b1, b2), best.dead, friction_N)
    return summarise(
        records,
        model,
        _slopes(signals, model, held_N=friction_N * math.tanh(x[3])),
        at.residual,
        response_N=float(np.abs(np.tensordot(at.numerator, at.regressors, 1)).max()),
        nuisance=1,
    )


def _slopes(signals: _Signals, model: LoopModel, held_N: float) -> FloatArray:
    """Slopes of the output along the model's parameters, shape (records, samples, 6).

    What holds at rest counts as known: without a reversal it cannot be told from the friction.
    """
    values = model.parameters
    # Small against what the poles leave of their sum: it makes the gain.
    unit = abs(1.0 + sum(model.poles))
    sizes = 1e-3 * np.array([unit, unit, *np.maximum(np.abs(values[2:]), 1e-6)])

    def output(theta: FloatArray) -> FloatArray:
        a, friction = np.array([1.0, *theta[:2]]), theta[5:6]
        rest = signals.rest_effort + held_N + signals.rest
        x = simulate(signals.effort, a[np.newaxis], friction, rest[np.newaxis])[0]
        taps = [delayed(x - rest[:, np.newaxis], model.dead_samples + j) for j in range(3)]
        return np.asarray(np.tensordot(theta[2:5] / a.sum(), np.array(taps), 1))

    columns = np.array(
        [
            (output(values + size * axis) - output(values - size * axis)) / (2.0 * size)
            for size, axis in zip(sizes, np.eye(6), strict=True)
        ]
    )
    columns -= columns.mean(axis=2, keepdims=True)
    return columns.transpose(1, 2, 0)
