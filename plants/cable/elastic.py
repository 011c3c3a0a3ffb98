"""The elastic catenary: a heavy cable that stretches by Hooke's law, in terms of its rest length.

A point of the cable is told by the rest length p between it and end 1. There the vertical tension
is `V(p) = V_1 + w p` with the weight per rest length w = mu_0 g, and a piece dp is stretched to
`(1 + T/EA) dp`, which is (2) for an infinitesimal piece: its mass stays, its density falls.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from estune.core.quantities import FloatArray, Numbers, at, checked, first, plain
from estune.errors import InvalidInput
from plants.cable.roots import newton
from plants.cable.taut import GRAVITY_M_S2

_RESIDUAL = 1e-9  # of the far point, per distance of the ends


@dataclass(frozen=True, slots=True)
class ElasticCatenary:
    """Stretched cables in equilibrium; each quantity is a float, or an array of a common shape.

    Attributes:
        rest_length_m: Length of the unloaded cable, m.
        length_m: Length under load [ds], m.
        rise_m: Height of end 3 above end 1 [dz], m.
        span_m: Horizontal distance between the ends [dx], m.
        tension_x_N: Horizontal tension [T_x], N.
        tension_1z_N: Vertical tension at end 1 [T_1z], N.
        tension_3z_N: Vertical tension at end 3 [T_3z], N.
        tension_1_N: Tension at end 1 [|T_1|], N.
        tension_3_N: Tension at end 3 [|T_3|], N.
    """

    rest_length_m: Numbers
    length_m: Numbers
    rise_m: Numbers
    span_m: Numbers
    tension_x_N: Numbers
    tension_1z_N: Numbers
    tension_3z_N: Numbers
    tension_1_N: Numbers
    tension_3_N: Numbers


def elastic_rise_m(
    rest_density_kg_m: ArrayLike,
    stiffness_EA_N: ArrayLike,
    tension_1_N: ArrayLike,
    tension_3_N: ArrayLike,
    gravity_m_s2: float = GRAVITY_M_S2,
) -> Numbers:
    """Height of the far end above the attachment of a cable that stretches, m.

    Implements (7).

    `dz = (|T_3| - |T_1| + (|T_3|^2 - |T_1|^2)/(2 EA)) / (mu_0 g)`: exact for a cable that obeys
    Hooke's law, since `dz/dp = V/T (1 + T/EA)` and `dT/dp = mu_0 g V/T`; it is the vertical
    relation of the elastic catenary of Irvine (Cable Structures, 1981).

    Args:
        rest_density_kg_m: Mass per length of the unloaded cable mu_0, kg/m; any shape.
        stiffness_EA_N: Young's modulus times section EA, N.
        tension_1_N: Tension at the attachment |T_1|, N.
        tension_3_N: Tension at the far end |T_3|, N.
        gravity_m_s2: Gravitational acceleration, m/s2.

    Raises:
        InvalidInput: a value is not finite or out of its range.
    """
    w = _weight(rest_density_kg_m, gravity_m_s2)
    EA = checked("stiffness EA", stiffness_EA_N, "N", above=0.0)
    T_1 = checked("tension_1", tension_1_N, "N", least=0.0)
    T_3 = checked("tension_3", tension_3_N, "N", least=0.0)
    return plain(np.asarray((T_3 - T_1) * (1.0 + 0.5 * (T_1 + T_3) / EA) / w))


def elastic_catenary(
    rest_density_kg_m: ArrayLike,
    stiffness_EA_N: ArrayLike,
    rest_length_m: ArrayLike,
    *,
    tension_x_N: ArrayLike,
    tension_1z_N: ArrayLike,
    gravity_m_s2: float = GRAVITY_M_S2,
) -> ElasticCatenary:
    """Where a cable ends, given the tension vector at its attachment.

    Args:
        rest_density_kg_m: Mass per length of the unloaded cable mu_0, kg/m; shapes broadcast.
        stiffness_EA_N: Young's modulus times section EA, N.
        rest_length_m: Length of the unloaded cable, m.
        tension_x_N: Horizontal tension T_x, N, above zero.
        tension_1z_N: Vertical tension at the attachment T_1z, N.
        gravity_m_s2: Gravitational acceleration, m/s2.

    Raises:
        InvalidInput: a value is not finite or out of its range.
    """
    w = _weight(rest_density_kg_m, gravity_m_s2)
    EA = checked("stiffness EA", stiffness_EA_N, "N", above=0.0)
    s_0 = checked("rest_length_m", rest_length_m, "m", above=0.0)
    H = checked("tension_x_N", tension_x_N, "N", above=0.0)
    V_1 = checked("tension_1z_N", tension_1z_N, "N")
    return _described(*np.broadcast_arrays(w, EA, s_0, H, V_1))


def elastic_between(
    rest_density_kg_m: ArrayLike,
    stiffness_EA_N: ArrayLike,
    rest_length_m: ArrayLike,
    *,
    span_m: ArrayLike,
    rise_m: ArrayLike,
    gravity_m_s2: float = GRAVITY_M_S2,
) -> ElasticCatenary:
    """The tensions of a cable of known rest length between two points.

    There is always exactly one answer, also where the points are farther apart than the cable is
    long. With a = asinh(T_1z/T_x), b the same at end 3, m and d half their sum and difference,
    `c = w s_0/(2 EA)` and lengths per rest length s_0, the elastic catenary reads

        z = tanh(m) A,  A = 1 + c/tanh(d);    x = B/cosh(m),  B = (d + c)/sinh(d)

    so that `(z/A)^2 + (x/B)^2 = 1` is left for d, whose left side rises with d.

    Args:
        rest_density_kg_m: Mass per length of the unloaded cable mu_0, kg/m; shapes broadcast.
        stiffness_EA_N: Young's modulus times section EA, N.
        rest_length_m: Length of the unloaded cable, m.
        span_m: Horizontal distance between the ends dx, m, above zero.
        rise_m: Height of end 3 above end 1 dz, m.
        gravity_m_s2: Gravitational acceleration, m/s2.

    Raises:
        InvalidInput: a value is not finite or out of its range, or the answer cannot be told from
            rounding.
    """
    w = _weight(rest_density_kg_m, gravity_m_s2)
    EA = checked("stiffness EA", stiffness_EA_N, "N", above=0.0)
    s_0 = checked("rest_length_m", rest_length_m, "m", above=0.0)
    X = checked("span_m", span_m, "m", above=0.0)
    Z = checked("rise_m", rise_m, "m")
    w, EA, s_0, X, Z = np.broadcast_arrays(w, EA, s_0, X, Z)
    with np.errstate(all="ignore"):
        W = w * s_0
        x, z, c = X / s_0, Z / s_0, 0.5 * W / EA
        d = _sweep(x.ravel(), z.ravel(), c.ravel()).reshape(w.shape)
        tanh_m, sech_m = z / (1.0 + c / np.tanh(d)), x * np.sinh(d) / (d + c)
        m = np.arcsinh(tanh_m / sech_m)
        H = 0.5 * W / (np.cosh(m) * np.sinh(d))
        cable = _described(w, EA, s_0, H, H * np.sinh(m - d))
        miss = np.hypot(cable.span_m - X, cable.rise_m - Z) / np.hypot(X, Z)
    lost = ~np.asarray(miss < _RESIDUAL)
    if lost.any():
        place = first(lost)
        raise InvalidInput(
            f"the tension is lost in rounding{at(place)}: rest length {s_0[place]:g} m, span "
            f"{X[place]:g} m, rise {Z[place]:g} m, EA {EA[place]:g} N and {w[place]:g} N/m are "
            "too many orders of magnitude apart; check the units"
        )
    return cable


def _weight(rest_density_kg_m: ArrayLike, gravity_m_s2: float) -> FloatArray:
    mu_0 = checked("rest density", rest_density_kg_m, "kg/m", above=0.0)
    return np.asarray(mu_0 * checked("gravity", gravity_m_s2, "m/s2", above=0.0))


def _described(
    w: FloatArray, EA: FloatArray, s_0: FloatArray, H: FloatArray, V_1: FloatArray
) -> ElasticCatenary:
    W = w * s_0  # from here on forces per weight of the cable, lengths per its rest length
    h, v_1, stretch = H / W, V_1 / W, W / EA
    v_3, middle = v_1 + 1.0, v_1 + 0.5
    t_1, t_3 = np.hypot(h, v_1), np.hypot(h, v_3)
    q = 1.0 / (t_1 + t_3)  # tanh of the sweep, which is half of asinh(V_3/H) - asinh(V_1/H)
    by_ends = 0.5 * (np.arcsinh(v_3 / h) - np.arcsinh(v_1 / h))
    sweep = np.where(q < 0.9, np.arctanh(np.minimum(q, 0.9)), by_ends)
    # int T dp is half of V T + H^2 asinh(V/H) between the ends, written without cancellation.
    pull = 0.25 * (t_1 + t_3) + middle**2 * q + h * h * sweep
    return ElasticCatenary(
        rest_length_m=plain(np.array(s_0)),
        length_m=plain(np.asarray(s_0 * (1.0 + stretch * pull))),
        rise_m=plain(np.asarray(s_0 * middle * (2.0 * q + stretch))),
        span_m=plain(np.asarray(s_0 * h * (2.0 * sweep + stretch))),
        tension_x_N=plain(np.array(H)),
        tension_1z_N=plain(np.array(V_1)),
        tension_3z_N=plain(np.asarray(V_1 + W)),
        tension_1_N=plain(np.asarray(t_1 * W)),
        tension_3_N=plain(np.asarray(t_3 * W)),
    )


def _sweep(x: FloatArray, z: FloatArray, c: FloatArray) -> FloatArray:
    """The d of `_far_point`; lengths per rest length, c is half the weight over EA."""
    chord = np.hypot(x, z)
    # Up to d = 1, sinh(d) <= 1.18 d: with d/(d + c) below k the far point is too near.
    k = 0.84 / chord
    low = np.where(k < 1.0, np.minimum(1.0, c * k / (1.0 - k)), 1.0)
    L = np.log(2.0 * (1.0 + c) / x + 2.0)
    high = L + np.log1p(L) + 2.0  # sinh(d) > (1 + c)(1 + d)/x: too far
    return np.exp(newton(_far_point, np.log(low), np.log(high), x, z, c))


def _far_point(
    y: FloatArray, x: FloatArray, z: FloatArray, c: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Minus ln of `(z/A)^2 + (x/B)^2` and its slope, against the logarithm of the sweep d."""
    d = np.exp(y)
    sinh, cosh, tanh = np.sinh(d), np.cosh(d), np.tanh(d)
    z_A = (z * tanh / (tanh + c)) ** 2
    x_B = (x * sinh / (d + c)) ** 2
    grows = z_A * c / (cosh**2 * tanh * (tanh + c)) + x_B * (cosh / sinh - 1.0 / (d + c))
    return -np.log(z_A + x_B), -2.0 * d * grows / (z_A + x_B)
