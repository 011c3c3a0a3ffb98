"""Plants to which physical effects are added: what all of them share."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from types import SimpleNamespace
from typing import Self

import numpy as np

from estune.core.quantities import FloatArray
from plants.effects import Effect
from plants.models.effect_stages import amended
from plants.simulation.plant import whole_and_fraction


@dataclass(frozen=True, kw_only=True)
class EffectMixin(ABC):
    """Gives a plant its `+`, and its numbers what effects make of them.

    Attributes:
        effects: What has been added to the plant, in the order in which the signal meets it.
    """

    effects: tuple[Effect, ...] = ()

    @property
    @abstractmethod
    def own_numbers(self) -> dict[str, float]:
        """The plant's own numbers by name, as its equations take them."""

    def __add__(self, effect: Effect) -> Self:
        """The same plant with one more physical effect."""
        if not isinstance(effect, Effect):
            return NotImplemented
        return replace(self, effects=(*self.effects, effect))

    @property
    def kinds(self) -> tuple[type[Effect], ...]:
        """Which effects, without their numbers."""
        return tuple(type(effect) for effect in self.effects)

    @cached_property
    def amended(self) -> SimpleNamespace:
        """The plant's own numbers as the effects leave them."""
        # A plant without a motor takes its torque as the command, and has its friction elsewhere.
        plain = {"viscous_friction_Nms": 0.0, "torque_constant_Nm_A": 1.0}
        pairs = [(type(e), SimpleNamespace(**vars(e))) for e in self.effects]
        return amended(SimpleNamespace(**plain | self.own_numbers), pairs)

    @cached_property
    def dead_time(self) -> tuple[int, float]:
        """Whole samples and the fraction of one, with what effects add."""
        return whole_and_fraction(self.amended.dead_time_s, self.amended.sampling_Hz)

    @property
    def delay_samples(self) -> int:
        """Whole samples of the dead time, with what effects add."""
        return self.dead_time[0]

    def numbers(self, own: Iterable[float]) -> FloatArray:
        """What the equations take: these of the plant, its samples of dead time, the effects'."""
        added = [getattr(e, name) for e in self.effects for name in e.parameters()]
        return np.array([*own, self.delay_samples, *added])
