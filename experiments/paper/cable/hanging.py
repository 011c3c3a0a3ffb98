"""Catenary: a heavy inextensible cable in equilibrium, from any three of its quantities."""

from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import ArrayLike

from estune.core.quantities import (
    BoolArray,
    FloatArray,
    Numbers,
    checked_array,
    first_index,
    index_text,
    scalar_or_array,
)
from estune.errors import InvalidInput
from experiments.paper.cable.equilibrium import CatenaryShape, Known, solve_shapes
from experiments.paper.cable.reasons import explain_contradiction
from experiments.paper.cable.triples import NAMES, Solution, check_triple

_SHORT = dict(zip(NAMES, ("S", "Z", "X", "H", "V1", "V3", "T1", "T3"), strict=True))
_RESIDUAL = 1e-9
_LENGTHS = ("length_m", "rise_m", "span_m")
_SIGNED = ("rise_m", "tension_1z_N", "tension_3z_N")


@dataclass(frozen=True, slots=True)
class Catenary:
    """Cables in equilibrium; each quantity is a float, or an array of one common shape.

    The paper's variables in brackets; end 1 is the attachment at the reel, end 3 the far end.
    """

    weight_N_m: Numbers  # weight per length [mu g], N/m
    length_m: Numbers  # length along the cable [ds], m
    rise_m: Numbers  # height of end 3 above end 1 [dz], m
    span_m: Numbers  # horizontal distance between the ends [dx], m
    tension_x_N: Numbers  # horizontal tension, constant along the cable [T_x], N
    tension_1z_N: Numbers  # vertical tension at end 1 [T_1z], N; negative where the cable descends
    tension_3z_N: Numbers  # vertical tension at end 3 [T_3z], N
    tension_1_N: Numbers  # tension at end 1 [|T_1|], N
    tension_3_N: Numbers  # tension at end 3 [|T_3|], N

    def residual(self) -> Numbers:
        """Largest error of (3) to (6), each relative to its largest term."""
        w, s, z, x = self.weight_N_m, self.length_m, self.rise_m, self.span_m
        H, V_1, V_3 = self.tension_x_N, self.tension_1z_N, self.tension_3z_N
        T_1, T_3 = self.tension_1_N, self.tension_3_N
        W, deep = w * s, 2.0 * H / w * np.sinh(0.5 * w * x / H)
        errors = [
            _relative(s * s, -z * z, -deep * deep),  # (3), times (T_x/(mu g))^2
            _relative(V_1, -z / s * T_1, -z / s * 0.5 * w * z, 0.5 * W),  # (4)
            _relative(T_1 * T_1, -H * H, -V_1 * V_1),  # (5), squared
            _relative(V_3, -V_1, -W),  # (6), vertical component
            _relative(T_3 * T_3, -H * H, -V_3 * V_3),  # (6), magnitude
        ]
        return scalar_or_array(np.asarray(reduce(np.maximum, errors)))

    def points(self, count: int = 101) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Points evenly spaced along the cable, end 1 first.

        Args:
            count: Number of points, two or more.

        Returns:
            x and z from end 1 in m and the tension there in N, each of shape (..., count).
        """
        if count < 2:
            raise InvalidInput(f"count is {count}; it must be two or more")
        ends = (self.tension_x_N, self.tension_1z_N, self.tension_1_N)
        H, V_1, T_1 = (np.asarray(v)[..., None] for v in ends)
        w, s = np.asarray(self.weight_N_m)[..., None], np.asarray(self.length_m)[..., None]
        along = s * np.linspace(0.0, 1.0, count)
        V = V_1 + w * along
        T = np.hypot(H, V)
        half = w * along / (T_1 + T)
        # tanh of half the change of asinh(V/H); atanh is inaccurate near one, in a deep bow.
        swept = np.where(half < 0.9, 2.0 * np.arctanh(np.minimum(half, 0.9)), np.nan)
        swept = np.where(half < 0.9, swept, np.arcsinh(V / H) - np.arcsinh(V_1 / H))
        return H / w * swept, along * (V + V_1) / (T + T_1), T


def _relative(*terms: Numbers) -> FloatArray:
    total, largest = terms[0], np.abs(terms[0])
    for term in terms[1:]:
        total, largest = total + term, np.maximum(largest, np.abs(term))
    return np.asarray(np.abs(total) / largest)


def catenary(
    weight_N_m: ArrayLike, *, solution: Solution = "only", **known: ArrayLike
) -> Catenary:
    """All quantities of a hanging cable from three of them.

    Implements (3), (4) and (5).

    (3) is `(w/T_x)^2 (ds^2 - dz^2) = 2 (cosh(w dx/T_x) - 1)`, (4) is
    `T_1z = dz/ds (|T_1| + w dz/2) - w ds/2` and (5) is `T_x = sqrt(|T_1|^2 - T_1z^2)`, w = mu g:
    all three follow from the equilibrium of an element, which also gives `|T_3| = |T_1| + w dz`.
    The print has T_z for T_1z in (5). Of the 56 triples, 52 determine the cable (`ADMISSIBLE`)
    and four do not (`DEPENDENT`). For 27 of the 52 two cables may fit, such as a taut and a slack
    one: `solution` selects one. The residual of a result is below 1e-9, else an error is raised.

    With the density (2) at |T_1| the inextensible cable approximates a stiff one.

    Args:
        weight_N_m: Weight per length mu g, N/m, above zero.
        solution: "shorter" or "longer", or "lower" or "higher" (far end) where the length is
            known; "only" requires a unique solution.
        **known: Three of `length_m`, `rise_m`, `span_m`, `tension_x_N`, `tension_1z_N`,
            `tension_3z_N`, `tension_1_N`, `tension_3_N`, of shapes that broadcast.

    Returns:
        All quantities; floats where everything given is a scalar.

    Raises:
        InvalidInput: a value is out of its range, the triple is not admissible, no cable fits, or
            two fit and `solution` is "only".
    """
    for name in known:
        if name not in NAMES:
            raise InvalidInput(f"a hanging cable has no {name}; it has {', '.join(NAMES)}")
    solutions = check_triple(frozenset(known), solution)
    w = checked_array("weight_N_m", weight_N_m, "N/m", above=0.0)
    given = {name: _checked_known(name, values) for name, values in known.items()}
    try:
        w, *arrays = np.broadcast_arrays(w, *given.values())
    except ValueError:
        shapes_given = ", ".join(f"{n} {v.shape}" for n, v in given.items())
        raise InvalidInput(
            f"shapes do not broadcast: weight_N_m {w.shape}, {shapes_given}"
        ) from None
    given = dict(zip(given, arrays, strict=True))
    # Arithmetic errors mark elements without a solution, which `_solve` reports.
    with np.errstate(all="ignore"):
        shape = _solve(w, given, solution, solutions)
        cable = _quantities(w, given, shape)
        inexact = ~np.asarray(cable.residual() < _RESIDUAL)
    if inexact.any():
        place = first_index(inexact)
        values = ", ".join(f"{name} {v[place]:.6g}" for name, v in given.items())
        raise InvalidInput(
            f"the equilibrium is lost in rounding{index_text(place)}: {values} with "
            f"{w[place]:.6g} N/m are too many orders of magnitude apart, or too close to a "
            "straight line; check the units, or give another triple"
        )
    return cable


def far_tension_N(
    tension_1_N: ArrayLike, weight_N_m: ArrayLike, length_m: ArrayLike
) -> FloatArray:
    """Tension vector at the far end: `T_3 = T_1 + [0, mu g ds]`.

    Implements (6).

    Args:
        tension_1_N: Tension at the attachment (T_x, T_1z), N, shape (..., 2).
        weight_N_m: Weight per length mu g, N/m, shape (...).
        length_m: Length of the cable ds, m, shape (...).

    Returns:
        (T_x, T_3z), N, shape (..., 2).

    Raises:
        InvalidInput: a value is not finite or out of its range, or the vectors are not pairs.
    """
    T_1 = checked_array("tension_1", tension_1_N, "N")
    if T_1.ndim == 0 or T_1.shape[-1] != 2:
        raise InvalidInput(f"tension_1 has shape {T_1.shape}; it must be (..., 2), x and z")
    w = checked_array("weight_N_m", weight_N_m, "N/m", above=0.0)
    weight = np.asarray(w * checked_array("length_m", length_m, "m", above=0.0))
    return T_1 + np.stack([np.zeros_like(weight), weight], axis=-1)


def _checked_known(name: str, values: ArrayLike) -> FloatArray:
    unit = "m" if name in _LENGTHS else "N"
    return checked_array(name, values, unit, above=-np.inf if name in _SIGNED else 0.0)


def _solve(
    w: FloatArray,
    given: dict[str, FloatArray],
    solution: Solution,
    solutions: tuple[Solution, ...],
) -> CatenaryShape:
    known: Known = {
        _SHORT[name]: (v * w if name in _LENGTHS else v).ravel() for name, v in given.items()
    }
    found = [_valid(shape) for shape in solve_shapes(known)]
    if len(found) == 1:
        chosen = found[0]
    else:
        exists = [~np.isnan(shape.H) for shape in found]
        both = exists[0] & exists[1]
        if solution == "only":
            _refuse_two(w, found, both, solutions)
        chosen_solution = int(solution == solutions[1])
        take = np.where(both, chosen_solution, exists[1]).astype(bool)
        chosen = CatenaryShape(*(np.where(take, b, a) for a, b in zip(*found, strict=True)))
    missing = np.isnan(chosen.H)
    if missing.any():
        place = first_index(missing.reshape(w.shape))
        values = {name: float(v[place]) for name, v in given.items()}
        raise InvalidInput(
            f"no cable hangs so{index_text(place)}: "
            f"{explain_contradiction(float(w[place]), values)}"
        )
    return CatenaryShape(*(v.reshape(w.shape) for v in chosen))


def _valid(shape: CatenaryShape) -> CatenaryShape:
    """The shape with NaN where it is not that of a cable."""
    largest = np.cosh(np.abs(shape.m) + shape.d)
    good = (shape.H > 0.0) & (shape.d > 0.0) & np.isfinite(shape.H) & np.isfinite(largest)
    return CatenaryShape(*(np.where(good, v, np.nan) for v in shape))


def _refuse_two(
    w: FloatArray, found: list[CatenaryShape], both: BoolArray, solutions: tuple[Solution, ...]
) -> None:
    """Raises InvalidInput where two cables fit that differ by more than rounding."""
    apart = both & ~np.isclose(found[0].m, found[1].m, rtol=1e-6, atol=1e-6)
    apart |= both & ~np.isclose(found[0].d, found[1].d, rtol=1e-6, atol=0.0)
    if not apart.any():
        return
    place = first_index(apart.reshape(w.shape))
    flat = int(np.flatnonzero(apart)[0])
    choices = []
    for name, shape in zip(solutions, found, strict=True):
        H, m, d = (float(v[flat]) for v in shape)
        size = 2.0 * H * np.sinh(d) / float(w[place])
        choices.append(
            f"'{name}' (length {size * np.cosh(m):.6g} m, rise {size * np.sinh(m):.6g} m, "
            f"tension_x {H:.6g} N)"
        )
    raise InvalidInput(
        f"two cables fit{index_text(place)}; choose a solution: {' or '.join(choices)}"
    )


def _quantities(w: FloatArray, given: dict[str, FloatArray], shape: CatenaryShape) -> Catenary:
    """All quantities of the shape, with the given ones unchanged."""
    H, m, d = shape
    a, b = m - d, m + d
    swept = 2.0 * H * np.sinh(d) / w
    values = {
        "length_m": swept * np.cosh(m),
        "rise_m": swept * np.sinh(m),
        "span_m": 2.0 * H * d / w,
        "tension_x_N": H,
        "tension_1z_N": H * np.sinh(a),
        "tension_3z_N": H * np.sinh(b),
        "tension_1_N": H * np.cosh(a),
        "tension_3_N": H * np.cosh(b),
    } | given
    return Catenary(
        scalar_or_array(w.copy()),
        **{name: scalar_or_array(np.array(v)) for name, v in values.items()},
    )
