"""Declaration of a physical effect, so that `reel + effect` is a new model.

An effect's file says all that the program knows of it. What the search, the report and the
experiments want to know they read from its class:

- its law: `port`, `also`, `states`, `respond`, `rest`, `amend`, `prepare`, `put`;
- its words: `name` (the slug), `title`, `appearance` (what it looks like in data), `excitation`
  (what experiment shows it), `describe` (a sentence with its fitted numbers);
- its remedies: `plain_remedies`, or with its numbers `remedies`; see `plants.effects.remedy`;
- its parameters, each with unit, bounds, role (size, limit, shape, frequency, periods, phase),
  where a fit begins, and the least size that matters: see `Parameter`;
- its relations: `family` and `extends` (simpler laws that do a part of it), `base_parameter` (a
  number of the base model that does the same), `in_noise` (found in the noise, not by a fit),
  `known_apart` (measurable without the machine).

All but `name`, `title`, `appearance`, `port` and the parameters have defaults.
"""

import math
from abc import ABC
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from enum import StrEnum
from types import SimpleNamespace
from typing import Any, ClassVar, NamedTuple, Self

from estune.errors import InvalidInput
from plants.effects.parameter import ABOVE_ZERO, Parameter, Range, RecordScale, Role, Share
from plants.effects.plant_scale import PlantScale, si
from plants.effects.remedy import Remedy

Signal = Any
"""A CasADi expression: no Python `if` may depend on it."""
Values = SimpleNamespace
"""Numbers or expressions by name."""
Response = tuple[Signal, Signal]
"""The next state of an effect, and the changed signal."""


class Port(StrEnum):
    """Place of an effect on the signal's path through the reel, and the signal that it changes.

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
    """State of the reel at a visit of an effect.

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


USUAL_RANGES: dict[tuple[Port, str], tuple[Share, Share | None]] = {
    (Port.DRUM, "N m"): (Share(0.1, "torque_rms_Nm"), Share(2.0, "torque_max_Nm")),
    (Port.DRUM, "rad/s"): (Share(0.3, "velocity_rms_rad_s"), Share(2.0, "velocity_max_rad_s")),
    (Port.EYELET, "rad/s"): (Share(0.01, "velocity_rms_rad_s"), Share(2.0, "velocity_max_rad_s")),
    (Port.DRUM, "rad"): (Share(0.05, "angle_rms_rad"), Share(2.0, "angle_rms_rad")),
    (Port.DRUM, "N m s/rad"): (Share(0.1, "damping_Nms"), Share(1e3, "damping_Nms")),
    (Port.ACTUATOR, "A"): (Share(0.8, "current_max_A"), None),
    (Port.ACTUATOR, "A/s"): (Share(0.8, "current_rate_A_s"), None),
}
"""Start and upper bound of a fit, of a parameter that declares neither: by port and unit,
relative to what the records show."""

FAR = 1e3
"""Bounds of a fit where neither nature nor the records give one, in times the usual value."""


@dataclass(frozen=True)
class Effect(ABC):
    """A physical effect: every field is a `parameter`, the law is `respond`.

    One parameter at least has a neutral value. `amend`, `prepare` and `rest` are there for the
    effects that need them.

    Class attributes:
        name: Its slug.
        title: Its name in plain words.
        appearance: One sentence on what it looks like in data.
        excitation: The experiment that shows it, a noun phrase.
        family: Name of its family. Members do the same in more or less detail; those with fewer
            parameters are simpler. Empty where it has none.
        extends: The simpler effect whose fit its own begins with, or None.
        inherits: Its parameters that begin with the fit of one of `extends`, to that one's name.
        base_parameter: The base model's own number that does the same; empty where none does.
        in_noise: Whether it is part of the noise model, not found by fitting predictions.
        known_apart: Whether its size is known without the machine, by a scale say: of two
            effects that explain as much, the other is likelier.
        plain_remedies: What can be done about it whatever its numbers, the first one first.
        port: Where it sits.
        also: Further ports it is visited at; `respond` distinguishes them by `site.port`.
        states: Number of its states.
        resists: At the drum, whether its torque depends on the motion under all other torques, as
            friction does: it is then visited after the others.
        divides: At the drum, whether it separates torques on the drum from those on the motor; it
            is then visited last.
        by_tension: Whether it depends on the level of the tension, not on changes of it: beside it
            an offset of the torque can be told from one of the gauge.
        in_torque: Whether it is found in the balance of torques, not by fitting predictions.
        without_cable: Whether it is looked for only on drives without a cable.
        of_process: Whether it is looked for only on plants known by input and output: what moves
            a reel or a drive is a motor's torque.
        smooth: Whether the trial has a derivative by the parameters that is worth following.
        form_error: Relative standard error of its values for the ways in which machines are
            unlike its law, where it is more than of other laws.

    Raises:
        InvalidInput: a parameter is outside its range.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    appearance: ClassVar[str]
    excitation: ClassVar[str] = ""
    family: ClassVar[str] = ""
    extends: ClassVar["type[Effect] | None"] = None
    inherits: ClassVar[Mapping[str, str]] = {}
    base_parameter: ClassVar[str] = ""
    in_noise: ClassVar[bool] = False
    known_apart: ClassVar[bool] = False
    plain_remedies: ClassVar[tuple[Remedy, ...]] = ()
    port: ClassVar[Port]
    also: ClassVar[tuple[Port, ...]] = ()
    states: ClassVar[int] = 0
    resists: ClassVar[bool] = False
    divides: ClassVar[bool] = False
    by_tension: ClassVar[bool] = False
    in_torque: ClassVar[bool] = False
    without_cable: ClassVar[bool] = False
    of_process: ClassVar[bool] = False
    smooth: ClassVar[bool] = True
    form_error: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        for name, p in self.parameters().items():
            value = getattr(self, name)
            if not (math.isfinite(value) and p.low <= value <= p.high):
                allowed = f"it must lie from {p.low:g} to {p.high:g} {p.unit}"
                raise InvalidInput(f"{self.name}: {name} is {value}; {allowed}")

    @classmethod
    def parameters(cls) -> dict[str, Parameter]:
        """The declared parameters by name, in the order of the fields."""
        declared = {f.name: f.metadata.get("parameter", MISSING) for f in fields(cls)}
        for name, found in declared.items():
            if found is MISSING:
                raise InvalidInput(f"{cls.__name__}.{name} has to be declared with parameter(...)")
        return declared

    @classmethod
    def named(cls, *roles: Role) -> tuple[str, ...]:
        """Names of the parameters of some roles, in the order of the fields."""
        return tuple(name for name, p in cls.parameters().items() if p.role in roles)

    @classmethod
    def neutral(cls) -> Self:
        """The effect with the parameters at which it does nothing."""
        declared = cls.parameters().items()
        return cls(**{name: p.neutral for name, p in declared if p.neutral is not None})

    @classmethod
    def range(cls, name: str, records: RecordScale) -> Range:
        """Start and bounds of a fit of a parameter to some records."""
        p, usual = cls.parameters()[name], float(getattr(cls(), name))
        begin, most = USUAL_RANGES.get((cls.port, "" if p.is_phase else p.unit), (None, None))
        least, most = p.between or (None, most)
        begin = p.start if isinstance(p.start, Share) else begin
        far = FAR * (abs(usual) or 1.0)
        low = max(p.low, usual / FAR if p.low == ABOVE_ZERO else -far)
        high = min(p.high, far)
        above, below = (math.nan if one is None else one.size(records) for one in (least, most))
        above = low if math.isnan(above) else max(p.low, above)
        below = high if math.isnan(below) else min(p.high, below)
        low, high = (above, below) if above < below else (low, high)
        value = math.nan if begin is None else begin.size(records)
        if begin is None and p.between is not None and low > 0.0:
            value = math.sqrt(low * high)  # the usual value is that of another machine
        if not value > 0.0:
            value = usual
        if isinstance(p.start, float | int):
            value = float(p.start)
        return Range(low, min(max(value, low), high), high)

    @classmethod
    def guesses(cls, name: str, records: RecordScale) -> tuple[float, ...]:
        """Values of a parameter that a search tries; none where those about `start` will do."""
        p = cls.parameters()[name]
        tried: Any = p.start
        if callable(tried):
            tried = tuple(tried(records))
        elif isinstance(tried, float | int):
            tried = (tried,)
        elif tried is None or isinstance(tried, Share):
            tried = {Role.FREQUENCY: records.resonances_Hz, Role.PERIODS: records.periods_per_turn}
            tried = tried.get(p.role, ())
        low, _, high = cls.range(name, records)
        return tuple(float(value) for value in tried if low <= value <= high)

    @classmethod
    def matters(
        cls, values: Mapping[str, float], records: RecordScale, *, distinct: bool = False
    ) -> bool:
        """Whether the effect is of a size that matters in practice.

        What is significant may still be of no account: a dead time of a small part of a sample is
        how two programs hold a signal, not a property of a drive.

        Args:
            values: Its parameters by name.
            records: What the records show; what they do not, nan, rules nothing out.
            distinct: Whether the records distinguish it from a simpler one, so that of its least
                sizes only those relative to another parameter count.
        """

        def size(one: Share) -> float:
            if not one.of:
                return one.factor
            return one.factor * values[one.of] if one.of in values else one.size(records)

        for name, p in cls.parameters().items():
            least = [one for one in p.least if one.of in values or not distinct]
            if any(abs(values[name]) < size(one) for one in least):
                return False
            if any(abs(values[name]) > size(one) for one in p.most):
                return False
        return True

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:  # noqa: ARG003  numbers alone
        """The effect and its size in words: the end of a sentence that begins "Your reel".

        Args:
            p: The fitted parameters by name, in the plant's own units.
            plant: Words and sizes of the plant.
        """
        numbers = (
            f"{name} {si(getattr(p, name), d.unit)}" for name, d in cls.parameters().items()
        )
        return f"has {cls.title}: {', '.join(numbers)}. In the data: {cls.appearance}"

    @classmethod
    def sentence(cls, values: Mapping[str, float], model: Any) -> str:
        """One or two sentences: what the effect is and how large, in the model's own units."""
        plant = PlantScale.of(model)
        return f"Your {plant.subject} {cls.describe(SimpleNamespace(**values), plant)}."

    @classmethod
    def remedies(
        cls,
        p: Values,  # noqa: ARG003  remedies without numbers
        plant: PlantScale,  # noqa: ARG003
    ) -> tuple[Remedy, ...]:
        """What can be done about it, the first one first; `plain_remedies` unless overridden.

        Args:
            p: The fitted parameters by name, in the plant's own units.
            plant: Words and sizes of the plant.
        """
        return cls.plain_remedies

    @staticmethod
    def amend(p: Values, reel: Values) -> dict[str, Any]:  # noqa: ARG004  most effects amend nothing
        """New values of the reel's own parameters; also called with floats.

        Args:
            p: The parameters by name.
            reel: The attributes of the `Reel` by name, as amended by the effects before.

        Returns:
            The new values by attribute.
        """
        return {}

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:  # noqa: ARG004  most effects prepare nothing
        """Values computed once per trial; they join the parameters by name.

        Args:
            p: The parameters by name.
            reel: The attributes of the `Reel` by name, and beside them `preload_N`,
                `stiffness_N_m` of the linear law, `gravity_m_s2`, `sample_s`, `substep_s`, and
                `torque_per_velocity` of a substep as in `Site`.
        """
        return {}

    @staticmethod
    def respond(
        p: Values,  # noqa: ARG004  an effect that only amends does nothing here
        state: Signal,
        signal: Signal,
        site: Site,
    ) -> Response:
        """The law, written with CasADi expressions.

        Args:
            p: The parameters by name, and what `prepare` added to them.
            state: The effect's states, a column.
            signal: The signal at the port; at the drum, the torque other effects have added.
            site: The moment it acts in.

        Returns:
            The next state and the changed signal; at the drum, the torque this effect adds.
        """
        return state, (0.0 if site.port is Port.DRUM else signal)

    @staticmethod
    def rest(
        p: Values,  # noqa: ARG004  most effects let what is steady pass unchanged
        state: Signal,
        signal: Signal,
        site: Site,
    ) -> Response:
        """The effect in a settled reel, traced back from the reading of the gauge.

        An effect that changes a steady signal has to invert itself here, or trials begin with a
        transient.

        Args:
            p: The parameters by name, and what `prepare` added to them.
            state: Zeros, a column; where a moving reel is set to another reading, its states.
            signal: Steady output at the port; at the encoder, the input; at the drum, the torque
                other effects have added.
            site: The moment; the velocities are zero.

        Returns:
            The states then, and the steady input signal; at the drum, the torque it adds.
        """
        return state, (0.0 if site.port is Port.DRUM else signal)

    @staticmethod
    def put(
        p: Values,  # noqa: ARG004  most effects remember nothing of the angle
        state: Signal,
        angle_rad: Signal,  # noqa: ARG004
    ) -> Signal:
        """The states after the drum is set to an angle.

        Args:
            p: The parameters by name, and what `prepare` added to them.
            state: The states before.
            angle_rad: The drum's angle from now on.
        """
        return state

    @classmethod
    def ports(cls) -> tuple[Port, ...]:
        """All the ports it is visited at."""
        return (cls.port, *cls.also)
