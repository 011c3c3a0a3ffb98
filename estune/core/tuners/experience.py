"""What the costs of all PIDF loops have in common, so that a search need not find it out anew.

In logarithms of the gains, relative to its least, the cost of one loop is much like that of
another, whatever its plant is and how fast: it bends most along P, less along I and D, least along
the setpoint filter's time constant; P and D may grow together, and P with the time constant, at
little cost. The numbers below say how much. They were fitted to searches on some 350 simulated
loops drawn at random: plants of the first to the fifth order, lightly and well damped, with and
without dead time and a limit of the effort, each with a cost of its own; `experiments.loop_prior`
draws others, fits the numbers anew and tells how much better than none they foretell a cost.

A parameter that is tuned is a direction in the four logarithms: with K the gain of the standard
form, log P = log K, log I = log K - log Ti and log D = log K + log Td. So what is known in one
form is known in the other, and of fewer parameters too.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from estune.core.tuners.spread import FloatArray

DIRECTIONS = {
    "P": (1.0, 0.0, 0.0, 0.0),
    "I": (0.0, 1.0, 0.0, 0.0),
    "D": (0.0, 0.0, 1.0, 0.0),
    "setpoint_filter_s": (0.0, 0.0, 0.0, 1.0),
    "K": (1.0, 1.0, 1.0, 0.0),
    "Ti": (0.0, -1.0, 0.0, 0.0),
    "Td": (0.0, 0.0, 1.0, 0.0),
}
"""What a unit of the logarithm of a parameter adds to those of P, I, D and the time constant."""

CAUTION = 1.4
"""A rig differs more from the loops simulated than they do from one another: slopes and what is
left over may be so many times larger than theirs."""


class Experience(NamedTuple):
    """What is known of a cost before the first trial; x are n logarithms from the start on.

    Attributes:
        slope: S, shape (n, 4): the slopes have the covariance S S'.
        bowl: M, shape (n, 4): the bends come from the covariance (x'M M'y)^2.
        rest: B, shape (n, 4): what is neither changes as exp(-|B'(x - y)|^2/2).
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

    def along(self, directions: Sequence[Sequence[float]]) -> "Experience":
        """The same for parameters that are these directions, shape (n, 4)."""
        e = np.array(directions)
        return Experience(
            slope=e @ self.slope,
            bowl=e @ self.bowl,
            rest=e @ self.rest,
            rest_size=self.rest_size,
            bend=e @ self.bend @ e.T,
            curvature=e @ self.curvature @ e.T,
        )


OF_LOOPS = Experience(
    slope=CAUTION
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
    rest_size=CAUTION * 0.267,
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
def experience(names: tuple[str, ...]) -> Experience:
    """What is known of the cost over these parameters, by their names in a search space."""
    return OF_LOOPS.along([DIRECTIONS[name] for name in names])
