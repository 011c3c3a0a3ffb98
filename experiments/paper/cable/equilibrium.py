"""Shape of a hanging cable from three known quantities.

With `a = asinh(T_1z/T_x)` and b the same at end 3, every quantity is T_x times a function of
`m = (a + b)/2` and `d = (b - a)/2`:

    S = 2 H cosh(m) sinh(d)    Z = 2 H sinh(m) sinh(d)    X = 2 H d
    V_1 = H sinh(m - d)        T_1 = H cosh(m - d)        V_3, T_3 with m + d

(S, Z, X are ds, dz, dx times the weight per length, H is T_x, V the vertical tension). (H, m, d)
is well conditioned for cables that are nearly straight, vertical or slack.
"""

from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from experiments.paper.cable import roots


class CatenaryShape(NamedTuple):
    """H, m and d as above; NaN, or values that are not positive, where no cable fits."""

    H: FloatArray
    m: FloatArray
    d: FloatArray


Known = dict[str, FloatArray]
"""Three of S, Z, X, H, V1, V3, T1, T3, all of the same shape (n,), in newtons."""

_MIRRORED = {"V1": "V3", "V3": "V1", "T1": "T3", "T3": "T1"}


def solve_shapes(known: Known) -> list[CatenaryShape]:
    """All solutions, shorter before longer, or lower before higher."""
    if "X" not in known:
        return _without_span(known)
    # The equations with the span are for quantities known at end 1. Seen from the other end, rise
    # and vertical tensions change sign. With one quantity at each end the form is H, V_1 and T_3.
    ends = {"V1", "V3", "T1", "T3"} & known.keys()
    if ends in ({"V3"}, {"T3"}, {"V3", "T3"}, {"V3", "T1"}):
        flipped = {
            _MIRRORED.get(n, n): -v if n in ("Z", "V1", "V3") else v for n, v in known.items()
        }
        mirrored = [CatenaryShape(H, -m, d) for H, m, d in _with_span(flipped)]
        by_height = known.keys() == {"S", "X", "T3"}
        return mirrored[::-1] if by_height else mirrored
    return _with_span(known)


def _completed(known: Known) -> Known:
    """Adds the relations of (6): V_3 = V_1 + S, and its integral T_3 = T_1 + Z."""
    q = dict(known)
    for start, end, difference in (("V1", "V3", "S"), ("T1", "T3", "Z")):
        if start in q and end in q:
            q[difference] = q[end] - q[start]
        elif start in q and difference in q:
            q[end] = q[start] + q[difference]
        elif end in q and difference in q:
            q[start] = q[end] - q[difference]
    return q


def _without_span(known: Known) -> list[CatenaryShape]:
    q = _completed(known)
    if {"S", "V1"} <= q.keys():
        if "H" not in q and "Z" in q and "T1" not in q:
            q["T1"] = 0.5 * (q["S"] * (q["V1"] + q["V3"]) / q["Z"] - q["Z"])  # (4) for |T_1|
        if "H" not in q:
            q["H"] = _leg(q["T1"], q["V1"]) if "T1" in q else _leg(q["T3"], q["V3"])
        return [_from_ends(q["H"], q["V1"], q["V3"], q["S"])]
    if {"S", "Z"} <= q.keys():
        S, Z = q["S"], q["Z"]
        if "T1" not in q:
            across = np.sqrt((S - Z) * (S + Z))
            return [
                CatenaryShape(q["H"], np.arcsinh(Z / across), np.arcsinh(across / (2.0 * q["H"])))
            ]
        V_1 = Z / S * (q["T1"] + 0.5 * Z) - 0.5 * S  # (4)
        return [_from_ends(_leg(q["T1"], V_1), V_1, V_1 + S, S)]
    return _with_either_sign(q)


def _with_either_sign(q: Known) -> list[CatenaryShape]:
    """Solutions for a known H and a vertical tension of unknown sign."""
    if "H" not in q:
        q["H"] = _leg(q["T1"], q["V1"]) if "V1" in q else _leg(q["T3"], q["V3"])
    H = q["H"]
    if "S" in q:
        S = q["S"]
        if "T1" in q:
            V_1 = _leg(q["T1"], H)
            return [_from_ends(H, v, v + S, S) for v in (-V_1, V_1)]
        V_3 = _leg(q["T3"], H)
        return [_from_ends(H, v - S, v, S) for v in (-V_3, V_3)]
    if "V1" in q:
        T_3 = q["T3"] if "T3" in q else np.hypot(H, q["V1"]) + q["Z"]
        V_3 = _leg(T_3, H)
        return [_from_ends(H, q["V1"], v, _weight(q, H, q["V1"], v)) for v in (-V_3, V_3)]
    if "V3" in q:
        T_1 = q["T1"] if "T1" in q else np.hypot(H, q["V3"]) - q["Z"]
        V_1 = _leg(T_1, H)
        return [_from_ends(H, v, q["V3"], _weight(q, H, v, q["V3"])) for v in (V_1, -V_1)]
    V_1, V_3 = _leg(q["T1"], H), _leg(q["T3"], H)
    up = V_3 >= V_1
    v_1, v_3 = np.where(up, V_1, -V_1), np.where(up, V_3, -V_3)
    return [_from_ends(H, v, w, _weight(q, H, v, w)) for v, w in ((v_1, v_3), (-V_1, V_3))]


def _weight(q: Known, H: FloatArray, V_1: FloatArray, V_3: FloatArray) -> FloatArray:
    """`S = V_3 - V_1`, from Z by (4) where that difference would cancel."""
    T_1, T_3 = np.hypot(H, V_1), np.hypot(H, V_3)
    Z = q["Z"] if "Z" in q else T_3 - T_1
    return np.where(V_1 * V_3 > 0.0, Z * (T_1 + T_3) / (V_1 + V_3), V_3 - V_1)


def _with_span(known: Known) -> list[CatenaryShape]:
    q = _completed(known)
    X = q["X"]
    if "H" not in q and {"V1", "T1"} <= q.keys():
        q["H"] = _leg(q["T1"], q["V1"])
    if "H" in q:
        return _with_span_and_pull(q)
    if {"S", "V1"} <= q.keys():
        return [_from_ends(roots.tension_between(X, q["V1"], q["S"]), q["V1"], q["V3"], q["S"])]
    if {"Z", "T1"} <= q.keys():
        sweeps = roots.sweeps_of_tension(X, q["Z"], q["T1"] + q["T3"])
        return [_over(X, d, q["Z"]) for d in sweeps]
    if "S" in q:
        return _with_span_and_length(q)
    if "Z" in q:
        return [_over(X, d, q["Z"]) for d in roots.sweeps_of_fall(X, q["Z"], q["V1"])]
    sweeps = roots.sweeps_of_ends(X, q["V1"], q["T3"])
    return [CatenaryShape(X / (2.0 * d), np.arcsinh(2.0 * q["V1"] * d / X) + d, d) for d in sweeps]


def _with_span_and_pull(q: Known) -> list[CatenaryShape]:
    """Solutions for known X and H, which determine d."""
    H = q["H"]
    d = q["X"] / (2.0 * H)
    if "S" in q:
        cosh_m = q["S"] / (2.0 * H * np.sinh(d))
        m = np.arcsinh(np.sqrt((cosh_m - 1.0) * (cosh_m + 1.0)))
        return [CatenaryShape(H, -m, d), CatenaryShape(H, m, d)]
    if "Z" in q:
        return [_over(q["X"], d, q["Z"])]
    if "V1" in q:
        return [CatenaryShape(H, np.arcsinh(q["V1"] / H) + d, d)]
    a = np.arcsinh(_leg(q["T1"], H) / H)
    return [CatenaryShape(H, d - a, d), CatenaryShape(H, d + a, d)]


def _with_span_and_length(q: Known) -> list[CatenaryShape]:
    """Solutions for known X and S, with Z or T_1."""
    X, S = q["X"], q["S"]
    if "Z" in q:
        Z, chord = q["Z"], np.hypot(X, q["Z"])
        across = np.sqrt((S - Z) * (S + Z))
        slack = (S - chord) * (S + chord)
        d = roots.sweep_of_length(np.where(slack > 0.0, slack, np.nan) / X**2)
        return [CatenaryShape(X / (2.0 * d), np.arcsinh(Z / across), d)]
    return [
        _from_direction(S, q["T1"], plus, minus) for plus, minus in roots.directions(X, S, q["T1"])
    ]


def _over(X: FloatArray, d: FloatArray, Z: FloatArray) -> CatenaryShape:
    """The cable of sweep d between two points."""
    return CatenaryShape(X / (2.0 * d), np.arcsinh(Z * d / (X * np.sinh(d))), d)


def _from_direction(
    S: FloatArray, T_1: FloatArray, plus: FloatArray, minus: FloatArray
) -> CatenaryShape:
    """The cable of length S that leaves end 1 with T_1, at sin(angle) = plus - 1 = 1 - minus."""
    a = 0.5 * np.log(plus / minus)
    H = T_1 * np.sqrt(plus * minus)
    V_1 = T_1 * np.where(plus < minus, plus - 1.0, 1.0 - minus)
    return CatenaryShape(H, a + (d := _from_ends(H, V_1, V_1 + S, S).d), d)


def _from_ends(H: FloatArray, V_1: FloatArray, V_3: FloatArray, S: FloatArray) -> CatenaryShape:
    """The cable with known tensions at its ends; S is separate because V_3 - V_1 may cancel."""
    T_1, T_3 = np.hypot(H, V_1), np.hypot(H, V_3)
    q = S / (T_1 + T_3)
    a, b = np.arcsinh(V_1 / H), np.arcsinh(V_3 / H)
    return CatenaryShape(
        H, 0.5 * (a + b), np.where(q < 0.9, np.arctanh(np.minimum(q, 0.9)), 0.5 * (b - a))
    )


def _leg(tension: FloatArray, component: FloatArray) -> FloatArray:
    """The other component of a tension, NaN where there is none: (5)."""
    square = (tension - component) * (tension + component)
    return np.sqrt(np.where((square >= 0.0) & (tension > 0.0), square, np.nan))
