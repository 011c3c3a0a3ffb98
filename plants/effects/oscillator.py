"""A damped oscillator stepped exactly, for the modes among the effects."""

from typing import Any

import casadi as ca


def stepping(frequency_rad_s: Any, damping: Any, span_s: Any) -> tuple[Any, Any]:
    """Coefficients `keep` and `pull` that step q'' + 2 zeta w q' + w^2 q = w^2 u, zeta < 1.

    In each span q moves by `step = keep * step + pull * (u - q)`. Without input the oscillator is
    exact at multiples of the span; where u moves within one the error is of second order.
    """
    decay = ca.exp(-damping * frequency_rad_s * span_s)
    turned = ca.cos(frequency_rad_s * span_s * ca.sqrt(1.0 - damping**2))
    return decay**2, 1.0 + decay**2 - 2.0 * decay * turned
