"""Simulated response of a drum with Stribeck friction to a torque ramp, and its sensitivities."""

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from estune.core.quantities import FloatArray
from experiments.paper.identify.torque_ramp import RampRecord

NAMES = ("inertia_kgm2", "viscous_Nms_rad", "coulomb_Nm", "excess_Nm", "stribeck_rad_s")
"""Parameters, fitted as logarithms; the excess is f_s - f_c, so that all are positive."""


@lru_cache(maxsize=8)
def _response(samples: int) -> Any:
    """States after each sample but the first, with their sensitivities to the parameters.

    (state, [ln parameters; step; torque before; torque after]) -> states; a state is angle,
    velocity, and the sensitivities of both. One Runge-Kutta step of order four per sample; the
    drum rests until the torque exceeds the static friction.
    """
    point, x = ca.SX.sym("point", len(NAMES)), ca.SX.sym("x", 2)
    before, after, h = ca.SX.sym("before"), ca.SX.sym("after"), ca.SX.sym("h")
    J, b, coulomb, excess, stribeck = ca.vertsplit(ca.exp(point))

    def acceleration(torque: Any, omega: Any) -> Any:
        dry = coulomb + excess * ca.exp(-((omega / stribeck) ** 2))
        return (torque - b * omega - dry) / J

    theta, omega = x[0], x[1]
    middle = 0.5 * (before + after)
    k1 = acceleration(before, omega)
    k2 = acceleration(middle, omega + 0.5 * h * k1)
    k3 = acceleration(middle, omega + 0.5 * h * k2)
    k4 = acceleration(after, omega + h * k3)
    moved = ca.vertcat(
        theta + ca.fmax(0.0, h * omega + h**2 / 6.0 * (k1 + k2 + k3)),
        ca.fmax(0.0, omega + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)),
    )
    slopes = ca.SX.sym("slopes", 2, len(NAMES))
    carried = ca.jacobian(moved, x) @ slopes + ca.jacobian(moved, point)
    step = ca.Function(
        "ramp_step",
        [ca.veccat(x, slopes), ca.vertcat(point, h, before, after)],
        [ca.densify(ca.veccat(moved, carried))],
    )
    return step.mapaccum("ramp", samples - 1)


def simulate_ramp(record: RampRecord, point: FloatArray) -> FloatArray:
    """Angle, velocity and their sensitivities after break-away, shape (2 + 10, samples)."""
    torque = record.acting_torque_Nm
    inputs = np.empty((len(NAMES) + 3, torque.size - 1))
    inputs[: len(NAMES)] = point[:, None]
    inputs[len(NAMES)] = record.sample_s
    inputs[-2:] = torque[:-1], torque[1:]
    states = _response(torque.size)(np.zeros(2 + 2 * len(NAMES)), inputs)
    return np.asarray(states)[:, record.breakaway_index - 1 :]


def ramp_residual(record: RampRecord, point: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Measured less fitted angle after break-away, and its sensitivities, both without means.

    The mean is the angle of the first count, which is uncertain within a count.
    """
    states = simulate_ramp(record, point)
    error = record.turned_rad[record.breakaway_index :] - states[0]
    slopes = -states[2::2].T
    return error - error.mean(), slopes - slopes.mean(axis=0)
