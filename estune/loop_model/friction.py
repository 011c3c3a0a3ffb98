"""Identification of a loop with dry friction.

With the friction f of a mass on a spring (`friction_motion`) the plant is
y = q^-(d+1) B/A (u - f) + H e, linear in u - f (`least_squares`). Searched are the poles, the size
of the friction and what of it holds at rest, and in records of service the noise: a linear fit
takes friction for a load, and is white with it.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.friction_motion import FrictionMotion, forces_of, less_friction, two_poles
from estune.loop_model.friction_score import SHARES, grid_of_poles, shows_friction
from estune.loop_model.identification import (
    PoleFit,
    by_cost,
    least_point,
    remembered,
    search_dead_time,
)
from estune.loop_model.least_squares import Solution
from estune.loop_model.loop_fit import LoopFit, summarise
from estune.loop_model.records import LoopRecord

SCREENED = 2
STARTS = 3
"""Records by which the starts of a search are compared and improved, which with few reversals has
fewer local minima, and number of those that all records then improve."""

EVALUATIONS, FEW_EVALUATIONS = 25, 5
"""Evaluations of a search, and of one by which starts are compared: all of 54 fits, of reels with
0.002 to 0.05 N m and of plants without friction, ended at the cost that 25 lead to, to 0.1 %."""

TOLERANCES = (1e-6, 1e-5, 0.0)
"""Relative changes of the sum of squares and of the point at which a search ends."""

DIFFERENCE = 1e-4
"""Half the distance of the points of a numerical slope, in each coordinate."""

MISFIT_DONE = 0.001
"""Misfit from which an earlier fit is not all that a search begins from. Local minima leave 0.17 %
and more, the fits of the reference reel with its own friction 0.05 to 0.09 %."""

KNOWN_MAX = 4
"""Coordinates whose forces are kept: searches at other dead times begin from them."""

FRICTION_MIN = 1e-9
"""Least size of friction, over the effort of a step."""

SERVICE_STARTS = 2
SERVICE_LOADS = (1.0, 0.03)
"""In records of service, which have many reversals: number of starts that are improved, and sizes
of the load that they begin from, over that of the linear fit, which holds the friction, too."""


def fit_with_friction(
    records: Sequence[LoopRecord], linear: LoopFit, last: LoopFit | None = None
) -> LoopFit | None:
    """The loop model with dry friction that fits records best; None where none was found.

    From the linear fit of them, and an earlier one with friction where there is one.
    """
    gain = (last or linear).model.static_gain
    if not (math.isfinite(gain) and gain != 0.0):
        return None
    warm = None
    if last is not None:
        motion, model = FrictionMotion.of(records, last), last.model
        start_x = [*model.coordinates, model.friction / motion.scale, 0.0, *last.noise.logarithms]
        x = np.array(start_x)
        search = partial(_search, motion)
        start = search(PoleFit(math.inf, x, model.dead_samples), model.dead_samples)
        warm = _summarise(motion, search_dead_time(search, start))
        if warm.misfit < MISFIT_DONE:
            return warm
    two = linear._replace(model=two_poles(linear.model))
    motion, screened = FrictionMotion.of(records, two), FrictionMotion.of(records[:SCREENED], two)
    if all(record.at_rest for record in records):
        few = sorted(
            (_search(screened, f, f.dead, FEW_EVALUATIONS) for f in _starts(screened, two)),
            key=by_cost,
        )
    elif shows_friction(screened, linear):
        few = _starts(screened, two)[:SERVICE_STARTS]
    else:
        return None
    search = partial(_search, motion)
    best = search_dead_time(search, min((search(f, f.dead) for f in few[:STARTS]), key=by_cost))
    cold = _summarise(motion, best)
    return warm if warm is not None and warm.residual_std <= cold.residual_std else cold


def _starts(motion: FrictionMotion, linear: LoopFit) -> list[PoleFit]:
    """The best of a coarse grid of poles and friction, at each dead time and of each size."""
    poles = grid_of_poles(linear)
    loads = [math.log(size) for size in SERVICE_LOADS] if motion.noise.load else [0.0]
    noises = np.array(motion.noise.logarithms)
    first = np.arange(noises.size) == 0  # the load, where there is one
    grid = [
        np.array([*pole, share, 0.0, *(noises + load * first)])
        for load in loads
        for pole in poles
        for share in SHARES
    ]
    forces = forces_of(motion, grid)
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


def _search(
    motion: FrictionMotion, start: PoleFit, dead: int, evaluations: int = EVALUATIONS
) -> PoleFit:
    """Least squares from a start."""

    def residual_of(x: FloatArray, forces: list[FloatArray]) -> FloatArray:
        # Without a reversal only the change of the friction shows: then it holds nothing at rest.
        _, friction, held = motion.split(x)
        left = _solution(motion, x, forces, dead).residual
        return np.append(left, friction * math.tanh(held))

    @remembered
    def jacobian(x: FloatArray) -> FloatArray:
        return np.stack(_numerical_slopes(motion, x, residual_of), axis=1)

    @remembered
    def residual(x: FloatArray) -> FloatArray:
        return residual_of(x, [force[0] for force in _about(motion, x)])

    x = least_point(residual, start.coordinates, jacobian, TOLERANCES, evaluations)
    left = residual(x)
    return PoleFit(0.5 * float(left @ left), x, dead)


def _solution(
    motion: FrictionMotion,
    x: FloatArray,
    forces: list[FloatArray],
    dead: int,
    numerator: FloatArray | None = None,
) -> Solution:
    """Best or given numerator for given forces of each group, shape (records, samples)."""
    driven = less_friction(motion.signals, forces)
    return Solution.at(driven, motion.split(x)[0], dead, motion.noise_at(x), numerator)


def _numerical_slopes(
    motion: FrictionMotion,
    x: FloatArray,
    residual_of: Callable[[FloatArray, list[FloatArray]], FloatArray],
) -> list[FloatArray]:
    """Slopes along each coordinate of a residual by coordinates and their forces."""
    about = _about(motion, x)
    ends = [
        residual_of(moved, [force[i] for force in about]) for i, moved in enumerate(_beside(x), 1)
    ]
    pairs = zip(ends[::2], ends[1::2], strict=True)
    return [(up - down) / (2.0 * DIFFERENCE) for up, down in pairs]


def _about(motion: FrictionMotion, x: FloatArray) -> list[FloatArray]:
    """Forces at a point and to both sides of it along each coordinate, all in one run."""
    key = x.tobytes()
    if key not in motion.known:
        if len(motion.known) >= KNOWN_MAX:
            del motion.known[next(iter(motion.known))]
        motion.known[key] = forces_of(motion, [x, *_beside(x)])
    return motion.known[key]


def _beside(x: FloatArray) -> list[FloatArray]:
    """Points to both sides along each coordinate."""
    return [x + s * e for e in DIFFERENCE * np.eye(x.size) for s in (1, -1)]


def _summarise(motion: FrictionMotion, best: PoleFit) -> LoopFit:
    """The fit with its covariances and its misfit."""
    x = best.coordinates
    at = _solution(motion, x, [f[0] for f in _about(motion, x)], best.dead)
    friction = max(motion.split(x)[1], FRICTION_MIN * motion.scale)
    return summarise(motion.records, motion.signals, at, _slopes(motion, x, at), friction)


def _slopes(motion: FrictionMotion, x: FloatArray, at: Solution) -> FloatArray:
    """Slopes of the residual along the model's parameters, shape (residuals of all, parameters).

    What holds at rest counts as known: without a reversal it cannot be told from the friction.
    """

    def residual_of(x: FloatArray, forces: list[FloatArray]) -> FloatArray:
        return _solution(motion, x, forces, at.dead, at.numerator).residual

    moved, n = _numerical_slopes(motion, x, residual_of), motion.poles
    friction = math.copysign(1.0, x[n]) * moved[n][:, np.newaxis] / motion.scale
    further = [column[:, np.newaxis] for column in moved[n + 2 :]]
    return np.concatenate([np.stack(moved[:n], 1), -at.regressors, friction, *further], axis=1)
