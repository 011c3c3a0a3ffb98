"""Whether the errors of a fit grow with the motion that the setpoint asks for.

Load and noise of a linear loop know nothing of its setpoint. Friction acts only where there is
motion, and a model of load takes it in: at an eyelet that lets 0.93 of the tension through, Ms of
busy records is read as 1.8 to 2.0, with narrow intervals, where it is 2.8 at a stop. So the power
of the errors, in windows of a sixteenth of the settling time, is compared with the speed of the
model's answer to the setpoint, by ranks of the speed.
"""

import math
from collections.abc import Sequence

import numpy as np

from estune.core.pidf import ControllerSettings
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.model import close_loop
from estune.loop_model.records import LoopRecord

WINDOWS = 16
"""Windows in a settling time. The score is 4.7 to 5.9 in four busy records of the eyelet, 4.1 to
5.2 in three of small steps with friction and at most 1.2 in ten of linear loops; with 8 windows
3.7 to 4.9, 3.8 to 5.7 and 1.3, with 32 3.7 to 6.2, 3.4 to 4.3 and 1.5."""

SMOOTHED = 4
"""Windows that a speed is averaged over: friction shows for a while after a motion."""

CHANCE = 1e-3
"""Probability that the errors of a linear loop are taken to grow with motion."""


def grows_with_motion(
    fit: LoopFit, records: Sequence[LoopRecord], controller: ControllerSettings
) -> bool:
    """Whether the errors of a fit grow with motion beyond chance, in records of service."""
    from scipy.special import ndtri  # noqa: PLC0415  slow to import

    return motion_score(fit, records, controller) > -float(ndtri(CHANCE))


def motion_score(
    fit: LoopFit, records: Sequence[LoopRecord], controller: ControllerSettings
) -> float:
    """Correlation of errors' power and motion, in standard deviations without any; zero of none.

    Trials from rest do not count: after a step all signals decay together.
    """
    window = max(round(fit.settling_samples / WINDOWS), 1)
    products = powers = 0.0
    for number, record in enumerate(records):
        if record.at_rest or record.gains is None or not np.ptp(record.setpoint_N):
            continue
        loop = close_loop(fit.model, record.gains, controller)
        output = loop.setpoint_response(record.setpoint_N - record.setpoint_N[0])[0]
        begun = int(np.argmax(fit.errors[number] != 0.0))
        count = (record.samples - begun) // window
        if count < 2 * SMOOTHED or not np.isfinite(output).all():
            continue
        used = slice(begun, begun + count * window)
        speed = np.abs(np.diff(output, prepend=output[0]))[used].reshape(count, -1).mean(axis=1)
        power = fit.errors[number][used].reshape(count, -1).mean(axis=1) ** 2
        power = power / max(float(power.mean()), 1e-300) - 1.0
        speed = np.convolve(speed, np.ones(SMOOTHED))[:count]
        rank = np.argsort(np.argsort(speed)) - 0.5 * (count - 1)
        products += float(power @ rank)
        powers += float(power @ power) / count * float(rank @ rank)
    return products / math.sqrt(powers) if powers else 0.0
