"""A damped oscillator stepped exactly, for the modes among the effects."""

from typing import Any

import casadi as ca


def stepping(frequency_rad_s: Any, damping: Any, span_s: Any) -> tuple[Any, Any]:
    """The numbers of `advance` for q'' + 2 zeta w q' + w^2 q = w^2 u.

    Left alone, the oscillator is then exact at multiples of the span, and u has its full effect on
    the mean; where u moves within a span the error is of second order.

    Args:
        frequency_rad_s: Natural frequency w.
        damping: Damping ratio zeta, below one.
        span_s: Time between steps.

    Returns:
        What is kept of the last step, and the pull towards u.
    """
    decay = ca.exp(-damping * frequency_rad_s * span_s)
    turned = ca.cos(frequency_rad_s * span_s * ca.sqrt(1.0 - damping**2))
    return decay**2, 1.0 + decay**2 - 2.0 * decay * turned


def advance(keep: Any, pull: Any, q: Any, last_step: Any, u: Any) -> tuple[Any, Any]:
    """The oscillator's q one span later, and the step that led there."""
    step = keep * last_step + pull * (u - q)
    return q + step, step
