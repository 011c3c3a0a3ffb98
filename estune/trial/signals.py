"""Names and units of a rig's measured and commanded signals."""

from dataclasses import MISSING, dataclass

from estune.core.gains import Gains, gain_units
from estune.core.setting import declared
from estune.support.quantity_text import with_unit
from estune.trial.profiles import StepProfile

TENSION, EFFORT = "tension, N", "control effort, N"
"""Signals of a reel: tension and the force commanded by its controller."""


class NamedSignals:
    """Names and units of a measurement and a command, and texts that use them.

    Attributes:
        measurement: What is measured, with its unit after the last comma: "speed, rad/s".
        command: What the controller commands, likewise: "voltage, V".
    """

    __slots__ = ()

    measurement: str
    command: str

    @property
    def measurement_name(self) -> str:
        """Name of the measured signal, without its unit."""
        return _split(self.measurement)[0]

    @property
    def measurement_unit(self) -> str:
        """Unit of what is measured; empty without one."""
        return _split(self.measurement)[1]

    @property
    def command_name(self) -> str:
        """Name of the commanded signal, without its unit."""
        return _split(self.command)[0]

    @property
    def command_unit(self) -> str:
        """Unit of what the controller commands; empty without one."""
        return _split(self.command)[1]

    @property
    def stated(self) -> dict[str, str]:
        """The names as metadata of a record; empty for a reel, whose columns have its units."""
        if (self.measurement, self.command) == (TENSION, EFFORT):
            return {}
        return {"measurement": self.measurement, "command": self.command}

    @property
    def have_one_unit(self) -> bool:
        """Whether measurement and command have the same unit, so that they can be compared."""
        return _split(self.measurement)[1] == _split(self.command)[1]

    @property
    def gain_units(self) -> dict[str, str]:
        """By name of the gain, for a controller from this measurement to this effort."""
        return gain_units(self.measurement_unit, self.command_unit)

    def gains_text(self, gains: Gains) -> str:
        """Gains with their units."""
        return gains.text(self.gain_units)

    def measured(self, value: float, digits: int = 4) -> str:
        """A value of the measurement with its unit."""
        return with_unit(value, self.measurement_unit, digits)

    def commanded(self, value: float, digits: int = 4) -> str:
        """A value of the command with its unit."""
        return with_unit(value, self.command_unit, digits)

    def step_text(self, step: StepProfile) -> str:
        """The setpoints before and after a step, and what it has besides: "15 to 25 N"."""
        text = f"{step.preload_N:g} to {self.measured(step.preload_N + step.step_N, 6)}"
        more = [
            f"{member.name} {getattr(step, member.name)}"
            for member in declared(type(step))
            if member.default is not MISSING and getattr(step, member.name) != member.default
        ]
        return f"{text} ({', '.join(more)})" if more else text


@dataclass(frozen=True, slots=True)
class Signals(NamedSignals):
    """The names and units by themselves; those of a reel by default."""

    measurement: str = TENSION
    command: str = EFFORT


REEL = Signals()
"""Those of a reel."""


def _split(label: str) -> tuple[str, str]:
    name, _, unit = label.rpartition(", ")
    return (name, unit) if name else (label, "")
