"""How many more trials would show that some gains keep a limit of Ms, by the identified loop.

The trials to come are answers of the model. With them the noise hides less of the plant's error
(`plant_error`), and the interval of Ms by the model is narrower by the information that they add,

    I = 1/s^2 - 1/s_0^2,

of the deviations s_0 and s of ln Ms by what the setpoints of the records excite, without and with
one of them. What the model leaves unexplained stays.
"""

import math

from estune.loop_model.excitation import UnknownLoop
from estune.loop_model.intervals import margins_by_records, remaining_error, setpoint_deviation
from estune.loop_model.prediction import StepTrial
from estune.loop_model.records import LoopRecord

MOST = 50
"""Most trials that are worth naming."""


def trials_to_show(
    loop: UnknownLoop, trial: StepTrial, limit: float, answer: LoopRecord
) -> int | None:
    """The least number of trials after which the interval of Ms would keep a limit.

    None where more than `MOST` would be needed, or none would do.

    Args:
        loop: The loop with the gains in question.
        answer: Each trial to come, without noise.
    """
    Ms = margins_by_records(loop.fit, loop.records, trial, loop.gains).sensitivity
    if not Ms.value < limit or Ms.high == math.inf:
        return None
    added, wide = _information(loop, answer), math.log(Ms.high / Ms.value)
    least = remaining_error(loop.fit)
    moves = math.sqrt(max(wide**2 - least**2, 0.0))
    powers = loop.powers

    def is_shown(count: int) -> bool:
        above = math.hypot(least, moves / math.sqrt(1.0 + count * added))
        error = loop.margin(powers.bound(answer.effort, count))
        high = max(Ms.value * math.exp(above), error.sensitivity)
        return error.unknown is None and high <= limit

    if not is_shown(MOST):
        return None
    low, high = 0, MOST
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if is_shown(middle) else (middle, high)
    return high


def _information(loop: UnknownLoop, answer: LoopRecord) -> float:
    """Information that a trial adds, over that of the records; by their number if not known."""
    fit, records, gains, settings = loop.fit, loop.records, loop.gains, loop.controller
    if not (fit.model.friction or fit.strengths):
        now, then = (
            setpoint_deviation(fit, given, gains, settings)
            for given in (records, (*records, answer))
        )
        if 0.0 < then <= now < math.inf:
            return (now / then) ** 2 - 1.0
    return 1.0 / len(records)
