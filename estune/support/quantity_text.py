"""Quantities as text: a value with its unit, a time in the unit that suits it."""

_TIMES = ((1e-3, 1e6, "µs"), (1.0, 1e3, "ms"), (600.0, 1.0, "s"), (36e3, 1.0 / 60.0, "min"))
"""Below each time in s: values per second, and the unit."""


def with_unit(value: float, unit: str, digits: int) -> str:
    """A value with its unit, if it has one."""
    return f"{value:.{digits}g} {unit}".rstrip()


def time_text(time_s: float) -> str:
    """A time with three digits in µs, ms, s, min or h."""
    for below_s, per_s, unit in _TIMES:
        if abs(time_s) < below_s:
            return f"{time_s * per_s:.3g} {unit}"
    return f"{time_s / 3600.0:.3g} h"
