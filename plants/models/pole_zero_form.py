"""A linear plant by its gain, modes and time constants, in the form that effects attach to.

G(s) = K N(s)/D(s), a product of factors for poles and zeros: `1 + 2 zeta s/w + (s/w)^2` for a pair
(any two real ones of the same sign are one, with zeta above 1), `1 + T s` for a single real one,
`s` at the origin. So K is the gain at rest where nothing lies at the origin, each number has a
meaning of its own, and the excess of poles over zeros stays as it is when a fit moves them.
"""

import cmath
import math
from collections.abc import Iterable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import casadi as ca
import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import PlantError
from estune.trial import LinearModel
from plants.models.linear_structures import Motion
from plants.simulation.equations import Expression

if TYPE_CHECKING:  # python-control takes more than a second to import
    from control import TransferFunction

Kind = Literal["pair", "real", "origin"]

AT_ORIGIN = 1e-9
"""A root is at the origin where it is smaller than the largest pole by this."""
AT_INFINITY = 1e7
"""A zero is none where it is larger than the largest pole by this."""
AGREES = 1e-6


@dataclass(frozen=True, slots=True)
class Rational:
    """The kinds of a plant's poles and zeros; its parameters are their numbers.

    Attributes:
        poles: One entry a factor, pairs first.
        zeros: The same.
    """

    poles: tuple[Kind, ...]
    zeros: tuple[Kind, ...]

    is_drum: ClassVar[bool] = False

    @property
    def order(self) -> int:
        """Number of poles."""
        return _degree(self.poles)

    @property
    def excess(self) -> int:
        """Poles less zeros."""
        return self.order - _degree(self.zeros)

    @property
    def own(self) -> tuple[str, ...]:
        """The gain, then poles, then zeros, then the rate by which time is scaled, rad/s."""
        return ("gain", *_names(self.poles, ""), *_names(self.zeros, "zero_"), "rate_rad_s")

    def motion(self, p: SimpleNamespace) -> Motion:
        """The plant in the observer's form, from torque to angle, with friction added to it."""
        rate = p.rate_rad_s
        gain = p.gain * p.torque_unit / p.angle_unit
        denominator = _polynomial(self._factors(p, self.poles, ""))
        numerator = _polynomial(self._factors(p, self.zeros, "zero_"))
        n, lead = self.order, denominator[-1]
        a = [c / lead for c in denominator[:-1]]  # ascending, of s/rate, monic
        b = [gain * c / lead for c in numerator] + [ca.SX(0.0)] * (n + 1 - len(numerator))
        E = b[n] if self.excess == 0 else ca.SX(0.0)
        A, B, C = ca.SX(n, n), ca.SX(n, 1), ca.SX(1, n)
        C[0] = 1.0
        for k in range(n):
            A[k, 0] = -rate * a[n - 1 - k]
            if k + 1 < n:
                A[k, k + 1] = rate
            if n - 1 - k <= _degree(self.zeros) or self.excess == 0:
                B[k] = rate * (b[n - 1 - k] - E * a[n - 1 - k])
        V = C @ A if self.excess >= 2 else None
        if V is not None:
            A = A - p.viscous_friction_Nms * (B @ V)
        return Motion(A, B, C, E, V, self._restoring(gain))

    def numeric(self, values: dict[str, float]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A, B and C of `motion` for numbers, shapes (n, n), (n,) and (n,)."""
        own = {k: ca.DM(v) for k, v in values.items()}
        motion = self.motion(SimpleNamespace(viscous_friction_Nms=ca.DM(0.0), **own))
        A, B, C = (np.asarray(ca.evalf(part).full()) for part in (motion.A, motion.B, motion.C))
        return A, B.ravel(), C.ravel()

    def _restoring(self, gain: Expression) -> Expression | None:
        if "origin" in self.zeros:
            return None
        return ca.SX(0.0) if "origin" in self.poles else 1.0 / gain

    def _factors(
        self, p: SimpleNamespace, kinds: tuple[Kind, ...], prefix: str
    ) -> Iterable[list[Any]]:
        """Each factor's coefficients, ascending, of s/rate."""
        names = iter(_names(kinds, prefix))
        for kind in kinds:
            if kind == "origin":
                yield [0.0, p.rate_rad_s]
            elif kind == "real":
                yield [1.0, getattr(p, next(names)) * p.rate_rad_s]
            else:
                w = 2.0 * math.pi * getattr(p, next(names)) / p.rate_rad_s
                yield [1.0, 2.0 * getattr(p, next(names)) / w, 1.0 / w**2]


def factorised(model: LinearModel) -> tuple[Rational, dict[str, float]]:
    """A linear model's kinds of poles and zeros, and their numbers by name.

    Raises:
        PlantError: it has no states or no gain, or its poles and zeros do not give it back.
    """
    A, B, C = np.array(model.A), np.array(model.B), np.array(model.C)
    if not B.size:
        raise PlantError("the linear plant has no states, so that nothing moves in it")
    poles = np.linalg.eigvals(A)
    zeros = _zeros(A, B, C, model.E, poles)
    size = float(np.abs(poles).max(initial=0.0)) or 1.0
    pole_kinds, pole_numbers = _sorted(poles, size)
    zero_kinds, zero_numbers = _sorted(zeros, size)
    base = Rational(pole_kinds, zero_kinds)
    away = np.abs(poles[np.abs(poles) > AT_ORIGIN * size])
    rate = float(np.exp(np.log(away).mean())) if away.size else 1.0
    names = (*_names(pole_kinds, ""), *_names(zero_kinds, "zero_"))
    numbers = dict(zip(names, (*pole_numbers, *zero_numbers), strict=True))
    at = 1j * rate * np.array([0.5, 1.1, 3.0])
    wanted = np.array([C @ np.linalg.solve(s * np.eye(B.size) - A, B) + model.E for s in at])
    bare = _response(base, {"gain": 1.0, **numbers}, at)
    gain = complex(wanted[1] / bare[1])
    if not (abs(gain) > 0.0 and np.allclose(gain.real * bare, wanted, rtol=AGREES, atol=0.0)):
        raise PlantError(
            "the linear plant cannot be told by its poles and zeros: they do not give its "
            "response back; give it with fewer, well separated ones"
        )
    return base, {"gain": gain.real, **numbers, "rate_rad_s": rate}


def transfer_function(base: Rational, values: dict[str, float]) -> "TransferFunction":
    """The plant in python-control."""
    from control import TransferFunction  # noqa: PLC0415  slow to import

    p = SimpleNamespace(**{**values, "rate_rad_s": 1.0})
    numerator, denominator = (
        np.array(_polynomial(base._factors(p, kinds, prefix)), dtype=np.float64)[::-1]  # noqa: SLF001  its own module
        for kinds, prefix in ((base.zeros, "zero_"), (base.poles, ""))
    )
    return TransferFunction(values["gain"] * numerator, denominator)


def _response(base: Rational, values: dict[str, float], s: Any) -> Any:
    p = SimpleNamespace(**{**values, "rate_rad_s": 1.0})
    numerator = _polynomial(base._factors(p, base.zeros, "zero_"))  # noqa: SLF001  its own module
    denominator = _polynomial(base._factors(p, base.poles, ""))  # noqa: SLF001  its own module
    return np.polyval(numerator[::-1], s) / np.polyval(denominator[::-1], s) * values["gain"]


def _zeros(A: FloatArray, B: FloatArray, C: FloatArray, E: float, poles: Any) -> Any:
    """Finite zeros: where the pencil of the system loses rank."""
    from scipy.linalg import eigvals  # noqa: PLC0415  slow to import

    n = B.size
    pencil = np.block([[A, B[:, None]], [C[None], np.array([[E]])]])
    mass = np.zeros((n + 1, n + 1))
    mass[:n, :n] = np.eye(n)
    found = eigvals(pencil, mass)
    limit = AT_INFINITY * max(float(np.abs(poles).max(initial=0.0)), 1e-300)
    return found[np.isfinite(found) & (np.abs(found) < limit)]


def _sorted(roots: Any, size: float) -> tuple[tuple[Kind, ...], list[float]]:
    """The factors of some roots: their kinds, pairs first, and their numbers."""
    at_origin = np.abs(roots) <= AT_ORIGIN * size
    away = [complex(r) for r in roots[~at_origin]]
    pairs = [r for r in away if r.imag > AT_ORIGIN * size]
    reals = sorted(r.real for r in away if abs(r.imag) <= AT_ORIGIN * size)
    numbers: list[float] = []
    for r in pairs:
        numbers += [abs(r) / (2.0 * math.pi), -r.real / abs(r)]
    single: list[float] = []
    for group in ([r for r in reals if r < 0.0], [r for r in reals if r > 0.0]):
        while len(group) > 1:
            fast, slow = group.pop(0), group.pop()
            w = cmath.sqrt(fast * slow).real
            numbers += [w / (2.0 * math.pi), -(fast + slow) / (2.0 * w)]
            pairs.append(complex(w))
        single += group
    numbers += [-1.0 / r for r in single]
    counts: dict[Kind, int] = {
        "pair": len(pairs),
        "real": len(single),
        "origin": int(at_origin.sum()),
    }
    return tuple(kind for kind, count in counts.items() for _ in range(count)), numbers


def _names(kinds: tuple[Kind, ...], prefix: str) -> list[str]:
    """Names of the factors' numbers; a lone factor of its kind goes without a number."""
    names: list[str] = []
    for kind, parts in (("pair", ("frequency", "damping")), ("real", ("time_constant",))):
        count = kinds.count(kind)
        for n in range(count):
            place = f"_{n + 1}" if count > 1 else ""
            units = {"frequency": "_Hz", "damping": "", "time_constant": "_s"}
            names += [f"{prefix}{part}{place}{units[part]}" for part in parts]
    return names


def _polynomial(factors: Iterable[list[Any]]) -> list[Any]:
    """The product of polynomials, ascending."""
    product: list[Any] = [1.0]
    for factor in factors:
        longer: list[Any] = [0.0] * (len(product) + len(factor) - 1)
        for n, a in enumerate(product):
            for m, b in enumerate(factor):
                longer[n + m] = longer[n + m] + a * b
        product = longer
    return product


def _degree(kinds: tuple[Kind, ...]) -> int:
    return sum(2 if kind == "pair" else 1 for kind in kinds)
