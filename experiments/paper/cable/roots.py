"""Scalar equations of the hanging cable, solved for arrays by Newton's method.

Lengths are in units of force, as the weight of that length of cable. The *sweep* d is half the
difference of asinh(V/H) between the ends: `X = 2 H d`. All equations but one are convex in their
unknown and start on the side from which Newton's method cannot overshoot; the other is bracketed.
S is the length, Z the rise, X the span, H the horizontal tension, V and T are the vertical tension
and the tension at ends 1 and 3.

`scipy.optimize.elementwise.find_root` takes at least six times as long on a million elements, and
needs a bracket of each root.
"""

from collections.abc import Callable

import numpy as np

from estune.core.quantities import FloatArray

_BLOCK = 1 << 14  # elements; a dozen arrays of this size fit into the processor's cache
_ITERATIONS = 100
_RESIDUAL = 1e-14  # residual of equations in logarithmic or normalised form

Equation = Callable[..., tuple[FloatArray, FloatArray]]
"""Function of the unknown and the known arrays: value and slope."""


def newton(
    equation: Equation, start: FloatArray, far: FloatArray | float, *known: FloatArray
) -> FloatArray:
    """Root next to `start` on the side of `far`; NaN where there is none.

    Args:
        equation: Not negative at `start`; convex towards `far`, or negative there.
        start: Initial values, shape (n,).
        far: A finite bound beyond the root, or an infinity for the direction.
        *known: Further arguments of the equation, each of shape (n,).
    """
    far = np.broadcast_to(np.asarray(far, dtype=np.float64), start.shape)
    blocks = range(0, start.size, _BLOCK)
    parts = [
        _newton_block(
            equation, start[i:][:_BLOCK], far[i:][:_BLOCK], [k[i:][:_BLOCK] for k in known]
        )
        for i in blocks
    ]
    return np.concatenate(parts) if parts else start


def _newton_block(
    equation: Equation, u: FloatArray, far: FloatArray, known: list[FloatArray]
) -> FloatArray:
    root = np.full(u.shape, np.nan)
    near, place = u, np.arange(u.size)
    for _ in range(_ITERATIONS):
        F, slope = equation(u, *known)
        near, far = np.where(F >= 0.0, u, near), np.where(F >= 0.0, far, u)
        following = u - F / slope
        outside = ~((following - near) * (far - near) >= 0.0) | (
            np.isfinite(far) & (np.abs(following - near) > np.abs(far - near))
        )
        # Bisect a finite bracket; without one, a step away from `far` means there is no root.
        halved = np.where(np.isfinite(far), 0.5 * (near + far), np.nan)
        following = np.where(outside, halved, following)
        # The error after a Newton step is of the order of its square.
        close = ~outside & (np.abs(following - u) <= 1e-8 * np.abs(u))
        done = (np.abs(F) <= _RESIDUAL) | close
        root[place[done]] = np.where(outside, u, following)[done]
        active = ~done & np.isfinite(following)
        if not active.any():
            break
        u, near, far, place = following[active], near[active], far[active], place[active]
        known = [k[active] for k in known]
    return root


def sinhc_excess(d: FloatArray) -> FloatArray:
    """`sinh(d)/d - 1` without cancellation, by its series for d below one."""
    y = d * d
    series = np.ones_like(y)
    for n in (272.0, 210.0, 156.0, 110.0, 72.0, 42.0, 20.0):  # 16*17, 14*15, down to 4*5
        series = 1.0 + y / n * series
    return np.where(d < 1.0, y / 6.0 * series, np.sinh(d) / d - 1.0)


def sweep_of_length(ratio_squared_excess: FloatArray) -> FloatArray:
    """Sweep d of `sinh(d)/d = r` from `r^2 - 1`: (3) solved for T_x."""
    y = 0.5 * np.log1p(ratio_squared_excess)  # ln r
    # From sqrt(6 y) for a taut cable to y + ln(2 y) for a slack one, within 2 % between them.
    d = np.where(
        y < 2.0, np.sqrt(6.0 * y * (1.0 + 0.2 * y)), y + np.log(2.0 * y + 2.0 * np.log1p(y))
    )
    for _ in range(3):  # Halley's method: 2e-2, 1e-6, 1e-18
        small = d < 1e-3
        excess = sinhc_excess(d)
        tail = np.exp(-2.0 * d)
        F = np.where(d < 1.0, np.log1p(excess), d + np.log1p(-tail) - np.log(2.0 * d)) - y
        slope = np.where(small, d / 3.0, (1.0 + tail) / (1.0 - tail) - 1.0 / d)
        curvature = np.where(small, 1.0 / 3.0, 1.0 / d**2 - 4.0 * tail / (1.0 - tail) ** 2)
        step = F / slope
        d = d - step / (1.0 - 0.5 * step * curvature / slope)
    return d


def tension_between(X: FloatArray, V_1: FloatArray, S: FloatArray) -> FloatArray:
    """H of a cable of known span, length and vertical tension.

    With `x = X/S`, `x^-2` is the power mean of exponent -1/2 of `1 + V^2/H^2` over the cable. It
    is concave in `1/H^2`, and the tangent at zero gives the start.
    """
    # All forces per S; end 1 is the one with the smaller |V|, so that k below is not negative.
    v_1 = np.where(2.0 * V_1 + S >= 0.0, V_1, -V_1 - S) / S
    target = (S - X) * (S + X) / X**2
    mean_square = v_1**2 + v_1 + 1.0 / 3.0
    inverse_square = newton(_steepness, target / mean_square, np.inf, target, v_1)
    return np.asarray(S / np.sqrt(inverse_square))


def _steepness(
    inverse_square: FloatArray, target: FloatArray, v_1: FloatArray
) -> tuple[FloatArray, FloatArray]:
    h, k = 1.0 / np.sqrt(inverse_square), 2.0 * v_1 + 1.0
    t_1, t_3 = np.sqrt(h**2 + v_1**2), np.sqrt(h**2 + (v_1 + 1.0) ** 2)
    q = 1.0 / (t_1 + t_3)
    # 1 - q without cancellation for a deep bow: t_1 + v_1 = h^2/(t_1 - v_1).
    gap = np.where(v_1 < 0.0, h**2 / (t_1 - v_1), t_1 + v_1) + h**2 / (t_3 + v_1 + 1.0)
    d = np.where(q < 0.5, np.arctanh(np.minimum(q, 0.5)), 0.5 * np.log1p(2.0 / gap))
    x = 2.0 * h * d
    e = sinhc_excess(d)
    curved = (e * (2.0 + e) + (k * q) ** 2) / (1.0 - (k * q) ** 2)  # = x^-2 - 1, for x near one
    value = np.where(x > 0.9, curved, 1.0 / x**2 - 1.0)
    span_slope = span_per_tension(d, k * d / (x * np.cosh(d)))
    return 1.0 - value / target, -span_slope * (h / x) ** 3 / target


def span_per_tension(d: FloatArray, sinh_m: FloatArray) -> FloatArray:
    """`dX/dH` at constant vertical tensions, `2 d - tanh(b) + tanh(a)`, without cancellation."""
    square = sinh_m**2
    sagging = np.sinh(d) ** 2 - sinhc_excess(2.0 * d)
    return np.asarray(2.0 * d * (square + sagging) / (1.0 + square + np.sinh(d) ** 2))


def directions(
    X: FloatArray, S: FloatArray, T_1: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Directions of T_1, lower and higher, at which a cable of length S spans X.

    ln X is concave in `u = sin(angle)`, in `ln(1 - u)` and in `ln(1 + u)`. The unknown is
    `ln(1 - u)` for the higher cable and `ln(1 + u)` for the lower one, which may be near vertical.

    Returns:
        (1 + u, 1 - u) of each of the two cables.
    """
    t, x = T_1 / S, X / S
    # Start where an upper bound of the span equals X: cos(angle) <= sqrt(2 w), times the other
    # factor of the span at w = 0. That factor is infinite for the lower cable with t <= 1; there a
    # lower bound of w gives a better lower bound.
    high = newton(
        _reach_higher, 2.0 * np.log(x / (np.sqrt(2.0) * t * np.log1p(1.0 / t))), np.inf, x, t
    )
    tiny = 1e-6 * np.minimum(x / t, 1.0) ** 4
    low = newton(
        _reach_lower, 2.0 * np.log(x / (np.sqrt(2.0) * t * _bow(t, tiny)[0])), np.inf, x, t
    )
    w_low, w_high = np.exp(low), np.exp(high)
    return [(w_low, 2.0 - w_low), (2.0 - w_high, w_high)]


def _bow(t: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
    """`2 atanh(1/(t + t_3))` and its derivative with respect to w = 1 + u; t_3 is |T_3|/S."""
    t_3 = np.sqrt((1.0 - t) ** 2 + 2.0 * t * w)
    gap = np.where(t >= 1.0, (t - 1.0) + t_3, 2.0 * t * w / (t_3 + np.abs(1.0 - t)))  # t + t_3 - 1
    return np.log1p(2.0 / gap), -2.0 * t / (t_3 * gap * (t + t_3 + 1.0))


def _reach_higher(z: FloatArray, x: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    w = np.exp(z)
    factor, slope = _bow(t, 2.0 - w)
    value = np.log(x / t) - 0.5 * np.log(w * (2.0 - w)) - np.log(factor)
    return value, w * slope / factor - (1.0 - w) / (2.0 - w)


def _reach_lower(z: FloatArray, x: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    w = np.exp(z)
    factor, slope = _bow(t, w)
    value = np.log(x / t) - 0.5 * np.log(w * (2.0 - w)) - np.log(factor)
    return value, -w * slope / factor - (1.0 - w) / (2.0 - w)


def sweeps_of_tension(X: FloatArray, Z: FloatArray, T_sum: FloatArray) -> list[FloatArray]:
    """Sweeps, shorter and longer, of cables between two points with known `|T_1| + |T_3|`.

    `(T_1 + T_3)/X = coth(d) sqrt((sinh(d)/d)^2 + (Z/X)^2)`, whose logarithm is convex in d.
    """
    zeta, kappa = Z / X, T_sum / X
    # coth(d) sqrt(...) >= sqrt(1 + zeta^2)/d, and >= cosh(d)/d.
    near = newton(_tension_sum, np.sqrt(1.0 + zeta**2) / kappa, np.inf, zeta, kappa)
    L = np.log(2.0 * np.maximum(kappa, 1.6))
    return [near, newton(_tension_sum, L + np.log(L) + 1.0, -np.inf, zeta, kappa)]


def _tension_sum(
    d: FloatArray, zeta: FloatArray, kappa: FloatArray
) -> tuple[FloatArray, FloatArray]:
    sinh, cosh = np.sinh(d), np.cosh(d)
    r = sinh / d
    length = np.sqrt(r**2 + zeta**2)
    slope = r * (cosh - r) / (d * length**2) - 1.0 / (sinh * cosh)
    return np.log(cosh / sinh * length / kappa), slope


def sweeps_of_fall(X: FloatArray, Z: FloatArray, V_1: FloatArray) -> list[FloatArray]:
    """Sweeps, shorter and longer, of cables between two points with known vertical tension.

    `-2 V_1/X = sqrt((sinh(d)/d)^2 + (Z/X)^2) - Z/X coth(d)`. For Z < 0 the logarithm of the right
    side is convex in d; for Z > 0 it rises from minus to plus infinity, one cable fits, and the
    root lies between two bounds; for Z = 0 it is `sinh(d)/d`.
    """
    zeta, kappa = Z / X, -2.0 * V_1 / X
    level = sweep_of_length(np.where(kappa > 1.0, (kappa - 1.0) * (kappa + 1.0), np.nan))
    shorter, longer = level, level.copy()
    up, down = zeta > 0.0, zeta < 0.0
    shorter[up] = longer[up] = _sweep_rising(zeta[up], kappa[up])
    shorter[down], longer[down] = _sweeps_falling(zeta[down], kappa[down])
    return [shorter, longer]


def _sweeps_falling(zeta: FloatArray, kappa: FloatArray) -> tuple[FloatArray, FloatArray]:
    # The right side above is at least sqrt(1 + zeta^2) - zeta/d, and at least sinh(d)/d.
    rest = kappa - np.sqrt(1.0 + zeta**2)
    near = newton(_fall, np.where(rest > 0.0, -zeta / rest, np.nan), np.inf, zeta, kappa)
    L = np.log(2.0 * np.maximum(kappa, 1.0))
    return near, newton(_fall, L + np.log1p(L) + 1.0, -np.inf, zeta, kappa)


def _sweep_rising(zeta: FloatArray, kappa: FloatArray) -> FloatArray:
    low = np.minimum(1.0, zeta / (1.2 + zeta + np.abs(kappa)))
    L = np.log(2.0 * np.maximum(np.abs(kappa) + 1.32 * zeta, 1.0))
    high = L + np.log1p(L) + 1.0
    return np.exp(newton(_rise, np.log(low), np.log(high), zeta, kappa))


def _fall(d: FloatArray, zeta: FloatArray, kappa: FloatArray) -> tuple[FloatArray, FloatArray]:
    sinh, cosh = np.sinh(d), np.cosh(d)
    r = sinh / d
    length = np.sqrt(r**2 + zeta**2)
    value = length - zeta * cosh / sinh
    slope = r * (cosh - r) / (d * length) + zeta / sinh**2
    return np.log(value / kappa), slope / value


def _rise(y: FloatArray, zeta: FloatArray, kappa: FloatArray) -> tuple[FloatArray, FloatArray]:
    d = np.exp(y)
    sinh, cosh = np.sinh(d), np.cosh(d)
    r = sinh / d
    length = np.sqrt(r**2 + zeta**2)
    plus = zeta * cosh / sinh + np.maximum(kappa, 0.0)
    minus = length + np.maximum(-kappa, 0.0)
    slope = -zeta / sinh**2 / plus - r * (cosh - r) / (d * length) / minus
    return np.log(plus / minus), slope * d


def sweeps_of_ends(X: FloatArray, V_1: FloatArray, T_3: FloatArray) -> list[FloatArray]:
    """Sweeps, shorter and longer, of cables of span X with known V_1 and |T_3|.

    `2 T_3/X = cosh(b)/d` with `b = 2 d + asinh(2 V_1 d/X)`, whose logarithm is convex in d.
    """
    alpha, kappa = 2.0 * V_1 / X, 2.0 * T_3 / X
    # cosh(b)/d >= 1/d; with alpha < 0 also >= |alpha| exp(-2 d), else >= sqrt(1/d^2 + alpha^2).
    steep = np.maximum(1.0 / kappa, 0.5 * np.log(np.maximum(-alpha, 1e-300) / kappa))
    room = (kappa - alpha) * (kappa + alpha)
    start = np.where(alpha < 0.0, steep, 1.0 / np.sqrt(np.where(room > 0.0, room, np.nan)))
    near = newton(_end_tension, start, np.inf, alpha, kappa)
    # exp(2 d) >= kappa 2 d (1 + 2 |alpha| d) from here on.
    L = np.log(np.maximum(kappa * (1.0 + np.abs(alpha)), 1.0))
    start = 0.5 * (L + 2.0 * np.log1p(L) + 4.0)
    return [near, newton(_end_tension, start, -np.inf, alpha, kappa)]


def _end_tension(
    d: FloatArray, alpha: FloatArray, kappa: FloatArray
) -> tuple[FloatArray, FloatArray]:
    z = alpha * d
    b = 2.0 * d + np.arcsinh(z)
    size = np.abs(b)
    ln_cosh = size + np.log1p(np.exp(-2.0 * size)) - np.log(2.0)
    slope = np.tanh(b) * (2.0 + alpha / np.sqrt(1.0 + z * z)) - 1.0 / d
    return ln_cosh - np.log(kappa * d), slope
