"""State of the safe Bayesian search, and the log costs that its models see."""

import math
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.tuners.observation import COST_LIMIT
from estune.tuners.search_space import Coordinates, Point

UNSAFE = 1.0 + math.log(COST_LIMIT)
"""Stored log cost of a censored trial; no cost reaches it."""

LOG_COST_MAX = math.log(2.25)
"""Upper clip of the log cost over the start's; larger values carry no information."""

CLIFF = 1.25
"""Upper clip of the log cost over the least, as beyond the edge of stability."""


def clip_log_costs(log_costs: FloatArray) -> FloatArray:
    """Log costs over the start's, clipped where they carry no further information."""
    least = float(np.sort(log_costs)[:3].mean())
    return np.minimum(log_costs, min(LOG_COST_MAX, least + CLIFF))


class SafeBayesianState(NamedTuple):
    """The state of the search before trial k; coordinates are relative to the start."""

    k: int
    tried: tuple[float, ...]  # coordinates of all trials kept, one trial after the other
    log_costs: tuple[float, ...]  # UNSAFE where the trial was censored
    margins: tuple[float, ...]  # constraint margins, at most one
    centre: Coordinates
    curvature: tuple[float, ...]  # about the centre, by rows; empty before there is a local model
    noise: float  # standard deviation of one trial's log cost
    proposal: Point
    probed: int  # directions of the axis probe made, of 2 n
    scanned: int  # directions of the plateau scan begun, of 2 n
    scan_steps: int  # made along the last of them; zero between scans
    reference: float | None  # log cost of the first trials; None before they are made
    step_scale: float
    best_point: Point
    best_cost: float | None
