"""Quantities as text: a value with its unit, a time in the unit that suits it."""

from typing import NamedTuple


class TimeUnit(NamedTuple):
    """A unit of time, for times below a limit in s.

    Attributes:
        per_s: Values per second.
    """

    below_s: float
    per_s: float
    name: str


_HOURS = TimeUnit(float("inf"), 1.0 / 3600.0, "h")
_AXES = (TimeUnit(600.0, 1.0, "s"), TimeUnit(36e3, 1.0 / 60.0, "min"), _HOURS)
_TIMES = (TimeUnit(1e-3, 1e6, "µs"), TimeUnit(1.0, 1e3, "ms"), *_AXES)


def with_unit(value: float, unit: str, digits: int) -> str:
    """A value with its unit, if it has one."""
    return f"{value:.{digits}g} {unit}".rstrip()


def interval_text(value: float, ends: tuple[float, float], unit: str, digits: int) -> str:
    """A value with its unit and interval, with more digits where the ends would look the same."""
    for shown in range(digits, digits + 3):
        low, high = (f"{end:.{shown}g}" for end in ends)
        if low != high:
            return f"{with_unit(value, unit, shown)} ({low} to {high})"
    return with_unit(value, unit, digits)


def change_text(before: str, after: str) -> str:
    """Two quantities as text, with their unit once if it is the same: `193 → 30 ms`."""
    value, space, unit = before.rpartition(" ")
    is_shared = space and value and after.rpartition(" ")[2] == unit
    return f"{value if is_shared else before} → {after}"


def axis_label(name: str, unit: str) -> str:
    """A name with its unit, if it has one, as of an axis or a column."""
    return f"{name}, {unit}" if unit else name


def time_text(time_s: float) -> str:
    """A time with three digits in µs, ms, s, min or h."""
    unit = next((unit for unit in _TIMES if abs(time_s) < unit.below_s), _HOURS)
    return f"{time_s * unit.per_s:.3g} {unit.name}"


def axis_unit(duration_s: float) -> tuple[float, str]:
    """Values per second and name of the unit of an axis over this duration: s, min or h."""
    unit = next((unit for unit in _AXES if duration_s < unit.below_s), _HOURS)
    return unit.per_s, unit.name
