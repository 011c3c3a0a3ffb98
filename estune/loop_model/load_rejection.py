"""What an identified loop does after a load step at the plant's input.

The load is one that would move the measurement by the step if nothing controlled it: the step over
the plant's gain, at rest, or at the frequency 1/settling time where the plant integrates. So peaks
are shares of the step. The cost of a setpoint step alone knows nothing of loads: on an integrating
plant its optimum has hardly any integral action, and a load then stays.
"""

import math
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.metrics import BAND
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.margins import frequency_response, robustness
from estune.loop_model.model import LoopModel, close_loop

HORIZON = 20.0
"""Settling times after which a load that is still there counts as staying. On the batch of
`experiments.batch` it is within the band after at most 11 of them with AMIGO and lambda tuning, 17
with Tyreus and Luyben's rule; with the optimum of a setpoint step on integrating plants never."""

INTEGRATES = 30.0
"""Static gain over that at 1/settling time from which the plant counts as integrating: a lag of
five settling times is not at rest within a trial."""

SAMPLES_MAX = 200_000
"""Samples of a response: of 20 settling times, each of 10 000 samples."""


class LoadRejection(NamedTuple):
    """The response to a load step.

    Attributes:
        load: Size of the load, in the unit of the effort.
        peak: Largest deviation, in the unit of the measurement.
        vanished_s: Time from the load after which the deviation stays within 2 % of the setpoint
            step, s; infinite where it is beyond that after `HORIZON` settling times.
        time_s: Time from the load, shape (samples,).
        deviation: Deviation from the setpoint, shape (samples,).
    """

    load: float
    peak: float
    vanished_s: float
    time_s: FloatArray
    deviation: FloatArray

    @property
    def vanishes(self) -> bool:
        """Whether the load is rejected."""
        return math.isfinite(self.vanished_s)


def load_rejection(
    model: LoopModel,
    gains: Gains,
    settings: ControllerSettings,
    step: float,
    settling_time_s: float,
) -> LoadRejection | None:
    """The response of the linear part, without limits of the effort; None where it is unstable."""
    if not math.isfinite(robustness(model, gains, settings).sensitivity):
        return None
    rate = settings.sampling_Hz
    size = gain_within(model, settling_time_s * rate)
    if not 0.0 < size < math.inf:
        return None
    load, count = step / size, min(round(HORIZON * settling_time_s * rate), SAMPLES_MAX)
    deviation = close_loop(model, gains, settings).load_response(np.full(count, load))[0]
    if not np.isfinite(deviation).all():
        return None
    time_s = np.arange(count) / rate
    beyond = np.flatnonzero(np.abs(deviation) > BAND * abs(step))
    last = int(beyond[-1]) if beyond.size else -1
    vanished_s = math.inf if last == count - 1 else (last + 1) / rate
    peak = float(np.abs(deviation).max())
    return LoadRejection(load, peak, vanished_s, time_s, deviation)


def gain_within(model: LoopModel, settling_samples: float) -> float:
    """Size of the plant's gain at rest, or at 1/settling time where it integrates."""
    theta = np.array([2.0 * math.pi / settling_samples])
    within = float(np.abs(frequency_response(model, theta))[0])
    at_rest = abs(model.static_gain)
    return at_rest if at_rest < INTEGRATES * within else within
