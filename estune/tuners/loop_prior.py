"""What the costs of all PIDF loops have in common, so that a search need not find it out anew.

In logarithms of the gains, relative to its least, the cost of one loop is much like that of
another, whatever its plant is and how fast: it bends most along P, less along I and D, least along
the setpoint filter's time constant; P and D may grow together, and P with the time constant, at
little cost. The numbers below say how much. They were fitted to searches on some 350 simulated
loops drawn at random: plants of the first to the fifth order, lightly and well damped, with and
without dead time and a limit of the effort, each with a cost of its own; `experiments.loop_prior`
draws others, fits the numbers anew and tells how much better than none they foretell a cost.

A parameter that is tuned is a direction in the four logarithms, see `SearchSpace.directions`: so
what is known of one form of the gains is known of the other, of fewer parameters, and of the mean
over several loops that are tuned as one.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.tuners.search_space import Directions

PRIOR_INFLATION = 1.4
"""A rig differs more from the loops simulated than they do from one another: slopes and what is
left over may be so many times larger than theirs."""


class CostPrior(NamedTuple):
    """What is known of a cost before the first trial; x are n logarithms from the start on.

    Attributes:
        slope: S, shape (n, 4 m) for m loops: the slopes have the covariance S S'.
        bowl: M, of the same shape: the bends come from the covariance (x'M M'y)^2.
        rest: B, of the same shape: what is neither changes as exp(-|B'(x - y)|^2/2).
        rest_size: Standard deviation of it.
        bend: C, shape (n, n): the mean rises as x'C x/2.
        curvature: H, shape (n, n): mean curvature about an optimum.
    """

    slope: FloatArray
    bowl: FloatArray
    rest: FloatArray
    rest_size: float
    bend: FloatArray
    curvature: FloatArray


PIDF_LOOP_PRIOR = CostPrior(
    slope=PRIOR_INFLATION
    * np.array(
        [
            [0.305, 0.0, 0.0, 0.0],
            [0.160, 0.357, 0.0, 0.0],
            [-0.028, -0.069, 0.147, 0.0],
            [-0.057, -0.028, -0.023, 0.0],
        ]
    ),
    bowl=np.array(
        [
            [0.089, 0.0, 0.0, 0.0],
            [-0.149, 0.230, 0.0, 0.0],
            [0.019, -0.187, 0.0, 0.0],
            [-0.005, 0.005, 0.0, 0.0],
        ]
    ),
    rest=np.array(
        [
            [2.048, 0.0, 0.0, 0.0],
            [-0.147, 2.133, 0.0, 0.0],
            [0.137, -0.932, 1.361, 0.0],
            [-0.207, -0.126, 0.029, 0.406],
        ]
    ),
    rest_size=PRIOR_INFLATION * 0.267,
    bend=np.array(
        [
            [0.108, -0.029, -0.005, -0.011],
            [-0.029, 0.222, -0.095, 0.016],
            [-0.005, -0.095, 0.044, -0.004],
            [-0.011, 0.016, -0.004, 0.004],
        ]
    ),
    curvature=np.array(
        [
            [1.40, -0.06, -0.25, -0.26],
            [-0.06, 0.95, -0.30, -0.03],
            [-0.25, -0.30, 0.65, 0.015],
            [-0.26, -0.03, 0.015, 0.15],
        ]
    ),
)
"""In the logarithms of P, I, D and the setpoint filter's time constant."""


@lru_cache(maxsize=64)
def cost_prior(directions: tuple[Directions, ...]) -> CostPrior:
    """What is known of the mean cost of loops whose parameters lead in these directions."""
    tables = [np.array(table) for table in directions]

    def beside(matrix: FloatArray) -> FloatArray:
        return np.hstack([table @ matrix for table in tables]) / math.sqrt(len(tables))

    def mean(matrix: FloatArray) -> FloatArray:
        return np.asarray(sum(table @ matrix @ table.T for table in tables)) / len(tables)

    return CostPrior(
        slope=beside(PIDF_LOOP_PRIOR.slope),
        bowl=beside(PIDF_LOOP_PRIOR.bowl),
        rest=beside(PIDF_LOOP_PRIOR.rest),
        rest_size=PIDF_LOOP_PRIOR.rest_size,
        bend=mean(PIDF_LOOP_PRIOR.bend),
        curvature=mean(PIDF_LOOP_PRIOR.curvature),
    )
