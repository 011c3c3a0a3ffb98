"""Sine and cosine of an angle that turns with the drum, for effects periodic in its angle.

They are advanced from substep to substep: a sine in each would cost more than the rest of the
trial.
"""

from typing import Any

import casadi as ca

from plants.effects.parameter import Share

STATES = 3
FURTHEST_rad = 1.0
"""Greatest change of the angle in a substep; it exceeds half the sampling rate."""

WAVES = (Share(0.5, "turn_periods"), Share(1e4, "turn_periods"))
"""Bounds of a fit of the periods of a wave in a turn: what hardly bends in all of the travel is no
wave, and ten thousand in it are more than readings show."""


def encode_angle(angle_rad: Any) -> Any:
    """State of an angle: its sine, its cosine, itself."""
    return ca.vertcat(ca.sin(angle_rad), ca.cos(angle_rad), angle_rad)


def advance_angle(state: Any, angle_rad: Any) -> Any:
    """State of an angle a substep later.

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
