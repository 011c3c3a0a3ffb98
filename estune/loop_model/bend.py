"""A spring and a sensor whose slopes change with the measurement, in a loop that is else linear.

With x = (y - y_1)/s the distance of the measurement y from the end y_1 of a step of size s,

    y + s (b_2 x^2 + b_3 x^3) = G (u + s (a_2 x^2 + a_3 x^3)):

a sensor that is not straight bends the measurement, a spring the effort that it works against,
without the dead time of the effort.
All terms are level at the end of the step, so that G is the plant there.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.records import LoopRecord

POWERS = (2, 3)
"""Powers of x. Without the third a sensor of slope 0.72 at the end of the step was left 0.05 % of
it and six poles for two."""

LEAST, MOST = -2.0, 1.0
"""Ends of x, beyond which the terms stay: no trial shows them further."""


class Bend(NamedTuple):
    """The terms of spring and sensor; none of a straight plant.

    Attributes:
        effort: a_2 and a_3, in effort per measurement.
        measurement: b_2 and b_3.
        level: y_1.
        size: s.
        ahead: Samples that the spring is ahead of the measurement: the dead time.
    """

    effort: tuple[float, ...] = (0.0,) * len(POWERS)
    measurement: tuple[float, ...] = (0.0,) * len(POWERS)
    level: float = 0.0
    size: float = 1.0
    ahead: int = 0

    @property
    def is_straight(self) -> bool:
        """Whether all terms are zero."""
        return not any(self.effort + self.measurement)

    @property
    def terms(self) -> FloatArray:
        """All of them, the effort's first."""
        return np.array([*self.effort, *self.measurement])

    def with_terms(self, terms: FloatArray) -> "Bend":
        """The bend with other terms at the same level."""
        numbers = [float(term) for term in terms]
        count = len(POWERS)
        return self._replace(effort=tuple(numbers[:count]), measurement=tuple(numbers[count:]))

    def shapes(self, measurement: FloatArray) -> FloatArray:
        """The shapes of all terms, s x^2 and s x^3 of spring and sensor, shape (4, samples)."""
        x = np.clip((measurement - self.level) / self.size, LEAST, MOST)
        later = np.concatenate([x[self.ahead :], np.repeat(x[-1:], self.ahead + 1)])
        # Over a sample the effort stands and the measurement moves: a spring takes its mean.
        early = 0.5 * (later[: x.size] + later[1 : x.size + 1])
        return np.array([self.size * at**power for at in (early, x) for power in POWERS])

    def steepness(self, gain: float) -> float:
        """The larger slope over the smaller one, of spring or sensor, at both ends of the step.

        Infinite where one is negative.

        Args:
            gain: Static gain of the plant at the end of the step.
        """
        powers = np.array(POWERS)
        at_rest = powers * (-1.0) ** (powers - 1)
        spring = 1.0 - gain * float(at_rest @ self.effort)
        slopes = spring, 1.0 + float(at_rest @ self.measurement)
        least, most = min(slopes), max(slopes)
        return max(most, 1.0 / least) if least > 0.0 else math.inf


STRAIGHT = Bend()


def level_of(records: Sequence[LoopRecord]) -> Bend | None:
    """A straight bend at the end of the first step; None where a record begins in motion."""
    step = next((r for r in records if r.is_step and r.step_size), None)
    if step is None or not all(r.at_rest for r in records):
        return None
    size = step.step_size
    level = float(step.measurement[: max(step.step_index, 1)].mean()) + size
    return Bend(level=level, size=size)


def unbent(record: LoopRecord, bend: Bend) -> LoopRecord:
    """What the linear plant of a bent one sees in a record."""
    if bend.is_straight:
        return record
    shapes, count = bend.shapes(record.measurement), len(POWERS)
    return record._replace(
        effort=record.effort + np.array(bend.effort) @ shapes[:count],
        measurement=record.measurement + np.array(bend.measurement) @ shapes[count:],
    )
