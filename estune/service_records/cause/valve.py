"""A sticking actuator: it holds until the output is a stick band ahead, then slips."""

from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray


class Valve(NamedTuple):
    """An actuator with friction (He et al. 2007, doi:10.1021/ie060950z): two parameters.

    It rests while the output is less than (band + slip)/2 away, and slips to (band - slip)/2 from
    it. After a reversal the output moves by the band before the actuator does.

    Attributes:
        band: Stick band, in the output's unit.
        slip: Jump when it breaks away, at most the band.
        ahead: How far the output is ahead of the actuator at first, from -1 to 1 of what it holds.
    """

    band: float
    slip: float
    ahead: float = 0.0


def positions(output: FloatArray, valves: list[Valve]) -> FloatArray:
    """Positions of several actuators over the log, shape (samples, valves)."""
    band, slip, ahead = np.array(valves).T
    holds, slides = 0.5 * (band + slip), 0.5 * (band - slip)
    found = np.empty((output.size, len(valves)))
    at = output[0] - ahead * holds
    for k, value in enumerate(output.tolist()):
        lead = value - at
        at = np.where(np.abs(lead) > holds, value - np.sign(lead) * slides, at)
        found[k] = at
    return found
