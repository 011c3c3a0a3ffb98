"""How a physical effect is declared, so that `reel + effect` is a new model."""

import math
from abc import ABC, abstractmethod
from dataclasses import MISSING, dataclass, field, fields
from enum import StrEnum
from types import SimpleNamespace
from typing import Any, ClassVar, NamedTuple

from estune.errors import InvalidInput

Signal = Any
"""A CasADi expression: no Python `if` may depend on it."""


class Port(StrEnum):
    """Where on the signal's path through the reel an effect sits, and which signal it changes.

    At the drum the effect adds to the torque that acts over a substep; at every other port it
    maps the signal as it passes. The cable and the drum are visited every substep, the others
    once a sample.
    """

    ACTUATOR = "actuator"  # commanded current, A
    DRUM = "drum"  # torque on the drum, N m
    CABLE = "cable"  # tension, N
    GAUGE = "gauge"  # tension read, N
    ENCODER = "encoder"  # angle read, rad


class Site(NamedTuple):
    """What an effect may know of the moment it acts in.

    Attributes:
        span_s: Time the effect's answer is held for, s.
        angle_rad: Drum angle; zero where the cable is just taut.
        velocity_rad_s: Drum velocity; at the drum port, the one the span would end with if the
            effect gave no torque.
        tension_N: Tension of the cable.
        torque_per_velocity: Torque that, held over the span, adds one unit of velocity at its
            end, N m per rad/s.
    """

    span_s: Signal
    angle_rad: Signal
    velocity_rad_s: Signal
    tension_N: Signal
    torque_per_velocity: Signal


class Parameter(NamedTuple):
    """What is known of one parameter of an effect.

    Attributes:
        low: Least value it may take.
        high: Greatest value.
        unit: Its unit.
    """

    low: float
    high: float
    unit: str


def parameter(value: float, *, low: float, high: float, unit: str) -> Any:
    """Declares a field of an effect as a parameter with its usual value, range and unit."""
    return field(default=value, metadata={"parameter": Parameter(low, high, unit)})


@dataclass(frozen=True)
class Effect(ABC):
    """A physical effect: every field is a `parameter`, the law is `respond`.

    Class attributes:
        name: Its slug.
        title: Its name in plain words.
        appearance: One sentence on what it looks like in data.
        port: Where it sits.
        states: How many numbers it remembers; they start at zero.

    Raises:
        InvalidInput: a parameter is outside its range.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    appearance: ClassVar[str]
    port: ClassVar[Port]
    states: ClassVar[int] = 0

    def __post_init__(self) -> None:
        for name, (low, high, unit) in self.parameters().items():
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                raise InvalidInput(
                    f"{self.name}: {name} is {value}; it must lie from {low:g} to {high:g} {unit}"
                )

    @classmethod
    def parameters(cls) -> dict[str, Parameter]:
        """The declared parameters by name, in the order of the fields."""
        declared = {f.name: f.metadata.get("parameter", MISSING) for f in fields(cls)}
        for name, found in declared.items():
            if found is MISSING:
                raise InvalidInput(f"{cls.__name__}.{name} has to be declared with parameter(...)")
        return declared

    @staticmethod
    @abstractmethod
    def respond(
        p: SimpleNamespace, state: Signal, signal: Signal, site: Site
    ) -> tuple[Signal, Signal]:
        """The law, written with CasADi expressions.

        Args:
            p: The parameters by name.
            state: What the effect remembers, a column of `states` numbers.
            signal: The signal at the port; at the drum, the torque other effects have added.
            site: The moment it acts in.

        Returns:
            The next state and the changed signal; at the drum, the torque this effect adds.
        """
