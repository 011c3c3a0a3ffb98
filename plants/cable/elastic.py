"""Elastic catenary: a heavy cable that stretches by Hooke's law.

The coordinate along the cable is the rest length p from end 1. The vertical tension is
`V(p) = V_1 + w p` with the weight per rest length w = mu_0 g, and an element dp is stretched to
`(1 + T/EA) dp`, which is (2) for an element.

Arguments are arrays of shapes that broadcast, in the units of their names: rest density mu_0,
stiffness EA, tensions |T_1| and |T_3| at the ends or their components. All functions raise
InvalidInput for values that are not finite or out of their range.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from estune.core.quantities import (
    FloatArray,
    Numbers,
    checked_array,
    first_index,
    index_text,
    scalar_or_array,
)
from estune.errors import InvalidInput
from plants.cable.roots import newton
from plants.cable.taut import GRAVITY_M_S2

_RESIDUAL = 1e-9  # error of the far point, relative to the distance of the ends


@dataclass(frozen=True, slots=True)
class ElasticCatenary:
    """Elastic cables in equilibrium; each quantity is a float, or an array of a common shape."""

    rest_length_m: Numbers  # length of the unloaded cable, m
    length_m: Numbers  # length under load [ds], m
    rise_m: Numbers  # height of end 3 above end 1 [dz], m
    span_m: Numbers  # horizontal distance between the ends [dx], m
    tension_x_N: Numbers  # horizontal tension [T_x], N
    tension_1z_N: Numbers  # vertical tension at end 1 [T_1z], N
    tension_3z_N: Numbers  # vertical tension at end 3 [T_3z], N
    tension_1_N: Numbers  # tension at end 1 [|T_1|], N
    tension_3_N: Numbers  # tension at end 3 [|T_3|], N


def elastic_rise_m(
    rest_density_kg_m: ArrayLike,
    stiffness_EA_N: ArrayLike,
    tension_1_N: ArrayLike,
    tension_3_N: ArrayLike,
) -> Numbers:
    """Height of the far end above the attachment of a cable that stretches, m.

    Implements (7).

    `dz = (|T_3| - |T_1| + (|T_3|^2 - |T_1|^2)/(2 EA)) / (mu_0 g)`: exact for a cable that obeys
    Hooke's law, since `dz/dp = V/T (1 + T/EA)` and `dT/dp = mu_0 g V/T`; it is the vertical
    relation of the elastic catenary of Irvine (Cable Structures, 1981).
    """
    w = _weight(rest_density_kg_m)
    EA = checked_array("stiffness EA", stiffness_EA_N, "N", above=0.0)
    T_1 = checked_array("tension_1", tension_1_N, "N", least=0.0)
    T_3 = checked_array("tension_3", tension_3_N, "N", least=0.0)
    return scalar_or_array(np.asarray((T_3 - T_1) * (1.0 + 0.5 * (T_1 + T_3) / EA) / w))


def elastic_catenary(
    rest_density_kg_m: ArrayLike,
    stiffness_EA_N: ArrayLike,
    rest_length_m: ArrayLike,
    *,
    tension_x_N: ArrayLike,
    tension_1z_N: ArrayLike,
) -> ElasticCatenary:
    """Equilibrium of a cable with a given tension vector at its attachment."""
    w = _weight(rest_density_kg_m)
    EA = checked_array("stiffness EA", stiffness_EA_N, "N", above=0.0)
    s_0 = checked_array("rest_length_m", rest_length_m, "m", above=0.0)
    H = checked_array("tension_x_N", tension_x_N, "N", above=0.0)
    V_1 = checked_array("tension_1z_N", tension_1z_N, "N")
    return _from_tensions(*np.broadcast_arrays(w, EA, s_0, H, V_1))


def elastic_between(
    rest_density_kg_m: ArrayLike,
    stiffness_EA_N: ArrayLike,
    rest_length_m: ArrayLike,
    *,
    span_m: ArrayLike,
    rise_m: ArrayLike,
) -> ElasticCatenary:
    """Equilibrium of a cable of known rest length between two points.

    The solution is unique, also for points farther apart than the rest length. With
    a = asinh(T_1z/T_x), b = asinh(T_3z/T_x), m and d half their sum and difference,
    `c = w s_0/(2 EA)` and lengths per rest length s_0, the elastic catenary reads

        z = tanh(m) A,  A = 1 + c/tanh(d);    x = B/cosh(m),  B = (d + c)/sinh(d)

    so that d solves `(z/A)^2 + (x/B)^2 = 1`, whose left side rises with d.

    Raises:
        InvalidInput: a value is not finite or out of its range, or rounding dominates the result.
    """
    w = _weight(rest_density_kg_m)
    EA = checked_array("stiffness EA", stiffness_EA_N, "N", above=0.0)
    s_0 = checked_array("rest_length_m", rest_length_m, "m", above=0.0)
    X = checked_array("span_m", span_m, "m", above=0.0)
    Z = checked_array("rise_m", rise_m, "m")
    w, EA, s_0, X, Z = np.broadcast_arrays(w, EA, s_0, X, Z)
    with np.errstate(all="ignore"):
        W = w * s_0
        x, z, c = X / s_0, Z / s_0, 0.5 * W / EA
        d = _sweep(x.ravel(), z.ravel(), c.ravel()).reshape(w.shape)
        tanh_m, sech_m = z / (1.0 + c / np.tanh(d)), x * np.sinh(d) / (d + c)
        m = np.arcsinh(tanh_m / sech_m)
        H = 0.5 * W / (np.cosh(m) * np.sinh(d))
        cable = _from_tensions(w, EA, s_0, H, H * np.sinh(m - d))
        miss = np.hypot(cable.span_m - X, cable.rise_m - Z) / np.hypot(X, Z)
    inexact = ~np.asarray(miss < _RESIDUAL)
    if inexact.any():
        place = first_index(inexact)
        raise InvalidInput(
            f"the tension is lost in rounding{index_text(place)}: rest length {s_0[place]:g} m, "
            f"span {X[place]:g} m, rise {Z[place]:g} m, EA {EA[place]:g} N and {w[place]:g} N/m "
            "are too many orders of magnitude apart; check the units"
        )
    return cable


def _weight(rest_density_kg_m: ArrayLike) -> FloatArray:
    mu_0 = checked_array("rest density", rest_density_kg_m, "kg/m", above=0.0)
    return np.asarray(mu_0 * GRAVITY_M_S2)


def _from_tensions(
    w: FloatArray, EA: FloatArray, s_0: FloatArray, H: FloatArray, V_1: FloatArray
) -> ElasticCatenary:
    W = w * s_0  # below, forces are per weight W and lengths per rest length s_0
    h, v_1, stretch = H / W, V_1 / W, W / EA
    v_3, middle = v_1 + 1.0, v_1 + 0.5
    t_1, t_3 = np.hypot(h, v_1), np.hypot(h, v_3)
    q = 1.0 / (t_1 + t_3)  # tanh of the sweep, which is half of asinh(V_3/H) - asinh(V_1/H)
    by_ends = 0.5 * (np.arcsinh(v_3 / h) - np.arcsinh(v_1 / h))
    sweep = np.where(q < 0.9, np.arctanh(np.minimum(q, 0.9)), by_ends)
    # int T dp is half of V T + H^2 asinh(V/H) between the ends, in a form without cancellation.
    pull = 0.25 * (t_1 + t_3) + middle**2 * q + h * h * sweep
    return ElasticCatenary(
        rest_length_m=scalar_or_array(np.array(s_0)),
        length_m=scalar_or_array(np.asarray(s_0 * (1.0 + stretch * pull))),
        rise_m=scalar_or_array(np.asarray(s_0 * middle * (2.0 * q + stretch))),
        span_m=scalar_or_array(np.asarray(s_0 * h * (2.0 * sweep + stretch))),
        tension_x_N=scalar_or_array(np.array(H)),
        tension_1z_N=scalar_or_array(np.array(V_1)),
        tension_3z_N=scalar_or_array(np.asarray(V_1 + W)),
        tension_1_N=scalar_or_array(np.asarray(t_1 * W)),
        tension_3_N=scalar_or_array(np.asarray(t_3 * W)),
    )


def _sweep(x: FloatArray, z: FloatArray, c: FloatArray) -> FloatArray:
    """Root d of `_far_point`; lengths per rest length, c is half the weight over EA."""
    chord = np.hypot(x, z)
    # Up to d = 1, sinh(d) <= 1.18 d: with d/(d + c) below k the far point is too close.
    k = 0.84 / chord
    low = np.where(k < 1.0, np.minimum(1.0, c * k / (1.0 - k)), 1.0)
    L = np.log(2.0 * (1.0 + c) / x + 2.0)
    high = L + np.log1p(L) + 2.0  # sinh(d) > (1 + c)(1 + d)/x: too far
    return np.exp(newton(_far_point, np.log(low), np.log(high), x, z, c))


def _far_point(
    y: FloatArray, x: FloatArray, z: FloatArray, c: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """-ln of `(z/A)^2 + (x/B)^2` and its slope, over the logarithm of the sweep d."""
    d = np.exp(y)
    sinh, cosh, tanh = np.sinh(d), np.cosh(d), np.tanh(d)
    z_A = (z * tanh / (tanh + c)) ** 2
    x_B = (x * sinh / (d + c)) ** 2
    grows = z_A * c / (cosh**2 * tanh * (tanh + c)) + x_B * (cosh / sinh - 1.0 / (d + c))
    return -np.log(z_A + x_B), -2.0 * d * grows / (z_A + x_B)
