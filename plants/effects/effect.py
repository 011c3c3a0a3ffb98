"""How a physical effect is declared, so that `reel + effect` is a new model."""

import math
from abc import ABC
from dataclasses import MISSING, dataclass, field, fields
from enum import StrEnum
from types import SimpleNamespace
from typing import Any, ClassVar, NamedTuple, Self

from estune.errors import InvalidInput

Signal = Any
"""A CasADi expression: no Python `if` may depend on it."""


class Port(StrEnum):
    """Where on the signal's path through the reel an effect sits, and which signal it changes.

    At the drum the effect adds to the torque that acts over a substep; at every other port it
    maps the signal as it passes. Drum, cable and eyelet are visited every substep, the others
    once a sample.
    """

    ACTUATOR = "actuator"  # commanded current, A
    DRUM = "drum"  # torque on the drum, N m
    CABLE = "cable"  # tension outside the eyelet, N; below zero by what the linear law is slack
    EYELET = "eyelet"  # from the tension outside to that between eyelet and drum, N
    GAUGE = "gauge"  # tension read, N
    ENCODER = "encoder"  # angle read, rad


class Site(NamedTuple):
    """What an effect may know of the moment it acts in.

    Attributes:
        port: The port being visited.
        span_s: Time the effect's answer is held for, s.
        angle_rad: Drum angle, zero where the cable is just taut; at drum, cable and eyelet in the
            middle of the span.
        start_velocity_rad_s: Drum velocity at the start of the span.
        velocity_rad_s: At the drum, the velocity the span would end with if the effect gave no
            torque; elsewhere as at the start.
        tension_N: At the drum, the tension that acts on it; elsewhere that of the linear law.
        torque_per_velocity: Torque that, held over the span, adds one unit of velocity at its
            end, N m per rad/s.
        friction_Nm: At the drum, the torque of effects that resist, for one that divides.
    """

    port: Port
    span_s: Signal
    angle_rad: Signal
    start_velocity_rad_s: Signal
    velocity_rad_s: Signal
    tension_N: Signal
    torque_per_velocity: Signal
    friction_Nm: Signal = 0.0


WINDS_rad = 8.0 * math.pi
"""How far a phase goes either way: while a period is sought it winds up with it."""


class Parameter(NamedTuple):
    """What is known of one parameter of an effect.

    Attributes:
        low: Least value it may take.
        high: Greatest value.
        unit: Its unit; empty for a plain number.
        neutral: The value at which the effect does nothing, whatever its other parameters; None
            where there is no such value.
        begun: Where a fit begins that knows nothing of it, and tries no other value; None is the
            usual value, and where nothing is neutral several about it.
    """

    low: float
    high: float
    unit: str
    neutral: float | None
    begun: float | None = None

    @property
    def is_phase(self) -> bool:
        """Whether it is a phase."""
        return self.unit == "rad" and (self.low, self.high) == (-WINDS_rad, WINDS_rad)


def parameter(
    value: float,
    *,
    low: float,
    high: float,
    unit: str,
    neutral: float | None = None,
    begun: float | None = None,
) -> Any:
    """Declares a field of an effect as a parameter: usual value, and the fields of `Parameter`."""
    declared = Parameter(low, high, unit, neutral, begun)
    return field(default=value, metadata={"parameter": declared})


@dataclass(frozen=True)
class Effect(ABC):
    """A physical effect: every field is a `parameter`, the law is `respond`.

    One parameter at least has a neutral value. `amend`, `prepare` and `rest` are there for the
    effects that need them.

    Class attributes:
        name: Its slug.
        title: Its name in plain words.
        appearance: One sentence on what it looks like in data.
        port: Where it sits.
        also: Further ports it is visited at; `respond` tells them apart by `site.port`.
        states: How many numbers it remembers.
        resists: At the drum, whether it answers to the motion that all else leaves, as friction
            does: it is then visited after those that do not.
        divides: At the drum, whether it tells what acts on the drum from what acts on the motor;
            it is then visited last.
        by_tension: Whether it turns on the tension there is, not on changes of it: beside it an
            offset of the torque looks unlike one of the gauge.
        repeats: Name of the parameter that says how often it repeats in a turn of the drum, where
            it is a wave over the angle.
        smooth: Whether the trial has a derivative by the parameters that is worth following.

    Raises:
        InvalidInput: a parameter is outside its range.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    appearance: ClassVar[str]
    port: ClassVar[Port]
    also: ClassVar[tuple[Port, ...]] = ()
    states: ClassVar[int] = 0
    resists: ClassVar[bool] = False
    divides: ClassVar[bool] = False
    by_tension: ClassVar[bool] = False
    repeats: ClassVar[str] = ""
    smooth: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name, (low, high, unit, _, _) in self.parameters().items():
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

    @classmethod
    def neutral(cls) -> Self:
        """The effect with the parameters at which it does nothing."""
        declared = cls.parameters().items()
        return cls(**{name: p.neutral for name, p in declared if p.neutral is not None})

    @staticmethod
    def amend(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Any]:  # noqa: ARG004  most effects amend nothing
        """What the effect changes of the reel's own numbers; also called with floats.

        Args:
            p: The parameters by name.
            reel: The attributes of the `ReelProgress` by name, as amended by the effects before.

        Returns:
            The new values by attribute.
        """
        return {}

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:  # noqa: ARG004  most effects prepare nothing
        """What is worked out once per trial, and joins the parameters under the names given.

        Args:
            p: The parameters by name.
            reel: The attributes of the `ReelProgress` by name, and beside them `preload_N`,
                `stiffness_N_m` of the linear law, `gravity_m_s2`, `sample_s`, `substep_s`, and
                `torque_per_velocity` of a substep as in `Site`.
        """
        return {}

    @staticmethod
    def respond(
        p: SimpleNamespace,  # noqa: ARG004  an effect that only amends does nothing here
        state: Signal,
        signal: Signal,
        site: Site,
    ) -> tuple[Signal, Signal]:
        """The law, written with CasADi expressions.

        Args:
            p: The parameters by name, and what `prepare` added to them.
            state: What the effect remembers, a column of `states` numbers.
            signal: The signal at the port; at the drum, the torque other effects have added.
            site: The moment it acts in.

        Returns:
            The next state and the changed signal; at the drum, the torque this effect adds.
        """
        return state, (0.0 if site.port is Port.DRUM else signal)

    @staticmethod
    def rest(
        p: SimpleNamespace,  # noqa: ARG004  most effects let what is steady pass unchanged
        state: Signal,
        signal: Signal,
        site: Site,
    ) -> tuple[Signal, Signal]:
        """The effect in a reel that has settled, traced back from what the gauge then reads.

        An effect that changes a steady signal has to say here what goes in, or trials will begin
        with a transient.

        Args:
            p: The parameters by name, and what `prepare` added to them.
            state: Zeros, a column of `states` numbers; where a moving reel is only put to
                another reading, what the effect remembers.
            signal: What steadily comes out at the port; at the encoder, what goes in; at the drum,
                the torque other effects have added.
            site: The moment; the velocities are zero.

        Returns:
            What the effect remembers then, and what steadily goes in; at the drum, the torque this
            effect adds.
        """
        return state, (0.0 if site.port is Port.DRUM else signal)

    @staticmethod
    def put(
        p: SimpleNamespace,  # noqa: ARG004  most effects remember nothing of the angle
        state: Signal,
        angle_rad: Signal,  # noqa: ARG004
    ) -> Signal:
        """What the effect remembers once the drum is put at an angle, from what it did before.

        Args:
            p: The parameters by name, and what `prepare` added to them.
            state: What it remembered.
            angle_rad: The drum's angle from now on.
        """
        return state

    @classmethod
    def ports(cls) -> tuple[Port, ...]:
        """All the ports it is visited at."""
        return (cls.port, *cls.also)
