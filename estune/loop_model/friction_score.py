"""Whether the errors of a linear fit show dry friction.

The score is the slope of the likelihood along the size of the friction, less what the linear fit
and any linear predictor (`linear_past`) explain of it. It takes no search: a linear fit of small
motion takes friction for a load, and is white with it.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import chain

import numpy as np

from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.friction_motion import FrictionMotion, forces_of, less_friction, two_poles
from estune.loop_model.least_squares import Solution
from estune.loop_model.limited_loop import setpoint_response
from estune.loop_model.linear_past import less, linear_answers, linear_past, orthonormal
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.records import LoopRecord, rounding_std

SHARES = (0.01, 0.03, 0.1, 0.25)
"""Sizes of friction that a search begins from, over the effort of a step."""

SCORED = 2
"""Records whose errors are looked at: with many more what any model leaves shows as something."""

LAGS = 8
"""Samples before that a linear predictor knows. It leaves noise of any colour of the sensor."""

RESOLVED = 1e-6
"""Least share of a slope that is not explained otherwise: below it is rounding."""

ROUNDING_SHARE = 0.3
"""What friction moves the measurement by, over the error of its rounding, from which it is told:
an encoder's steps are a law of motion as well, and in a long log explain 0.05 of themselves."""

CHANCE = 1e-3
"""Probability that errors of a loop without friction are taken to show some."""


def grid_of_poles(linear: LoopFit) -> list[FloatArray]:
    """The first two poles of a fit, and others that its settling time allows."""
    w = 2.0 * math.pi / linear.settling_samples
    others = [np.log([w * f, z]) for f in (0.3, 0.7, 1.5) for z in (0.2, 0.7)]
    return [np.array(two_poles(linear.model).coordinates), *others]


def friction_score(
    motion: FrictionMotion, linear: LoopFit, answers: Sequence[tuple[FloatArray, FloatArray]] = ()
) -> float:
    """Largest score of a friction that a linear fit does not have, in standard deviations.

    It is the slope of the likelihood along the size of the friction, less what the parameters of
    the linear fit, the past and the answers to the setpoint, where they are known, explain of it,
    by its own scatter.
    """
    signals, model = motion.signals, linear.model
    at = Solution.at(signals, np.array(model.coordinates), model.dead_samples, linear.noise)
    linear_laws = chain(at.slopes(signals).T, linear_past(signals, LAGS))
    if answers:
        linear_laws = chain(linear_laws, linear_answers(signals, answers))
    known = orthonormal(signals.samples, linear_laws)
    errors = less(at.residual, known)
    rounding = max(rounding_std(motion.records[i].measurement) for i in range(signals.records))
    grid = [np.array([*p, share, 0.0]) for p in grid_of_poles(linear) for share in SHARES]
    scores = [0.0]
    for force in _forces(motion, grid):
        driven = less_friction(signals, force)
        moved = Solution.at(driven, at.coordinates, at.dead, at.noise, at.numerator)
        whole = at.residual - moved.residual
        slope = less(whole, known)
        power = float(slope @ slope)
        if power <= RESOLVED**2 * float(whole @ whole):
            continue
        size = float(slope @ errors) / power
        if size * math.sqrt(power / errors.size) > ROUNDING_SHARE * rounding:
            scores.append(float(slope @ errors) / float(np.linalg.norm(slope * errors)))
    return max(scores)


def _forces(motion: FrictionMotion, grid: Sequence[FloatArray]) -> Iterator[list[FloatArray]]:
    """Friction of each group at the points of a grid, of as many at a time as fit in 128 MB."""
    at_once = max((1 << 24) // motion.signals.samples, 1)
    for start in range(0, len(grid), at_once):
        part = grid[start : start + at_once]
        forces = forces_of(motion, part)
        for i in range(len(part)):
            yield [force[i] for force in forces]


def shows_friction(
    motion: FrictionMotion, linear: LoopFit, answers: Sequence[tuple[FloatArray, FloatArray]] = ()
) -> bool:
    """Whether the errors of a linear fit show friction beyond chance."""
    from scipy.special import ndtri  # noqa: PLC0415  slow to import

    tried = len(SHARES) * len(grid_of_poles(linear))
    return friction_score(motion, linear, answers) > -float(ndtri(CHANCE / tried))


def hides_friction(
    records: Sequence[LoopRecord], linear: LoopFit, controller: ControllerSettings
) -> bool:
    """Whether the errors of a fit without friction show some.

    Friction in small motion, under a load that moves as much, is explained by no size of it; Ms
    is then read as 1.20 for 1.79.
    """
    gain, scored = linear.model.static_gain, records[:SCORED]
    if linear.model.friction or not (gain and math.isfinite(gain)):
        return False
    two = linear._replace(model=two_poles(linear.model))
    answers = [
        setpoint_response(linear.model, record, record.gains, controller)
        for record in scored
        if record.gains is not None
    ]
    known = len(answers) == len(scored) and all(np.isfinite(one).all() for one in answers)
    return shows_friction(FrictionMotion.of(scored, two), linear, answers if known else ())
