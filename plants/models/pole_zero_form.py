"""A linear plant by its gain, modes and time constants, the form to which effects are added.

G(s) = K N(s)/D(s), a product of factors for poles and zeros: `1 + 2 zeta s/w + (s/w)^2` for a pair
(any two real ones of the same sign are one, with zeta above 1), `1 + T s` for a single real one,
`s` at the origin. So K is the gain at rest where nothing lies at the origin, each number has a
physical meaning, and a fit cannot change the excess of poles over zeros.
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
from plants.models.linear_structures import DrumStructure, MotionStateSpace
from plants.simulation.equations import Expression

if TYPE_CHECKING:  # python-control takes more than a second to import
    from control import TransferFunction

Kind = Literal["pair", "real", "origin"]

AT_ORIGIN = 1e-9
"""Size of a root at the origin, relative to the largest pole."""
AT_INFINITY = 1e7
"""Size above which a zero is infinite, relative to the largest pole."""
RESPONSE_RTOL = 1e-6


@dataclass(frozen=True, slots=True)
class PoleZeroForm:
    """Kinds of a plant's poles and zeros, one entry per factor, pairs first."""

    poles: tuple[Kind, ...]
    zeros: tuple[Kind, ...]

    is_drum: ClassVar[bool] = False  # a gauge reads the output

    @property
    def order(self) -> int:
        """Number of poles."""
        return _degree(self.poles)

    @property
    def excess(self) -> int:
        """Poles less zeros."""
        return self.order - _degree(self.zeros)

    @property
    def can_rest(self) -> bool:
        """Whether it can be at rest at an output other than zero."""
        return "origin" not in self.zeros

    @property
    def own(self) -> tuple[str, ...]:
        """Names of the gain, poles and zeros, and of the rate by which time is scaled, rad/s."""
        return ("gain", *_names(self.poles, ""), *_names(self.zeros, "zero_"), "rate_rad_s")

    def motion(self, p: SimpleNamespace) -> MotionStateSpace:
        """The plant in the observer's form from torque to angle, with added viscous friction."""
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
        return MotionStateSpace(A, B, C, E, V, self._restoring(gain))

    def numeric(self, values: dict[str, float]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A, B and C of `motion` for numbers, shapes (n, n), (n,) and (n,)."""
        own = {k: ca.DM(v) for k, v in values.items()}
        motion = self.motion(SimpleNamespace(viscous_friction_Nms=ca.DM(0.0), **own))
        A, B, C = (np.asarray(ca.evalf(part).full()) for part in (motion.A, motion.B, motion.C))
        return A, B.ravel(), C.ravel()

    def coefficients(self, values: dict[str, float]) -> tuple[list[Any], list[Any]]:
        """Numerator for a gain of one, and denominator, in ascending powers of s."""
        p = SimpleNamespace(**{**values, "rate_rad_s": 1.0})
        numerator = _polynomial(self._factors(p, self.zeros, "zero_"))
        return numerator, _polynomial(self._factors(p, self.poles, ""))

    def _restoring(self, gain: Expression) -> Expression | None:
        if not self.can_rest:
            return None
        return ca.SX(0.0) if "origin" in self.poles else 1.0 / gain

    def _factors(
        self, p: SimpleNamespace, kinds: tuple[Kind, ...], prefix: str
    ) -> Iterable[list[Any]]:
        """Coefficients of each factor in ascending powers of s/rate."""
        names = iter(_names(kinds, prefix))
        for kind in kinds:
            if kind == "origin":
                yield [0.0, p.rate_rad_s]
            elif kind == "real":
                yield [1.0, getattr(p, next(names)) * p.rate_rad_s]
            else:
                w = 2.0 * math.pi * getattr(p, next(names)) / p.rate_rad_s
                yield [1.0, 2.0 * getattr(p, next(names)) / w, 1.0 / w**2]


LinearBase = PoleZeroForm | DrumStructure
"""Kind of linear plant."""


def factorise(model: LinearModel) -> tuple[PoleZeroForm, dict[str, float]]:
    """Pole-zero form of a linear model, and its parameters by name.

    Raises:
        PlantError: the model has no states or no gain, or the form does not reproduce it.
    """
    A, B, C = np.array(model.A), np.array(model.B), np.array(model.C)
    if not B.size:
        raise PlantError("the linear plant has no states; give one with a pole")
    poles = np.linalg.eigvals(A)
    zeros = _zeros(A, B, C, model.E, poles)
    size = float(np.abs(poles).max(initial=0.0)) or 1.0
    pole_kinds, pole_numbers = _factors_of_roots(poles, size)
    zero_kinds, zero_numbers = _factors_of_roots(zeros, size)
    base = PoleZeroForm(pole_kinds, zero_kinds)
    away = np.abs(poles[np.abs(poles) > AT_ORIGIN * size])
    rate = float(np.exp(np.log(away).mean())) if away.size else 1.0
    names = (*_names(pole_kinds, ""), *_names(zero_kinds, "zero_"))
    numbers = dict(zip(names, (*pole_numbers, *zero_numbers), strict=True))
    at = 1j * rate * np.array([0.5, 1.1, 3.0])
    response = np.array([C @ np.linalg.solve(s * np.eye(B.size) - A, B) + model.E for s in at])
    numerator, denominator = base.coefficients(numbers)
    bare = np.polyval(numerator[::-1], at) / np.polyval(denominator[::-1], at)
    gain = complex(response[1] / bare[1])
    if not (
        abs(gain) > 0.0 and np.allclose(gain.real * bare, response, rtol=RESPONSE_RTOL, atol=0.0)
    ):
        raise PlantError(
            "the poles and zeros of the linear plant do not reproduce its response; give a model "
            "with fewer, well separated ones"
        )
    return base, {"gain": gain.real, **numbers, "rate_rad_s": rate}


def transfer_function(base: PoleZeroForm, values: dict[str, float]) -> "TransferFunction":
    """The plant as a transfer function of python-control."""
    from control import TransferFunction  # noqa: PLC0415  slow to import

    numerator, denominator = (
        np.array(part, dtype=np.float64)[::-1] for part in base.coefficients(values)
    )
    return TransferFunction(values["gain"] * numerator, denominator)


def _zeros(A: FloatArray, B: FloatArray, C: FloatArray, E: float, poles: Any) -> Any:
    """Finite zeros: the points at which the system's pencil loses rank."""
    from scipy.linalg import eigvals  # noqa: PLC0415  slow to import

    n = B.size
    pencil = np.block([[A, B[:, None]], [C[None], np.array([[E]])]])
    mass = np.zeros((n + 1, n + 1))
    mass[:n, :n] = np.eye(n)
    zeros = eigvals(pencil, mass)
    limit = AT_INFINITY * max(float(np.abs(poles).max(initial=0.0)), 1e-300)
    return zeros[np.isfinite(zeros) & (np.abs(zeros) < limit)]


def _factors_of_roots(roots: Any, size: float) -> tuple[tuple[Kind, ...], list[float]]:
    """Kinds of the roots' factors, pairs first, and their parameters."""
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
    """Names of the factors' parameters, numbered where a kind has several factors."""
    names: list[str] = []
    for kind, parts in (("pair", ("frequency", "damping")), ("real", ("time_constant",))):
        count = kinds.count(kind)
        for n in range(count):
            place = f"_{n + 1}" if count > 1 else ""
            units = {"frequency": "_Hz", "damping": "", "time_constant": "_s"}
            names += [f"{prefix}{part}{place}{units[part]}" for part in parts]
    return names


def _polynomial(factors: Iterable[list[Any]]) -> list[Any]:
    """Product of polynomials in ascending powers."""
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
