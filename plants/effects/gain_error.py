"""A wrong gain of the drive."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

from plants.effects.effect import Effect, Port, Signal, Site, parameter


@dataclass(frozen=True)
class GainError(Effect):
    """A drive that gives more or less current, or torque, than is asked: `i = (1 + e) u`.

    Attributes:
        error: The relative error e.
    """

    name: ClassVar[str] = "gain_error"
    title: ClassVar[str] = "gain error of the drive"
    appearance: ClassVar[str] = (
        "commanded current and tension stand in another ratio than the model's, "
        "at rest as well as in motion"
    )
    port: ClassVar[Port] = Port.ACTUATOR

    error: float = parameter(0.05, low=-0.5, high=1.0, unit="", neutral=0.0)

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the gain is the same at all times
    ) -> tuple[Signal, Signal]:
        """The current given."""
        return state, (1.0 + p.error) * signal

    @staticmethod
    def rest(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the gain is the same at all times
    ) -> tuple[Signal, Signal]:
        """The current that has to be asked for."""
        return state, signal / (1.0 + p.error)
