"""The parameters of a plant's equations: its own, the samples of dead time, those of effects."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, NamedTuple

import casadi as ca

from plants.effects.effect import Effect
from plants.models.effect_stages import amended
from plants.simulation.equations import Expression


class Parameters(NamedTuple):
    """Parameters by name.

    Attributes:
        nominal: The plant's own.
        delay: Whole samples of dead time.
        effects: The effects with theirs.
    """

    nominal: SimpleNamespace
    delay: Expression
    effects: list[tuple[type[Effect], SimpleNamespace]]

    def amended(self) -> SimpleNamespace:
        """The plant's own as the effects leave them."""
        return amended(self.nominal, self.effects)


class Parametrised(ABC):
    """Gives a structure with effects its parameters.

    Attributes:
        effects: The effects added, in order.
    """

    effects: tuple[type[Effect], ...]

    @property
    @abstractmethod
    def own_names(self) -> tuple[str, ...]:
        """The plant's own parameters."""

    def plain_numbers(self) -> dict[str, float]:
        """Numbers that effects may ask for, of a plant that has no such parameters."""
        return {}

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The parameters in order; those of the nth effect as `n.name`."""
        added = (f"{n}.{name}" for n, e in enumerate(self.effects) for name in e.parameters())
        return (*self.own_names, "delay_samples", *added)

    def named(self, parameters: Expression) -> Parameters:
        """The column of parameters by their names."""
        symbols: Iterator[Any] = iter(ca.vertsplit(parameters))
        own = {name: next(symbols) for name in self.own_names}
        own |= {name: ca.SX(value) for name, value in self.plain_numbers().items()}
        delay = next(symbols)
        effects = [
            (effect, SimpleNamespace(**{name: next(symbols) for name in effect.parameters()}))
            for effect in self.effects
        ]
        return Parameters(SimpleNamespace(**own), delay, effects)

    def late(self, parameters: Expression) -> Expression:
        """The dead time in samples, with what effects add."""
        p = self.named(parameters).amended()
        return p.dead_time_s * p.sampling_Hz
