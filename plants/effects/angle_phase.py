"""Sine and cosine of an angle that goes with the drum, for effects that repeat with each turn.

They are turned on from one substep to the next: working out a sine anew in each would cost more
than the rest of the trial.
"""

from typing import Any

import casadi as ca

STATES = 3
FURTHEST_rad = 1.0
"""What the angle may move in a substep; beyond it the phase is lost. That is faster than half the
sampling rate, so that no record shows it."""


def encode_angle(angle_rad: Any) -> Any:
    """What is remembered of an angle: its sine, its cosine, itself."""
    return ca.vertcat(ca.sin(angle_rad), ca.cos(angle_rad), angle_rad)


def advance_angle(state: Any, angle_rad: Any) -> Any:
    """What is remembered of an angle a substep later.

    The series are right to 1e-9 for 0.1 rad and to 1e-3 for 1 rad; the sum of the squares is drawn
    to one.
    """
    x = ca.fmin(ca.fmax(angle_rad - state[2], -FURTHEST_rad), FURTHEST_rad)
    square = x * x
    one = 1.5 - 0.5 * (state[0] * state[0] + state[1] * state[1])
    cosine = one + square * (-1.0 / 2.0 + (1.0 / 24.0) * square)
    sine = x + (x * square) * (-1.0 / 6.0 + (1.0 / 120.0) * square)
    return ca.vertcat(
        state[0] * cosine + state[1] * sine, state[1] * cosine - state[0] * sine, angle_rad
    )
