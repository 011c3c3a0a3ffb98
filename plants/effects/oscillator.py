"""A damped oscillator stepped exactly, for the modes among the effects."""

from typing import Any

import casadi as ca


def stepping(frequency_rad_s: Any, damping: Any, span_s: Any) -> tuple[Any, Any]:
    """The numbers that step q'' + 2 zeta w q' + w^2 q = w^2 u.

    In each span q moves by `step = keep * step + pull * (u - q)`. Left alone, the oscillator is
    then exact at multiples of the span; where u moves within one the error is of second order.

    Args:
        frequency_rad_s: Natural frequency w.
        damping: Damping ratio zeta, below one.
        span_s: Time between steps.

    Returns:
        `keep` and `pull`.
    """
    decay = ca.exp(-damping * frequency_rad_s * span_s)
    turned = ca.cos(frequency_rad_s * span_s * ca.sqrt(1.0 - damping**2))
    return decay**2, 1.0 + decay**2 - 2.0 * decay * turned
