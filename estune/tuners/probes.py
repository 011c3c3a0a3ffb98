"""Probes beyond the trust region: along the axes of the model, and across plateaus.

The axis probe places one trial far up and one far down each axis of the local model.

The plateau scan follows parameters without visible effect. A gain far too small has no effect: the
cost is flat over many times the gain, and no trial near the centre can tell such a plateau from an
optimum. So the scan goes up and down each parameter along which the model allows the cost to be
flat: two half steps, then steps of a factor e, until the cost rises, a limit is near, or the
bounds are reached. Two points in a row well below the centre become the new centre.
"""

import math
from statistics import fmean
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.tuners.acquisition import TrustRegion
from estune.tuners.local_cubic import LocalCubicModel

STEP = 1.0
"""Length of a step, in logarithms."""

CAREFUL_STEPS = 2
"""Number of half steps, made only where the model predicts little rise: an edge of stability may
be near. Further away the model has no information."""

SIGNIFICANT_SDS = 2.5
"""Standard deviations beyond which a difference is more than noise."""

RISE_MAX = 0.1
"""A rise of the cost, relative to it, that ends the scan at any noise."""

FLAT_RISE = 0.25
"""A predicted rise over one step below this may be none."""


def axis_probe_point(
    direction: int, model: LocalCubicModel, region: TrustRegion, radius: float, rise: float
) -> FloatArray:
    """A point far along one axis of the model, nearer by halves until it is safe.

    Args:
        direction: Twice the number of the axis, and one more for down.
        region: Centre, bounds and constraints.
        radius: Longest distance from the centre.
        rise: Greatest predicted rise of the log cost.
    """
    axis, down = divmod(direction, 2)
    far = min(radius, math.sqrt(2.0 * rise / float(model.curvatures[axis])))
    away = (1.0 - 2.0 * down) * far * model.axes[:, axis]
    points = region.clip(region.centre + np.outer((1.0, 0.5, 0.25, 0.0), away))
    safe = region.constraint_violation(*model.predict(points)) <= 0.0
    chosen: FloatArray = points[int(np.argmax(safe)) if safe.any() else -1]
    return chosen


class PlateauScan(NamedTuple):
    """The trials of a scan along one direction.

    Attributes:
        log_costs: The latest last.
        centre_log_cost: At the centre of the search.
        noise: Standard deviation of one trial.
    """

    log_costs: tuple[float, ...]
    centre_log_cost: float
    noise: float

    @property
    def found_higher_cost(self) -> bool:
        """Whether the last trial cost more than the centre or one before."""
        most = min(SIGNIFICANT_SDS * self.noise, RISE_MAX)
        last = self.log_costs[-1]
        # Of two trials each has noise, the centre has next to none.
        return (
            last - self.centre_log_cost > most
            or last - min(self.log_costs) > math.sqrt(2.0) * most
        )

    @property
    def found_lower_cost(self) -> bool:
        """Whether the last two trials cost less than the centre, significantly in the mean."""
        below = [self.centre_log_cost - cost for cost in self.log_costs[-2:]]
        least = SIGNIFICANT_SDS * self.noise / math.sqrt(2.0)
        return len(below) == 2 and min(below) > self.noise and fmean(below) > least


def next_scan_point(
    direction: int, steps: int, point: FloatArray, region: TrustRegion
) -> FloatArray | None:
    """A point further along a direction; None where the bounds are near.

    Args:
        direction: Twice the number of the parameter, and one more for down.
        steps: Steps made along it before.
        point: Where the step begins, shape (n,).
    """
    parameter, down = divmod(direction, 2)
    length = STEP if steps >= CAREFUL_STEPS else 0.5 * STEP
    further = point.copy()
    further[parameter] += (1.0 - 2.0 * down) * length
    further = region.clip(further)
    return further if math.dist(further, point) > 0.5 * length else None


def may_be_flat(model: LocalCubicModel, point: FloatArray) -> bool:
    """Whether the predicted cost at a point is so little above the centre's that it may be equal.

    By its prior of other loops the model expects every parameter to have an effect; trials near
    the centre, where a small rise is noise, hardly contradict.
    """
    mean, _ = model.predict(point[np.newaxis])
    return float(mean[0, 0]) - model.log_cost < FLAT_RISE
