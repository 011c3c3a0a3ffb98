"""Conversion between the state of a Python plant and a flat list of its numbers or symbols."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from estune.errors import PlantError


@dataclass(frozen=True)
class StateShape:
    """Structure of a state: a number, an array, or nested lists and tuples of them."""

    kind: str  # `number`, `array`, `list` or `tuple`
    size: tuple[int, ...] = ()  # shape of an array
    parts: tuple["StateShape", ...] = ()  # of a list or a tuple

    @classmethod
    def of(cls, state: Any) -> "StateShape":
        """Shape of a state.

        Raises:
            PlantError: the state holds something else than numbers.
        """
        if isinstance(state, np.ndarray):
            return cls("array", state.shape)
        if isinstance(state, list | tuple):
            parts = tuple(cls.of(part) for part in state)
            return cls("list" if isinstance(state, list) else "tuple", (), parts)
        if isinstance(state, int | float | np.number):
            return cls("number")
        raise PlantError(
            f"the plant's state is a {type(state).__name__}; effects and records need a state "
            "that is a number, an array, or a list or tuple of them"
        )

    @property
    def numbers(self) -> int:
        """Count of numbers in the state."""
        own = int(np.prod(self.size)) if self.kind == "array" else int(self.kind == "number")
        return own + sum(part.numbers for part in self.parts)

    def flatten(self, state: Any) -> list[Any]:
        """Numbers, or symbols, of a state."""
        if self.kind == "number":
            return [state]
        if self.kind == "array":
            if isinstance(state, np.ndarray):
                return list(state.ravel())
            return list(ca.vertsplit(ca.vec(ca.SX(state).T)))
        return [x for part, own in zip(self.parts, state, strict=True) for x in part.flatten(own)]

    def build(self, numbers: Iterator[Any], *, as_columns: bool | None) -> Any:
        """A state of these numbers, or symbols.

        Args:
            numbers: The numbers, or symbols, in order.
            as_columns: Whether an array of symbols becomes a CasADi column or, if False, an array
                of objects; None for numbers.
        """
        if self.kind == "number":
            return next(numbers)
        if self.kind == "array":
            parts = [next(numbers) for _ in range(self.numbers)]
            if as_columns is None:
                return np.array(parts).reshape(self.size)
            if as_columns:
                column = ca.vertcat(*parts)
                # CasADi counts along columns, numpy along rows.
                return ca.reshape(column, *self.size[::-1]).T if len(self.size) > 1 else column
            array = np.empty(self.numbers, object)
            array[:] = [bare(part) for part in parts]
            return array.reshape(self.size)
        parts = [part.build(numbers, as_columns=as_columns) for part in self.parts]
        return parts if self.kind == "list" else tuple(parts)


def bare(value: Any) -> Any:
    """The object in an array without dimensions, or the value itself."""
    return value.item() if isinstance(value, np.ndarray) else value
