"""Response of the loop sample by sample: with the controller's limits, dry friction and a bend."""

from functools import lru_cache
from typing import Any

import numpy as np

from estune.core import pidf
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.bend import LEAST, MOST, POWERS
from estune.loop_model.model import LoopModel, exchanged

NEWTON = 4
"""Steps to the measurement of a bent plant: each squares the error."""

BENDS = 1 + 2 * len(POWERS)


def sampled_response(
    model: LoopModel,
    settings: ControllerSettings,
    gains: Gains,
    setpoint: FloatArray,
    load: FloatArray,
    *,
    rest_effort: float,
) -> tuple[FloatArray, FloatArray]:
    """Output and effort as deviations, by the controller's own steps, shape (samples,) each.

    Args:
        model: The loop; friction holds nothing at rest, and the step is that of its bend.
        settings: The fixed part of the controller.
        setpoint: As a deviation, shape (samples,).
        load: Added to the effort on its way to the plant, shape (samples,).
        rest_effort: Effort at rest, by which the controller's limits are judged.
    """
    sections = model.sections
    taps = np.concatenate([np.resize(s.taps, 3)[1:] * [1.0, s.taps.size > 2] for s in sections])
    fixed = np.concatenate(
        [
            pidf.coefficients(settings, gains),
            taps,
            exchanged(np.array(model.numerator)),
            [rest_effort, model.friction],
            [model.bend.size, *model.bend.terms],  # a step trial begins at x = -1 of it
        ]
    )
    run = _loop(
        *(len(sections), len(model.numerator), model.dead_samples, setpoint.size),
        bent=not model.bend.is_straight,
    )
    first = np.zeros(run.size1_in(0))
    first[0] = rest_effort
    columns = np.vstack([setpoint, load, np.tile(fixed[:, np.newaxis], setpoint.size)])
    _, signals = run(first, columns)
    output, effort = np.asarray(signals.full())
    return output, effort - rest_effort


def _bent(straight: Any, bend: Any) -> tuple[Any, Any]:
    """The measurement of a bent plant by what its linear part gives, and the effort that it adds.

    As deviations from rest. By Newton's method: the terms are small against the measurement.
    """
    import casadi as ca  # noqa: PLC0415  slow to import

    size, terms = bend[0], [bend[1 + i] for i in range(2 * len(POWERS))]
    of_effort, of_measurement = terms[: len(POWERS)], terms[len(POWERS) :]

    def place(y: Any) -> Any:
        return ca.fmin(ca.fmax(y / size - 1.0, LEAST), MOST)

    def total(each: list[Any], x: Any) -> Any:
        pairs = zip(each, POWERS, strict=True)
        return size * sum(term * (x**power - (-1.0) ** power) for term, power in pairs)

    y = straight
    for _ in range(NEWTON):
        x, pairs = place(y), zip(of_measurement, POWERS, strict=True)
        slope = 1.0 + sum(term * power * x ** (power - 1) for term, power in pairs)
        y = y - (y + total(of_measurement, x) - straight) / slope
    return y, total(of_effort, place(y))


@lru_cache(maxsize=8)
def _loop(sections: int, terms: int, dead: int, samples: int, *, bent: bool) -> Any:
    """The loop as a function of first state and columns.

    States: of the controller; the position x/a of the first pair and that before; the last two
    outputs of each further section; the last values of the last one, of which B takes a sum. The
    position is divided by a = 1 + a1 + a2, so that integrators have one.
    """
    import casadi as ca  # noqa: PLC0415  slow to import

    ca.GlobalOptions.setNumpyMode(1)  # or it prints a notice
    further = sections - 1
    state = ca.SX.sym("state", 3 + 2 + 2 * further + dead + terms)
    column = ca.SX.sym("column", 2 + 9 + 2 * sections + terms + 2 + BENDS)
    setpoint, load = column[0], column[1]
    c = pidf.Coefficients(*(column[2 + i] for i in range(9)))
    taps, zeros = column[11 : 11 + 2 * sections], column[11 + 2 * sections : -2 - BENDS]
    rest, friction, bend = column[-2 - BENDS], column[-1 - BENDS], column[-BENDS:]
    controller = pidf.PidfState(state[0], state[1], state[2])
    x, between, last = state[3:5], state[5 : 5 + 2 * further], state[5 + 2 * further :]
    output = ca.dot(zeros, last[dead : dead + terms])
    if bent:
        output = _bent(output, bend)[0]
    following, effort, _ = pidf.step(c, controller, setpoint, output)

    def moved_by(pulled: Any) -> tuple[Any, Any, list[Any]]:
        """The position of the first pair, what leaves the last one, and states of the others."""
        driven = effort - rest + load + pulled
        step = -(1.0 + taps[0]) * x[0] - taps[1] * x[1] + driven
        signal = moved = x[0] + step - ca.fmin(ca.fmax(step, -friction), friction)
        kept = []
        for i in range(further):
            own = between[2 * i : 2 * i + 2]
            signal = signal - taps[2 + 2 * i] * own[0] - taps[3 + 2 * i] * own[1]
            kept += [signal, own[0]]
        return moved, signal, kept

    moved, signal, kept = moved_by(0.0)
    if bent:  # a spring takes the mean of the measurement before and after the sample
        now = _bent(ca.dot(zeros, last[:terms]), bend)[1]
        foreseen = ca.vertcat(moved_by(now)[1], last[: terms - 1])
        after = _bent(ca.dot(zeros, foreseen), bend)[1]
        moved, signal, kept = moved_by(0.5 * (now + after))
    after = ca.vertcat(*following, moved, x[0], *kept, signal, last[:-1])
    one = ca.Function("one", [state, column], [after, ca.vertcat(output, effort)])
    return one.mapaccum("loop", samples)
