"""Free parameters of a fit: their ranges, and what is known of them before any record."""

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.models.calibration import Calibration

BASE = "base"
"""Owner of the base-model parameters that all records share."""

CALIBRATION = Calibration.name


@dataclass(frozen=True, slots=True)
class Free:
    """One free parameter of a fit.

    Attributes:
        name: Unique in a predictor; ends in `[n]` for a parameter of the nth record, is
            `slug.parameter` for one of an effect.
        unit: Its unit; empty for a plain number.
        start: Initial value: the model's, or else one of the size of the data.
        owner: `base`, `record 3`, or the slug of an effect.
        neutral: The value at which the effect does nothing, or None.
        prior: Standard deviation of what the model states of it, of its logarithm where the scale
            is `log`; None where the records alone decide.
    """

    name: str
    unit: str
    start: float
    low: float
    high: float
    scale: Literal["log", "linear"]
    owner: str
    neutral: float | None = None
    prior: float | None = None


class Slot(NamedTuple):
    """A free parameter and its place in the parameter table.

    Attributes:
        column: Name of the structure's parameter, `calibration.name` for one of `Calibration`, or
            one of `SENSORS`.
        factor: Factor from the free parameter to the column.
    """

    free: Free
    column: str
    factor: float = 1.0
    record: int | None = None


def informed(free: Free, deviation: float | None) -> Free:
    """A parameter with a relative standard deviation of what the model states of it."""
    if deviation is None or not free.start:
        return free
    return replace(free, prior=deviation * (1.0 if free.scale == "log" else abs(free.start)))


def prior_deviation(free: Free, value: float) -> float:
    """Prior deviation of a value: itself where it is fitted on a log scale."""
    if free.scale == "log":
        return abs(value)
    return max(abs(value), abs(free.start), 1e-3 * (free.high - free.low))


def positive(name: str, unit: str, value: float, owner: str = BASE) -> Free:
    """A positive parameter, within a factor of its given value."""
    return Free(name, unit, value, value / CONSTANTS.range, value * CONSTANTS.range, "log", owner)


def either_way(name: str, unit: str, value: float, reach: float, owner: str = BASE) -> Free:
    """A parameter that may differ by so much from its given value."""
    return Free(name, unit, value, value - reach, value + reach, "linear", owner)


def from_zero(name: str, unit: str, value: float, most: float) -> Free:
    """A parameter between zero and a greatest value."""
    return Free(name, unit, value, 0.0, most, "linear", BASE)


def of_calibration(free: Free, name: str = "", factor: float = 1.0) -> Slot:
    """A parameter of the calibration, by its own name there."""
    return Slot(free, f"{CALIBRATION}.{name or free.name}", factor)
