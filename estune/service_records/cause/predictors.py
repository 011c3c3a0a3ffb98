"""A linear loop and one whose actuator sticks, compared by what they predict."""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from estune.core.filtering import lfilter
from estune.core.quantities import BoolArray, FloatArray
from estune.service_records.cause.loop_signals import JudgedSignals, swing_length
from estune.service_records.cause.valve import Valve, positions

BANDS = (0.06, 0.12, 0.18, 0.25, 0.35, 0.45, 0.52, 0.6, 0.66, 0.72, 0.77, 0.82, 0.88, 0.93, 0.97)
"""Stick bands that are tried, shares of the output's range."""

SLIPS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Slips that are tried, shares of the band. A limit cycle of slip 0.6 was not seen with 0.3 and 1
alone: the slips of a model come late or early then, and each costs twice its size."""

AHEAD = (-0.9, -0.5, 0.0, 0.5, 0.9)
"""Leads of the output at the beginning that are tried: a log of two reversals hangs on it."""

LONG = 0.5
"""Bands from which all leads are tried; shorter ones are passed soon, and two will do."""

POLES = (0.0, 0.5, 0.8, 0.93, 1.0)
"""Poles of the plant that are tried, per sample; one is an integrating plant."""

MORE_POLES = (0.25, 0.65, 0.87, 0.96, 0.98)
"""Those that are tried of the linear loop besides."""

DELAYS = (1, 3, 8)
"""Dead times that are tried, samples."""

MORE_DELAYS = (2, 4, 5, 6, 10, 13, 16, 20, 25)
"""Those that are tried of the linear loop besides."""

LAGS = (0, 1, 2, 4, 8, 16, 32, 64, 128)
"""Ends of the means of the autoregression of what the plant leaves, samples."""

PER_SWING = 24
"""Means per swing of the output, where loops run on from it alone."""

BLOCKS, FOLDS = 40, 5
"""Blocks of a log, of which every fifth is left out in turn: one setpoint step is then seen by the
other blocks as well, and its beginning foretells its end."""

HEAVY = 4.0
"""Degrees of freedom of Student's law by which models are fitted: a load step of ten deviations
would else be what they explain best. They are judged by their squares: of nine sticking loops of a
plant eight gain more than 11 in log likelihood then, judged by Student's law six."""

LIKELY = 10.0
"""Log likelihood below the best up to which a band and a slip may be the true ones: half of the
95 % point of chi-squared with two degrees of freedom."""

BEST = 24
"""Models of each kind that are fitted to the end, of those tried with the noise of the
measurement itself."""


class FittedPredictor(NamedTuple):
    """A plant with one pole, behind an actuator.

    Attributes:
        valve: The actuator; None where it does not stick.
        pole: Pole per sample.
        delay: Dead time, samples.
        order: 1 or 2 equal poles; 3 is one pole and half a sample more of dead time.
        gain: Measurement per output, at rest; per sample where the pole is one.
        errors: Prediction errors a sample ahead over the measurement's range, shape (samples,).
    """

    valve: Valve | None
    pole: float
    delay: int
    order: int
    gain: float
    errors: FloatArray


class ModelComparison(NamedTuple):
    """What the two kinds predict.

    Attributes:
        sticking: The best loop with a sticking actuator.
        blocks: Gain in log likelihood of each block, left out, by the sticking one.
        informed: Gain of the linear loop over one whose output does nothing.
        left: What the linear plant leaves of the measurement, shape (samples,): the disturbance.
        near: Actuators whose likelihood the log does not distinguish from the best, at 95 %.
        slow: Share of the measurement's variance at the pace of the swings that the linear loop
            leaves when it runs on from the output alone.
    """

    linear: FittedPredictor
    sticking: FittedPredictor
    blocks: FloatArray
    informed: float
    left: FloatArray
    near: tuple[Valve, ...]
    slow: float


class _Plant(NamedTuple):
    """A plant that is tried: its actuator by number, pole, dead time, and number of poles."""

    valve: int
    pole: float
    delay: int
    order: int


def compare(signals: JudgedSignals, sign: float) -> ModelComparison:
    """Both kinds of loop, for a plant whose gain has some sign."""
    y, u = signals.measurement, signals.output
    size_y, size_u = float(np.ptp(y)) or 1.0, float(np.ptp(u)) or 1.0
    scaled_y, scaled_u = (y - y.mean()) / size_y, (u - u[0]) / size_u
    valves = [Valve(0.0, 0.0)]
    valves += [
        Valve(band, slip * band, ahead)
        for band in BANDS
        for slip in SLIPS
        for ahead in (AHEAD if band > LONG else AHEAD[1::2])
    ]
    moves = positions(scaled_u, valves)
    moves -= moves[0]
    ends = [lag for lag in LAGS if lag <= max(8, y.size // 6)]
    first = ends[-1]
    noise = _noise(scaled_y[:, np.newaxis], ends)
    plants = _screened(scaled_y, moves, ends, noise, sign)
    linear = np.array([plant.valve == 0 for plant in plants])
    paths = np.column_stack([_path(moves[:, plant.valve], plant) for plant in plants])
    phi, gains = np.repeat(noise, len(plants), axis=1), np.zeros(len(plants))
    repeated = np.repeat(scaled_y[:, np.newaxis], len(plants), axis=1)
    left, weight = repeated, np.ones((1, 1))
    for _ in range(6):  # noise, gain and weights in turn; the seventh round moves nothing by 1 %
        gains = _gains(_errors(paths, ends, phi), _errors(repeated, ends, phi), weight, sign)
        left = repeated - gains * paths
        phi = _noise(left, ends, weight)
        errors = _errors(left, ends, phi)
        weight = (HEAVY + 1.0) / (HEAVY + errors**2 / _scale(errors))
    errors = _errors(left, ends, phi)
    alone = _alone(scaled_y[:, np.newaxis], ends)
    blocks = _left_out(errors, linear)
    at = [
        int(np.flatnonzero(kind)[np.argmin((errors[:, kind] ** 2).sum(axis=0))])
        for kind in (linear, ~linear)
    ]
    found = []
    for i in at:
        plant = plants[i]
        valve = _scaled(valves[plant.valve], size_u) if plant.valve else None
        e = np.concatenate([np.zeros(first), errors[:, i]])
        gain = float(gains[i]) * size_y / size_u
        found.append(FittedPredictor(valve, plant.pole, plant.delay, plant.order, gain, e))
    totals = (errors**2).sum(axis=0)
    chance = 0.5 * errors.shape[0] * np.log(totals / totals[at[1]])
    near = tuple(
        _scaled(valves[plant.valve], size_u)
        for plant, far in zip(plants, chance.tolist(), strict=True)
        if plant.valve and far < LIKELY
    )
    ratio = (float((alone**2).sum()) + 1e-300) / (float(totals[at[0]]) + 1e-300)
    informed = 0.5 * errors.shape[0] * math.log(ratio)
    slow = _slow(scaled_y, paths[:, linear], swing_length(u), sign)
    return ModelComparison(
        found[0], found[1], blocks, informed, left[:, at[0]] * size_y, near, slow
    )


def _plants(valves: int) -> list[_Plant]:
    """Plants without sticking first, in which poles and dead times are finer."""
    delays, poles = (*DELAYS, *MORE_DELAYS), (*POLES, *MORE_POLES)
    tried = [_Plant(0, pole, delay, 1) for pole in poles for delay in delays]
    tried += [_Plant(0, pole, delay, 3) for pole in poles for delay in (1, 2, 4)]
    tried += [_Plant(0, pole, delay, 2) for pole in poles[1:] for delay in (1, 2, 4, 8, 13)]
    return tried + [
        _Plant(valve, pole, delay, 1)
        for pole in POLES
        for delay in DELAYS
        for valve in range(1, valves)
    ]


def _lagged(x: FloatArray, pole: float, order: int) -> FloatArray:
    """Columns behind a lag or an integrator; that of order 2 has a lag of 0.8 besides.

    That of order 3 has one pole, and a dead time that ends half-way between two samples.
    """
    rows = lfilter([1.0 - pole or 1.0], [1.0, -pole], x.T)
    if order == 3:
        rows[:, 1:] = 0.5 * (rows[:, 1:] + rows[:, :-1])
    if order == 2:
        pole = 0.8 if pole == 1.0 else pole
        rows = lfilter([1.0 - pole], [1.0, -pole], rows)
    return rows.T


def _path(moves: FloatArray, plant: _Plant) -> FloatArray:
    late = np.zeros_like(moves)
    late[plant.delay :] = moves[: -plant.delay]
    return _lagged(late[:, np.newaxis], plant.pole, plant.order)[:, 0]


def _screened(
    y: FloatArray, moves: FloatArray, ends: list[int], noise: FloatArray, sign: float
) -> list[_Plant]:
    """The best plants of each kind under the noise of the measurement itself.

    Whitening and a plant's filter change places: each actuator is whitened once.
    """
    first = ends[-1]
    # Short logs have a short past: no dead time is longer.
    plants = [plant for plant in _plants(moves.shape[1]) if plant.delay <= first]
    white_y = _errors(y[:, np.newaxis], ends, noise)[:, 0]
    before = np.concatenate([np.zeros((first, moves.shape[1])), moves])  # it rests before the log
    white = before[first:].copy()
    for coefficient, past in zip(noise[:, 0], _means(before, ends), strict=True):
        white -= coefficient * past
    left = np.empty(len(plants))
    lagged = dict[tuple[float, int, bool], FloatArray]()
    groups = dict[tuple[float, int, int, bool], list[int]]()
    for i, plant in enumerate(plants):
        groups.setdefault((plant.pole, plant.order, plant.delay, plant.valve == 0), []).append(i)
    for (pole, order, delay, linear), members in groups.items():
        key = (pole, order, linear)
        if key not in lagged:
            lagged[key] = _lagged(white[:, :1] if linear else white[:, 1:], pole, order)
        x = lagged[key][first - delay : -delay]
        product = white_y @ x
        power = np.einsum("ik,ik->k", x, x) - x.shape[0] * x.mean(axis=0) ** 2
        left[members] = np.where(product * sign > 0.0, -(product**2) / (power + 1e-12), 0.0)
    is_linear = np.array([plant.valve == 0 for plant in plants])
    chosen = [
        np.flatnonzero(kind)[np.argsort(left[kind])[:BEST]] for kind in (is_linear, ~is_linear)
    ]
    return [plants[int(i)] for i in np.concatenate(chosen)]


def around(bands: list[float], shares: list[float]) -> tuple[float, float, float, float]:
    """Least and greatest band and slip between the neighbours of those that were tried.

    Args:
        bands: Bands, of `BANDS`.
        shares: Slips over bands, of `SLIPS`.
    """
    found = list[float]()
    for tried, values in ((BANDS, bands), (SLIPS, shares)):
        edges = [tried[0], *(0.5 * (a + b) for a, b in pairwise(tried)), 1.0]
        at = [min(range(len(tried)), key=lambda i: abs(tried[i] - value)) for value in values]
        found += [edges[min(at)] if min(at) else 0.0, edges[max(at) + 1]]
    return found[0], found[1], found[2], found[3]


def _scaled(valve: Valve, size: float) -> Valve:
    return Valve(valve.band * size, valve.slip * size, valve.ahead)


def _means(x: FloatArray, ends: list[int]) -> FloatArray:
    """Means of the past over lags that double, shape (lags, samples less the longest, columns)."""
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    k = np.arange(ends[-1], x.shape[0])
    return np.array([(total[k - a] - total[k - b]) / (b - a) for a, b in pairwise(ends)])


def _noise(left: FloatArray, ends: list[int], weight: FloatArray | None = None) -> FloatArray:
    """Autoregression of each column, shape (lags, columns)."""
    past, now = _centred(_means(left, ends)), _centred(left[np.newaxis, ends[-1] :])[0]
    weighted = past if weight is None else past * weight
    normal = np.einsum("ink,jnk->kij", weighted, past)
    # The ridge is far below rounding of logged values; a constant column would be singular.
    normal += (1e-9 * np.trace(normal, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(
        past.shape[0]
    )
    wanted = np.einsum("ink,nk->ki", weighted, now)
    return np.asarray(np.linalg.solve(normal, wanted[..., None])[..., 0].T)


def _centred(x: FloatArray) -> FloatArray:
    return np.asarray(x - x.mean(axis=1, keepdims=True))


def _errors(x: FloatArray, ends: list[int], phi: FloatArray) -> FloatArray:
    """Prediction errors a sample ahead of columns under their autoregressions."""
    errors = x[ends[-1] :].copy()
    for coefficient, past in zip(phi, _means(x, ends), strict=True):
        errors -= coefficient * past
    return np.asarray(errors - errors.mean(axis=0))


def _gains(
    white_x: FloatArray, white_y: FloatArray, weight: FloatArray, sign: float
) -> FloatArray:
    """Gain of each path by least squares, zero where it has not the sign of the loop's."""
    gains = (weight * white_x * white_y).sum(axis=0) / ((weight * white_x**2).sum(axis=0) + 1e-12)
    return np.where(gains * sign > 0.0, gains, 0.0)


def _left_out(errors: FloatArray, linear: BoolArray) -> FloatArray:
    """Gain in log likelihood of each block, of models weighted by the other folds."""
    block = np.arange(errors.shape[0]) * BLOCKS // errors.shape[0]
    squares = np.array([(errors[block == b] ** 2).sum(axis=0) for b in range(BLOCKS)])
    samples = np.bincount(block, minlength=BLOCKS)
    gains = np.zeros(BLOCKS)
    for fold in range(FOLDS):
        out = np.arange(BLOCKS) % FOLDS == fold
        count = int(samples[~out].sum())
        variance = squares[~out].sum(axis=0) / count + 1e-300
        known = -0.5 * count * np.log(variance)
        foretold = -0.5 * (squares[out] / variance + samples[out, np.newaxis] * np.log(variance))
        mixed = [
            _log_mean(foretold[:, kind] + known[kind]) - _log_mean(known[kind][np.newaxis])
            for kind in (linear, ~linear)
        ]
        gains[out] = mixed[1] - mixed[0]
    return gains


def _alone(y: FloatArray, ends: list[int]) -> FloatArray:
    """Errors of the noise model by itself, fitted as it is beside a plant."""
    weight = np.ones((1, 1))
    for _ in range(6):
        errors = _errors(y, ends, _noise(y, ends, weight))
        weight = (HEAVY + 1.0) / (HEAVY + errors**2 / _scale(errors))
    return errors


def _scale(errors: FloatArray) -> FloatArray:
    """Most likely scale of each column by Student's law."""
    squares = errors**2
    scale = np.asarray(squares.mean(axis=0) + 1e-300)
    for _ in range(8):  # the ninth moves none by 1 %
        weighted = squares * (HEAVY + 1.0) / (HEAVY + squares / scale)
        scale = np.asarray(weighted.mean(axis=0) + 1e-300)
    return scale


def _log_mean(x: FloatArray) -> FloatArray:
    """Logarithm of the mean of exponentials along the last axis."""
    most = x.max(axis=-1, keepdims=True)
    return np.asarray(most[..., 0] + np.log(np.exp(x - most).mean(axis=-1)))


def _slow(y: FloatArray, paths: FloatArray, length: float, sign: float) -> float:
    """Least share that a loop leaves where it runs on over a swing."""
    by = max(1, round(length / PER_SWING))
    rows = y.size // by * by
    keep = float(np.exp(-by / length))

    def passed(x: FloatArray) -> FloatArray:
        """Means at the pace of the swings, without what is slower than one."""
        return lfilter([1.0, -1.0], [1.0, -keep], x)[..., 3:]

    means = y[:rows].reshape(-1, by).mean(axis=1)
    moves, ran = passed(means - means[0]), passed(np.ascontiguousarray(paths[:rows:by].T))
    product, power = ran @ moves, (ran**2).sum(axis=1)
    gains = product / (power + 1e-12)
    left = np.where(gains * sign > 0.0, 1.0 - gains * product / float(moves @ moves + 1e-300), 1.0)
    return float(left.min())
