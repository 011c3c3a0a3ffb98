"""The tuned parameters: start, bounds and coordinates.

A point is a tuple of the tuned parameters in their own units. Its coordinates, in which the tuners
step, are the logarithm of each parameter, as in the paper, or the parameter itself. Logarithms
keep the gains positive, and a step means the same at every order of magnitude.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Literal, Self

import numpy as np

from estune.core.gains import GAIN_NAMES, Gains
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput

Point = tuple[float, ...]
"""Values of the tuned parameters, in their own units and the order of `SearchSpace.names`."""

Coordinates = tuple[float, ...]
"""Coordinates of a point: logarithms on a logarithmic scale."""

NAMES = {
    "parallel": GAIN_NAMES,
    "standard": ("K", "Ti", "Td", "setpoint_filter_s"),
}
"""Parameters of each form of the controller."""

_DIRECTIONS = {
    "P": (1.0, 0.0, 0.0, 0.0),
    "I": (0.0, 1.0, 0.0, 0.0),
    "D": (0.0, 0.0, 1.0, 0.0),
    "setpoint_filter_s": (0.0, 0.0, 0.0, 1.0),
    "K": (1.0, 1.0, 1.0, 0.0),
    "Ti": (0.0, -1.0, 0.0, 0.0),
    "Td": (0.0, 0.0, 1.0, 0.0),
}
"""log P = log K, log I = log K - log Ti and log D = log K + log Td."""

Directions = tuple[tuple[float, ...], ...]
"""Change of the logarithms of P, I, D and the filter's time constant with that of each parameter,
one row a parameter."""

ROUNDING = 1e-5
"""Relative difference below which points are the same: six digits are kept."""

_ABSENT = {"I": 0.0, "D": 0.0, "Ti": math.inf, "Td": 0.0, "setpoint_filter_s": 0.0}
"""Value of a parameter that is neither tuned nor fixed. P and K cannot be absent."""


@dataclass(frozen=True, slots=True)
class SearchSpace:
    """The tuned parameters with their start and bounds.

    Attributes:
        names: The tuned parameters: among P, I, D and setpoint_filter_s in the parallel form,
            among K, Ti, Td and setpoint_filter_s in the standard form.
        low: Lower bound of each; above zero on a logarithmic scale.
        scale: "log" to step in logarithms, "linear" to step in the parameters themselves.
        form: "parallel" `u = P e + I int(e) - D dy/dt`, or "standard" `K (1 + 1/(Ti s) + Td s)`.
        fixed: Name and value of parameters that are not tuned. A parameter named neither here nor
            in `names` is absent: zero, or an infinite integral time.

    Raises:
        InvalidInput: a name is unknown or given twice, a value is not finite, the bounds are the
            wrong way round, the start is outside them, or a bound has no logarithm.
    """

    names: tuple[str, ...]
    start: Point
    low: Point
    high: Point
    scale: Literal["log", "linear"] = "log"
    form: Literal["parallel", "standard"] = "parallel"
    fixed: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        self._check_names()
        for values in (self.start, self.low, self.high):
            if len(values) != len(self.names):
                raise InvalidInput(
                    f"the search space names {len(self.names)} parameters but gives {len(values)} "
                    "values; start, low and high need one for each name"
                )
        for name, start, low, high in zip(
            self.names, self.start, self.low, self.high, strict=True
        ):
            self._check_parameter(name, start, low, high)
        self.gains(self.start)  # refuses fixed values that no controller can have

    @classmethod
    def around(
        cls,
        gains: Gains,
        factor: float = 100.0,
        *,
        bounds: Mapping[str, tuple[float, float]] | None = None,
        form: Literal["parallel", "standard"] = "parallel",
    ) -> Self:
        """The logarithmic space around some gains: each from value/factor to value x factor.

        A gain that is zero has no logarithm: it is held at zero, and bounds for it are refused.

        Args:
            factor: Extent to either side, above one.
            bounds: (low, high) of single parameters, in place of the factor.
            form: The form whose parameters are tuned.

        Raises:
            InvalidInput: the factor is not above one, the bounds name an unknown parameter, or as
                for the class.
        """
        if not (math.isfinite(factor) and factor > 1.0):
            raise InvalidInput(f"factor is {factor}; it must be finite and above 1")
        values = gains.as_tuple()
        if form == "standard":
            values = (*gains.to_standard(), gains.setpoint_filter_s)
        bounds = dict(bounds or {})
        starts = dict(zip(NAMES[form], values, strict=True))
        for name in bounds:
            if name not in starts:
                raise InvalidInput(f"bounds for {name!r}; the parameters are {', '.join(starts)}")
        tuned = [n for n, v in starts.items() if n in bounds or (v > 0.0 and math.isfinite(v))]
        sides = [bounds.get(n, (starts[n] / factor, starts[n] * factor)) for n in tuned]
        return cls(
            names=tuple(tuned),
            start=tuple(starts[n] for n in tuned),
            low=tuple(float(low) for low, _ in sides),
            high=tuple(float(high) for _, high in sides),
            form=form,
        )

    def within(self, allowed: Mapping[str, tuple[float, float]]) -> Self:
        """The space without what a rig refuses of the parameters that are named.

        Raises:
            InvalidInput: the rig refuses the start, or nothing but it is left.
        """
        ends = [allowed.get(name, (-math.inf, math.inf)) for name in self.names]
        for name, start, (least, most) in zip(self.names, self.start, ends, strict=True):
            if not least <= start <= most:
                raise InvalidInput(
                    f"the search starts at {name} {start:g}, outside the rig's bounds of a "
                    f"trial's gains, {least:g} to {most:g}; start from other gains"
                )
        low = tuple(max(a, least) for a, (least, _) in zip(self.low, ends, strict=True))
        high = tuple(min(b, most) for b, (_, most) in zip(self.high, ends, strict=True))
        return replace(self, low=low, high=high)

    @property
    def coordinate_bounds(self) -> tuple[Coordinates, Coordinates]:
        """The lower and the upper bounds in coordinates."""
        return _cached_bounds(self.scale, self.low, self.high)

    def coordinates(self, point: Point) -> Coordinates:
        """The coordinates of a point."""
        return tuple(map(math.log, point)) if self.scale == "log" else point

    def clipped(self, coordinates: Coordinates) -> Coordinates:
        """The nearest coordinates within the bounds."""
        return _clip(coordinates, *self.coordinate_bounds)

    def point(self, coordinates: Coordinates) -> Point:
        """The point at these coordinates, or the nearest within the bounds."""
        if self.scale == "log":
            coordinates = tuple(map(math.exp, self.clipped(coordinates)))
        # Clipped last in the parameter's own unit: exp(log(x)) may be a rounding beyond x.
        return _clip(coordinates, self.low, self.high)

    def from_start(self, point: Point) -> Coordinates:
        """Coordinates of a point relative to the start."""
        start = self.coordinates(self.start)
        return tuple([c - s for c, s in zip(self.coordinates(point), start, strict=True)])

    def rounded_point(self, relative: Iterable[float]) -> Point:
        """The point at coordinates relative to the start, rounded, within the bounds.

        Six digits hide the last bits of a matrix product, which differ between machines, so that
        a run can be resumed on another one.
        """
        start = self.coordinates(self.start)
        exact = self.point(tuple([s + c for s, c in zip(start, relative, strict=True)]))
        return _clip(tuple([float(f"{value:.6g}") for value in exact]), self.low, self.high)

    def is_same(self, one: Point, other: Point) -> bool:
        """Whether two points differ by no more than the rounding of `rounded_point`."""
        return all(map(partial(math.isclose, rel_tol=ROUNDING), one, other))

    @property
    def directions(self) -> Directions:
        """Directions of the parameters."""
        return tuple([_DIRECTIONS[name] for name in self.names])

    def gains(self, point: Point) -> Gains:
        """The controller gains of a point.

        Raises:
            InvalidInput: a gain is below its least value.
        """
        values = {**_ABSENT, **dict(self.fixed), **dict(zip(self.names, point, strict=True))}
        ordered = [values[name] for name in NAMES[self.form]]
        return Gains.from_standard(*ordered) if self.form == "standard" else Gains(*ordered)

    def point_of(self, gains: Gains) -> Point:
        """The tuned parameters of controller gains."""
        K, Ti, Td = gains.to_standard()
        values = dict(zip(GAIN_NAMES, gains.as_tuple(), strict=True))
        values |= {"K": K, "Ti": Ti, "Td": Td}
        return tuple(values[name] for name in self.names)

    def points_of(self, gains: FloatArray) -> FloatArray:
        """`point_of` of gains by rows, shape (trials, 4)."""
        P, I, D, filter_s = gains.reshape(-1, len(GAIN_NAMES)).T
        Ti = np.divide(P, I, out=np.full_like(P, np.inf), where=I > 0.0)
        values = {"P": P, "I": I, "D": D, "setpoint_filter_s": filter_s}
        values |= {"K": P, "Ti": Ti, "Td": D / P}
        return np.column_stack([values[name] for name in self.names])

    def at_bound(self, point: Point, tolerance: float = 1e-3) -> dict[str, Literal["low", "high"]]:
        """The parameters at a bound, where the cost may still be falling, and which bound.

        Args:
            tolerance: Greatest distance from a bound, as a share of the range in coordinates.
        """
        bounds: dict[str, Literal["low", "high"]] = {}
        rows = zip(
            self.names,
            self.coordinates(self.point(self.coordinates(point))),
            *self.coordinate_bounds,
            strict=True,
        )
        for name, c, low, high in rows:
            margin = tolerance * (high - low)
            if c <= low + margin:
                bounds[name] = "low"
            elif c >= high - margin:
                bounds[name] = "high"
        return bounds

    def _check_names(self) -> None:
        if self.scale not in ("log", "linear"):
            raise InvalidInput(f"scale is {self.scale!r}; it must be 'log' or 'linear'")
        if self.form not in NAMES:
            raise InvalidInput(f"form is {self.form!r}; it must be 'parallel' or 'standard'")
        known, given = NAMES[self.form], [*self.names, *(name for name, _ in self.fixed)]
        if not self.names:
            raise InvalidInput(
                "the search space tunes no parameter; name at least one of "
                f"{', '.join(known)}, with bounds around a start above zero"
            )
        for name in given:
            if name not in known:
                raise InvalidInput(
                    f"parameter {name!r} is not of the {self.form} form; "
                    f"choose among {', '.join(known)}"
                )
            if given.count(name) > 1:
                raise InvalidInput(f"parameter {name} is given more than once; name it once")
        if known[0] not in given:
            raise InvalidInput(f"{known[0]} is neither tuned nor fixed; a controller needs it")

    def _check_parameter(self, name: str, start: float, low: float, high: float) -> None:
        # isfinite first: a NaN passes every comparison with a bound.
        for what, value in (("start", start), ("lower bound", low), ("upper bound", high)):
            if not math.isfinite(value):
                raise InvalidInput(f"{name}: {what} is {value}; give a finite number")
        if not low < high:
            raise InvalidInput(
                f"{name}: lower bound {low:g} is not below upper bound {high:g}; swap them"
            )
        if self.scale == "log" and low <= 0.0:
            raise InvalidInput(
                f"{name}: lower bound {low:g} has no logarithm; set it above zero, or hold the "
                "parameter fixed"
            )
        if low < 0.0:
            raise InvalidInput(f"{name}: lower bound {low:g} is below 0; no gain may be negative")
        if not low <= start <= high:
            raise InvalidInput(
                f"{name}: start {start:g} is outside its bounds {low:g} to {high:g}; "
                "move the start or widen the bounds"
            )


def _clip(values: Point, low: Point, high: Point) -> Point:
    rows = zip(values, low, high, strict=True)
    return tuple([least if v < least else min(v, most) for v, least, most in rows])


@lru_cache(maxsize=256)
def _cached_bounds(scale: str, low: Point, high: Point) -> tuple[Coordinates, Coordinates]:
    """Coordinates of bounds, which every step of a tuner needs."""
    if scale == "log":
        return tuple(map(math.log, low)), tuple(map(math.log, high))
    return low, high
