"""Response of the loop sample by sample: with the controller's limits, and with dry friction."""

from functools import lru_cache
from typing import Any

import numpy as np

from estune.core import pidf
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.model import LoopModel


def sampled_response(
    model: LoopModel,
    settings: ControllerSettings,
    gains: Gains,
    setpoint_N: FloatArray,
    load_N: FloatArray,
    *,
    rest_effort_N: float,
) -> tuple[FloatArray, FloatArray]:
    """Output and effort as deviations, by the controller's own steps, shape (samples,) each.

    Args:
        model: The loop; friction holds nothing at rest.
        settings: The fixed part of the controller.
        gains: The gains.
        setpoint_N: As a deviation, shape (samples,).
        load_N: Added to the effort on its way to the plant, shape (samples,).
        rest_effort_N: Effort at rest, by which the controller's limits are judged.
    """
    coefficients = pidf.coefficients(settings, gains)
    fixed = np.array([*coefficients, *model.poles, *model.zeros, model.friction_N, rest_effort_N])
    run = _loop(model.dead_samples, setpoint_N.size)
    first = np.zeros(3 + model.dead_samples + 3)
    first[0] = rest_effort_N
    columns = np.vstack([setpoint_N, load_N, np.tile(fixed[:, np.newaxis], setpoint_N.size)])
    _, signals = run(first, columns)
    output, effort = np.asarray(signals.full())
    return output, effort - rest_effort_N


@lru_cache(maxsize=8)
def _loop(dead: int, samples: int) -> Any:
    """The loop as a function of first state and columns; its states are x/a, the latest first.

    The position x of the two poles is divided by a = 1 + a1 + a2, so that integrators have one.
    """
    import casadi as ca  # noqa: PLC0415  slow to import

    ca.GlobalOptions.setNumpyMode(1)  # or it prints a notice
    state, column = ca.SX.sym("state", 6 + dead), ca.SX.sym("column", 2 + 9 + 7)
    setpoint, load = column[0], column[1]
    c = pidf.Coefficients(*(column[2 + i] for i in range(9)))
    a1, a2, b0, b1, b2, friction, rest = (column[11 + i] for i in range(7))
    controller = pidf.PidfState(state[0], state[1], state[2])
    x = state[3:]
    output = b0 * x[dead] + b1 * x[dead + 1] + b2 * x[dead + 2]
    following, effort, _ = pidf.step(c, controller, setpoint, output)
    step = -(1.0 + a1) * x[0] - a2 * x[1] + effort - rest + load
    moved = x[0] + step - ca.fmin(ca.fmax(step, -friction), friction)
    after = ca.vertcat(*following, moved, x[:-1])
    one = ca.Function("one", [state, column], [after, ca.vertcat(output, effort)])
    return one.mapaccum("loop", samples)
