"""Points of a search that an identified loop gives beside its optimum."""

import math
import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.margins import robustness
from estune.loop_model.model import LoopModel
from estune.loop_model.optimum import DERIVATIVE, SLOW_FILTER
from estune.tuners.search_space import Coordinates, Point, SearchSpace


def furthest_stable(
    space: SearchSpace,
    way: tuple[Coordinates, Point],
    model: LoopModel,
    settings: ControllerSettings,
    max_sensitivity: float | None,
) -> Point:
    """The furthest point on the way to a proposal at which a loop is stable.

    An oscillation that grows slowly may cost little within a trial. From gains beyond the limit
    of Ms, which are only just stable, no point of a larger Ms. The proposal itself where the
    model is wrong of the beginning of the way, the best trial.
    """
    base, proposal = np.array(way[0]), way[1]
    wanted = np.array(space.coordinates(proposal))

    def sensitivity(point: Point) -> float:
        return robustness(model, space.gains(point), settings).sensitivity

    here = sensitivity(space.point(tuple(base.tolist())))
    if not math.isfinite(here):
        return proposal
    most = here
    if max_sensitivity is None or here <= max_sensitivity:
        most = sys.float_info.max
    on_the_way = [base + share * (wanted - base) for share in (0.7, 0.45, 0.25, 0.1, 0.0)]
    points = [proposal, *(space.point(tuple(x.tolist())) for x in on_the_way)]
    return next((point for point in points if sensitivity(point) <= most), points[-1])


def with_other_derivative(
    space: SearchSpace, centre: Coordinates, settling_time_s: float
) -> Sequence[FloatArray]:
    """A centre with a derivative that matters, and that with a slow filter of the setpoint.

    None where the derivative is not tuned.
    """
    gains = space.gains(space.point(centre))
    if not gains.D:
        return []
    one = replace(gains, D=DERIVATIVE * gains.P * settling_time_s)
    slow = replace(one, setpoint_filter_s=SLOW_FILTER * settling_time_s)
    points = map(space.point_of, (one, slow) if gains.setpoint_filter_s else (one,))
    return [np.array(space.coordinates(point)) for point in points]
