"""Identification of a loop with dry friction.

The first pair of poles is a mass on a spring, of position x and unit gain, and friction takes off
what it can of each step (a proximal step: Moreau, Numerical aspects of the sweeping process,
1999), so that it opposes every motion and sticks exactly:

    x(k+1) = x(k) + s - a f(k),     a f(k) = clip(s, -a F, a F),     a = 1 + a1 + a2
    s = -(1 + a1) x(k) - a2 x(k-1) + a u(k)

so that y = q^-(d+1) B/A (u - f) + H e is linear in u - f (`least_squares`). A record begins at
rest with friction of an unknown size, the same in all. Searched are the poles, F and that size.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.identification import PoleFit, by_cost, search_dead_time
from estune.loop_model.least_squares import FitSignals, Solution, signals_of
from estune.loop_model.loop_fit import NUISANCE, LoopFit, Residuals, summarise
from estune.loop_model.model import LoopModel
from estune.loop_model.noise_model import NoiseModel
from estune.loop_model.poles import sections_of
from estune.loop_model.records import LoopRecord

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
"""Coordinates whose forces are kept: searches at other dead times begin from them."""

FRICTION_MIN = 1e-9
"""Least size of friction, over the effort of a step."""

DIVERGED_N = 1e9
"""Force in place of one that is not a number, of a mass whose poles are unstable."""


class _Motion(NamedTuple):
    """Records with what the mass needs beside their deviations.

    Attributes:
        signals: The records.
        records: The same.
        rest: Of each group the position before the record less its mean, in N of effort.
        rest_effort: Mean effort before the step.
        scale: Effort that a step needs, N.
        poles: Number of poles.
        noise: The noise.
        known: Forces at the last coordinates, by their bytes.
    """

    signals: FitSignals
    records: tuple[LoopRecord, ...]
    rest: tuple[FloatArray, ...]
    rest_effort: float
    scale: float
    poles: int
    noise: NoiseModel
    known: dict[bytes, list[FloatArray]]

    @classmethod
    def of(cls, records: Sequence[LoopRecord], like: LoopFit) -> "_Motion":
        """The motion of records of a plant like an earlier fit."""
        gain, settling = like.model.static_gain, like.settling_samples
        signals = signals_of(records, settling, round(settling))
        rests = [float(r.measurement_N[: max(r.step_index, 1)].mean()) for r in records]
        mean = float(np.mean(rests))
        return cls(
            signals=signals,
            records=tuple(records),
            rest=tuple(
                np.array([(rests[i] - mean) / gain for i in group.members])
                for group in signals.groups
            ),
            rest_effort=float(np.mean([r.rest_effort_N for r in records])),
            scale=abs(records[0].span_N / gain),
            poles=like.order,
            noise=like.noise,
            known={},
        )

    def split(self, x: FloatArray) -> tuple[FloatArray, float, float]:
        """Poles, F in N, and the share of it that holds at rest as an area tangent."""
        n = self.poles
        return x[:n], self.scale * abs(float(x[n])), float(x[n + 1])


def fit_with_friction(
    records: Sequence[LoopRecord], linear: LoopFit, last: LoopFit | None = None
) -> LoopFit | None:
    """The loop model with dry friction that fits records best; None where none was found.

    Args:
        records: At least one.
        linear: The linear model of least squares.
        last: An earlier fit with friction to start from.
    """
    gain = (last or linear).model.static_gain
    if not (math.isfinite(gain) and gain != 0.0):
        return None
    warm = None
    if last is not None:
        motion, model = _Motion.of(records, last), last.model
        x = np.array([*model.coordinates, model.friction_N / motion.scale, 0.0])
        search = partial(_search, motion)
        start = search(PoleFit(math.inf, x, model.dead_samples), model.dead_samples)
        warm = _summarise(motion, search_dead_time(search, start))
        if warm.misfit < MISFIT_DONE:
            return warm
    two = linear._replace(model=_two_poles(linear.model))
    motion, screened = _Motion.of(records, two), _Motion.of(records[:SCREENED], two)
    few = sorted((_search(screened, one, one.dead) for one in _starts(screened, two)), key=by_cost)
    search = partial(_search, motion)
    best = search_dead_time(search, min((search(f, f.dead) for f in few[:STARTS]), key=by_cost))
    cold = _summarise(motion, best)
    return warm if warm is not None and warm.residual_N <= cold.residual_N else cold


def _two_poles(model: LoopModel) -> LoopModel:
    """The model of the first pair alone, with the same gain."""
    if model.order == 2:
        return model
    coordinates = (model.coordinates * 2)[:2] if model.order == 1 else model.coordinates[:2]
    unit = float(sections_of(coordinates)[0].powers[0])
    return LoopModel(coordinates, (model.static_gain * unit, 0.0, 0.0), model.dead_samples)


def _starts(motion: _Motion, linear: LoopFit) -> list[PoleFit]:
    """The best of a coarse grid of poles and friction, at each dead time and of each size."""
    w = 2.0 * math.pi / linear.settling_samples
    poles = [np.array(linear.model.coordinates)]
    poles += [np.log([w * f, z]) for f in (0.3, 0.7, 1.5) for z in (0.2, 0.7)]
    grid = [np.array([*pole, share, 0.0]) for pole in poles for share in SHARES]
    forces = _forces(motion, grid)
    # What sticks until the effort has grown looks like dead time to a linear model.
    dead_samples = linear.model.dead_samples
    delays = sorted({1, 2, 4, dead_samples // 3, dead_samples})
    tried = [
        (_solution(motion, x, [force[i] for force in forces], dead).cost, i, dead)
        for i, x in enumerate(grid)
        for dead in delays
    ]
    best = {min(one for one in tried if one[2] == dead) for dead in delays}
    best |= {min(t for t in tried if t[1] % len(SHARES) == n) for n in range(len(SHARES))}
    return [PoleFit(cost, grid[i], dead) for cost, i, dead in sorted(best)]


def _search(motion: _Motion, start: PoleFit, dead: int) -> PoleFit:
    """Least squares from a start, by Levenberg and Marquardt."""
    from scipy.optimize import least_squares  # noqa: PLC0415  slow to import

    def residual_of(x: FloatArray, forces: list[FloatArray]) -> FloatArray:
        # Without a reversal only the change of the friction shows: then it holds nothing at rest.
        _, friction_N, held = motion.split(x)
        left = _solution(motion, x, forces, dead).residual
        return np.append(left, friction_N * math.tanh(held))

    def jacobian(x: FloatArray) -> FloatArray:
        about = _about(motion, x)
        ends = [
            residual_of(moved, [force[i] for force in about])
            for i, moved in enumerate(_beside(x), 1)
        ]
        pairs = zip(ends[::2], ends[1::2], strict=True)
        return np.stack([(up - down) / (2.0 * DIFFERENCE) for up, down in pairs], axis=1)

    def residual(x: FloatArray) -> FloatArray:
        return residual_of(x, [force[0] for force in _about(motion, x)])

    found = least_squares(
        residual, start.coordinates, jac=jacobian, method="lm", xtol=1e-5, ftol=1e-6, max_nfev=25
    )
    return PoleFit(float(found.cost), found.x, dead)


def _solution(motion: _Motion, x: FloatArray, forces: list[FloatArray], dead: int) -> Solution:
    """Best numerator for given forces of each group, shape (records, samples)."""
    driven = less_friction(motion.signals, forces)
    return Solution.at(driven, motion.split(x)[0], dead, motion.noise)


def less_friction(signals: FitSignals, forces: list[FloatArray]) -> FitSignals:
    """The records with the friction taken off their effort."""
    groups = (
        group._replace(effort=group.effort - (force - force[:, :1]))
        for group, force in zip(signals.groups, forces, strict=True)
    )
    return signals._replace(groups=tuple(groups))


def friction_of(model: LoopModel, signals: FitSignals, record: LoopRecord) -> list[FloatArray]:
    """The friction of a model on one record, which begins without any."""
    if not model.friction_N:
        return [np.zeros((1, record.samples)) for _ in signals.groups]
    a, most = model.sections[0].taps[np.newaxis], np.array([model.friction_N])
    rest = np.array([[record.rest_effort_N]])
    return [friction_force(record.effort_N[np.newaxis], a, most, rest)[0]]


def _about(motion: _Motion, x: FloatArray) -> list[FloatArray]:
    """Forces at a point and to both sides of it along each coordinate, all in one run."""
    key = x.tobytes()
    if key not in motion.known:
        if len(motion.known) >= KNOWN_MAX:
            del motion.known[next(iter(motion.known))]
        motion.known[key] = _forces(motion, [x, *_beside(x)])
    return motion.known[key]


def _beside(x: FloatArray) -> list[FloatArray]:
    """Points to both sides along each coordinate."""
    return [x + s * e for e in DIFFERENCE * np.eye(x.size) for s in (1, -1)]


def _forces(motion: _Motion, coordinates: Sequence[FloatArray]) -> list[FloatArray]:
    """Friction of each group at several coordinates, shape (coordinates, records, samples)."""
    parts = [motion.split(x) for x in coordinates]
    a = np.array([sections_of(poles)[0].taps for poles, *_ in parts])
    friction = np.array([size for _, size, _ in parts])
    held = friction * np.tanh([part[2] for part in parts])
    found = []
    for group, rest in zip(motion.signals.groups, motion.rest, strict=True):
        effort = np.array([motion.records[i].effort_N for i in group.members])
        start = motion.rest_effort + held[:, np.newaxis] + rest
        found.append(friction_force(effort, a, friction, start))
    return found


def friction_force(
    effort: FloatArray, a: FloatArray, most: FloatArray, rest: FloatArray
) -> FloatArray:
    """Friction on masses on springs, N, shape (masses, records, samples).

    Args:
        effort: Shape (records, samples).
        a: Denominators of the two poles, shape (masses, 3).
        most: Size of the friction, N, shape (masses,).
        rest: Position before the first sample, N, shape (masses, records).
    """
    unit = a.sum(axis=1)[:, np.newaxis]
    first, second = -(1.0 + a[:, 1:2]), -a[:, 2:3]
    limit = unit * most[:, np.newaxis]
    columns = np.multiply.outer(effort.T, unit[:, 0]).transpose(0, 2, 1)
    taken = np.empty((effort.shape[1], *rest.shape))
    now = before = rest
    with np.errstate(over="ignore", invalid="ignore"):
        for k, push in enumerate(columns):
            step = first * now + second * before + push
            off = np.minimum(np.maximum(step, -limit), limit)
            taken[k] = off
            before, now = now, now + step - off
        taken /= unit
    taken = np.nan_to_num(taken, nan=DIVERGED_N, posinf=DIVERGED_N, neginf=-DIVERGED_N)
    return taken.transpose(1, 2, 0)


def _summarise(motion: _Motion, best: PoleFit) -> LoopFit:
    """The fit with its covariances and its misfit."""
    x = best.coordinates
    at = _solution(motion, x, [f[0] for f in _about(motion, x)], best.dead)
    poles, friction_N, _ = motion.split(x)
    model = LoopModel(
        tuple(poles.tolist()),
        tuple(at.numerator.tolist()),
        best.dead,
        max(friction_N, FRICTION_MIN * motion.scale),
    )
    left = Residuals(
        at.residual,
        _slopes(motion, x, at, best.dead),
        float(np.abs(at.regressors @ at.numerator).max()),
        NUISANCE,
    )
    return summarise(motion.records, motion.signals, model, motion.noise, left)


def _slopes(motion: _Motion, x: FloatArray, at: Solution, dead: int) -> FloatArray:
    """Slopes of the residual along the model's parameters, shape (residuals of all, parameters).

    What holds at rest counts as known: without a reversal it cannot be told from the friction.
    """
    about = _about(motion, x)
    ends = [
        Solution.at(
            less_friction(motion.signals, [force[i] for force in about]),
            motion.split(moved)[0],
            dead,
            motion.noise,
            at.numerator,
        ).residual
        for i, moved in enumerate(_beside(x), 1)
    ]
    moved = [
        (up - down) / (2.0 * DIFFERENCE) for up, down in zip(ends[::2], ends[1::2], strict=True)
    ]
    n = motion.poles
    sign = math.copysign(1.0, x[n])
    friction = sign * moved[n][:, np.newaxis] / motion.scale
    return np.concatenate([np.stack(moved[:n], 1), -at.regressors, friction], axis=1)
