"""Strides along a parameter that seems to do nothing, to see where it does something.

A gain far too small has no effect: the cost is level over many times the gain, and nothing near
the centre tells such a shelf from an optimum. So the search strides up and down each parameter
along which the model leaves it open that nothing happens, by the root of e twice and then by a
factor e each time, until the cost rises, a limit is near, or the bounds are there. Two strides in
a row well below the centre have found a better place.
"""

import math
from statistics import fmean
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.tuners.acquisition import TrustRegion
from estune.tuners.local_cubic import LocalCubicModel

STRIDE = 1.0
"""Length of a stride, in logarithms."""

CAREFUL = 2
"""So many strides are half as long, and made only where the model expects little rise: an edge of
stability may be near. Further away the model knows nothing."""

NOTICED = 2.5
"""Standard deviations from which on a difference is more than noise."""

RISE_MOST = 0.1
"""A rise of the cost, relative to it, that ends the strides however strong the noise."""

DOUBTED = 0.25
"""A rise of the cost by less, over a stride, is not believed before it is seen."""


class PlateauScan(NamedTuple):
    """What the strides along one direction have cost.

    Attributes:
        costs: Logarithms, the latest last.
        level: That of the cost at the centre.
        noise: Standard deviation of one trial.
    """

    costs: tuple[float, ...]
    level: float
    noise: float

    @property
    def rose(self) -> bool:
        """Whether the last cost more than the centre or one before."""
        most = min(NOTICED * self.noise, RISE_MOST)
        last = self.costs[-1]
        # Of two trials each has noise, the centre has next to none.
        return last - self.level > most or last - min(self.costs) > math.sqrt(2.0) * most

    @property
    def found_lower_cost(self) -> bool:
        """Whether the last two cost less than the centre, each, and more surely in the mean."""
        below = [self.level - cost for cost in self.costs[-2:]]
        doubt = NOTICED * self.noise / math.sqrt(2.0)
        return len(below) == 2 and min(below) > self.noise and fmean(below) > doubt


def next_scan_point(
    number: int, made: int, point: FloatArray, reach: TrustRegion
) -> FloatArray | None:
    """A point further up or down a parameter; None where the bounds are near.

    Args:
        number: Twice that of the parameter, and one more for down.
        made: Strides made along it before.
        point: Where the stride begins, shape (n,).
        reach: The bounds.
    """
    parameter, down = divmod(number, 2)
    length = STRIDE if made >= CAREFUL else 0.5 * STRIDE
    further = point.copy()
    further[parameter] += (1.0 - 2.0 * down) * length
    further = reach.bounded(further)
    return further if math.dist(further, point) > 0.5 * length else None


def may_be_flat(model: LocalCubicModel, point: FloatArray) -> bool:
    """Whether a point is expected to cost so little more than the centre that it may not.

    What the model knows of other loops, on which every parameter does something, says that it
    does; trials near the centre, where a little more cost is noise, hardly contradict.
    """
    mean, _ = model.expected(point[np.newaxis])
    return float(mean[0, 0]) - model.level < DOUBTED
