"""Which gains are tuned, from where, within which bounds and in which coordinates.

A point is a tuple of the tuned parameters in their own units; coordinates are what the tuners
step in: the logarithm of each parameter, as the paper has it, or the parameter itself. The paper's
reason for logarithms: they keep the gains positive, and a step means the same at every order of
magnitude.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, Self

from estune.core.gains import GAIN_NAMES, Gains
from estune.errors import InvalidInput

Point = tuple[float, ...]
"""Values of the tuned parameters, in their own units and the order of `SearchSpace.names`."""

Coordinates = tuple[float, ...]
"""The same as the tuners see it: logarithms on a logarithmic scale."""

PARALLEL_NAMES = GAIN_NAMES
STANDARD_NAMES = ("K", "Ti", "Td", "setpoint_filter_s")

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
"""What a unit of the logarithm of each parameter adds to those of P, I, D and the filter's time
constant, one row a parameter."""

_UNTUNED = {"I": 0.0, "D": 0.0, "Ti": math.inf, "Td": 0.0, "setpoint_filter_s": 0.0}
"""What a parameter that is neither tuned nor fixed is: absent. P and K cannot be."""


@dataclass(frozen=True, slots=True)
class SearchSpace:
    """The tuned parameters: where they start and how far they may go.

    Attributes:
        names: Which parameters are tuned: among P, I, D and setpoint_filter_s in the parallel
            form, among K, Ti, Td and setpoint_filter_s in the standard form.
        start: Where each begins.
        low: Lower bound of each; above zero on a logarithmic scale.
        high: Upper bound of each.
        scale: "log" to step in logarithms, "linear" to step in the parameters themselves.
        form: "parallel" `u = P e + I int(e) - D dy/dt`, or "standard" `K (1 + 1/(Ti s) + Td s)`.
        fixed: Name and value of parameters that are not tuned. One that is named neither here nor
            in `names` is absent: zero, or an infinite integral time.

    Raises:
        InvalidInput: a name is unknown or given twice, a value is not finite, the bounds are the
            wrong way round, the start is outside them, or a logarithm is asked of what has none.
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
        """The logarithmic space around some gains: every one from value/factor to value x factor.

        A gain that is zero has no logarithm: it is held at zero, unless bounds are given for it.

        Args:
            gains: Where the search begins.
            factor: How far each may go, above one.
            bounds: (low, high) of single parameters, in place of the factor.
            form: Which form's parameters are tuned.

        Raises:
            InvalidInput: the factor is not above one, the bounds name a parameter that is not
                there, or as for the class.
        """
        if not (math.isfinite(factor) and factor > 1.0):
            raise InvalidInput(f"factor is {factor}; it must be finite and above 1")
        values = gains.as_tuple()
        if form == "standard":
            values = (*gains.to_standard(), gains.setpoint_filter_s)
        given = dict(bounds or {})
        found = dict(zip(_names_of(form), values, strict=True))
        for name in given:
            if name not in found:
                raise InvalidInput(f"bounds for {name!r}; the parameters are {', '.join(found)}")
        tuned = [n for n, v in found.items() if n in given or (v > 0.0 and math.isfinite(v))]
        sides = [given.get(n, (found[n] / factor, found[n] * factor)) for n in tuned]
        return cls(
            names=tuple(tuned),
            start=tuple(found[n] for n in tuned),
            low=tuple(float(low) for low, _ in sides),
            high=tuple(float(high) for _, high in sides),
            form=form,
        )

    @property
    def coordinates_low(self) -> Coordinates:
        """The lower bounds in the tuners' coordinates."""
        return _in_coordinates(self.scale, self.low)

    @property
    def coordinates_high(self) -> Coordinates:
        """The upper bounds in the tuners' coordinates."""
        return _in_coordinates(self.scale, self.high)

    def coordinates(self, point: Point) -> Coordinates:
        """A point as the tuners see it."""
        return tuple(map(math.log, point)) if self.scale == "log" else point

    def clipped(self, coordinates: Coordinates) -> Coordinates:
        """The nearest coordinates within the bounds."""
        return tuple(
            [
                low if c < low else min(c, high)
                for c, low, high in zip(
                    coordinates, self.coordinates_low, self.coordinates_high, strict=True
                )
            ]
        )

    def point(self, coordinates: Coordinates) -> Point:
        """The point at these coordinates, or the nearest within the bounds."""
        if self.scale == "log":
            coordinates = tuple(map(math.exp, self.clipped(coordinates)))
        # Clipped last in the parameter's own unit: exp(log(x)) may be a rounding beyond x.
        return tuple(
            [
                low if c < low else min(c, high)
                for c, low, high in zip(coordinates, self.low, self.high, strict=True)
            ]
        )

    @property
    def directions(self) -> tuple[Directions, ...]:
        """Where each parameter leads, one table for every loop that the gains are for."""
        return (tuple([_DIRECTIONS[name] for name in self.names]),)

    def gains(self, point: Point) -> Gains:
        """The controller gains of a point.

        Raises:
            InvalidInput: a gain is below what it may be.
        """
        values = {**_UNTUNED, **dict(self.fixed), **dict(zip(self.names, point, strict=True))}
        if self.form == "standard":
            return Gains.from_standard(*[values[name] for name in STANDARD_NAMES])
        return Gains(*[values[name] for name in PARALLEL_NAMES])

    def point_of(self, gains: Gains) -> Point:
        """The tuned parameters of controller gains."""
        K, Ti, Td = gains.to_standard()
        values = dict(zip(PARALLEL_NAMES, gains.as_tuple(), strict=True))
        values |= {"K": K, "Ti": Ti, "Td": Td}
        return tuple(values[name] for name in self.names)

    def at_bound(self, point: Point, tolerance: float = 1e-3) -> dict[str, Literal["low", "high"]]:
        """Which parameters sit at a bound, where the cost may still be falling, and at which.

        Args:
            point: The point asked about.
            tolerance: How near counts as at the bound, as a share of the range in coordinates.
        """
        found: dict[str, Literal["low", "high"]] = {}
        rows = zip(
            self.names,
            self.coordinates(self.point(self.coordinates(point))),
            self.coordinates_low,
            self.coordinates_high,
            strict=True,
        )
        for name, c, low, high in rows:
            margin = tolerance * (high - low)
            if c <= low + margin:
                found[name] = "low"
            elif c >= high - margin:
                found[name] = "high"
        return found

    def _check_names(self) -> None:
        if self.scale not in ("log", "linear"):
            raise InvalidInput(f"scale is {self.scale!r}; it must be 'log' or 'linear'")
        if self.form not in ("parallel", "standard"):
            raise InvalidInput(f"form is {self.form!r}; it must be 'parallel' or 'standard'")
        known, told = _names_of(self.form), [*self.names, *(name for name, _ in self.fixed)]
        if not self.names:
            raise InvalidInput(
                "the search space tunes no parameter; name at least one of "
                f"{', '.join(known)}, with bounds around a start above zero"
            )
        for name in told:
            if name not in known:
                raise InvalidInput(
                    f"parameter {name!r} is not of the {self.form} form; "
                    f"choose among {', '.join(known)}"
                )
            if told.count(name) > 1:
                raise InvalidInput(f"parameter {name} is given more than once; name it once")
        if known[0] not in told:
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


@lru_cache(maxsize=256)
def _in_coordinates(scale: str, point: Point) -> Coordinates:
    """The same for the bounds, which every step of a tuner asks for."""
    return tuple(map(math.log, point)) if scale == "log" else point


def _names_of(form: str) -> tuple[str, ...]:
    return STANDARD_NAMES if form == "standard" else PARALLEL_NAMES
