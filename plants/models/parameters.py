"""Parameters of a plant's equations: its own, the samples of dead time, those of its effects."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from types import SimpleNamespace
from typing import Any, NamedTuple

import casadi as ca

from plants.effects.effect import Effect
from plants.simulation.equations import Expression


def amend_parameters(
    own: SimpleNamespace, effects: Iterable[tuple[type[Effect], SimpleNamespace]]
) -> SimpleNamespace:
    """A plant's own parameters after the changes that its effects make to them."""
    changed = SimpleNamespace(**vars(own))
    for effect, p in effects:
        vars(changed).update(effect.amend(p, changed))
    return changed


class Parameters(NamedTuple):
    """Parameters by name."""

    nominal: SimpleNamespace  # the plant's own
    delay: Expression  # whole samples of dead time
    effects: list[tuple[type[Effect], SimpleNamespace]]  # the effects with their parameters

    def with_effects(self) -> SimpleNamespace:
        """The plant's own parameters, as amended by the effects."""
        return amend_parameters(self.nominal, self.effects)


class ParametricStructure(ABC):
    """Structure of a plant's equations: all that they depend on besides numbers."""

    effects: tuple[type[Effect], ...]  # the effects added, in order

    @property
    @abstractmethod
    def own_names(self) -> tuple[str, ...]:
        """Names of the plant's own parameters."""

    def substitutes(self) -> dict[str, float]:
        """Constants in place of parameters that effects ask for and this plant does not have."""
        return {}

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of all parameters in order; those of the nth effect as `n.name`."""
        added = (f"{n}.{name}" for n, e in enumerate(self.effects) for name in e.parameters())
        return (*self.own_names, "delay_samples", *added)

    def split_parameters(self, parameters: Expression) -> Parameters:
        """The column of parameters by their names."""
        symbols: Iterator[Any] = iter(ca.vertsplit(parameters))
        own = {name: next(symbols) for name in self.own_names}
        own |= {name: ca.SX(value) for name, value in self.substitutes().items()}
        delay = next(symbols)
        effects = [
            (effect, SimpleNamespace(**{name: next(symbols) for name in effect.parameters()}))
            for effect in self.effects
        ]
        return Parameters(SimpleNamespace(**own), delay, effects)

    def dead_time_samples(self, parameters: Expression) -> Expression:
        """Dead time in samples, with the share of the effects."""
        p = self.split_parameters(parameters).with_effects()
        return p.dead_time_s * p.sampling_Hz
