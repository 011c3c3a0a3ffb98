"""CasADi functions on memory of their own, called many times faster than with arguments."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np


class Buffers:
    """Named memory that bound functions read and write."""

    def __init__(self, sizes: Mapping[str, int]) -> None:
        self.memory: dict[str, Any] = {name: np.zeros(n).data for name, n in sizes.items()}
        self._bound: list[Any] = []

    def bind(self, function: Any, inputs: str, outputs: str) -> Callable[[], None]:
        """A call of a CasADi function on the memory of these names, without arguments."""
        buffer, call = function.buffer()
        for n, name in enumerate(inputs.split()):
            buffer.set_arg(n, self.memory[name])
        for n, name in enumerate(outputs.split()):
            buffer.set_res(n, self.memory[name])
        self._bound.append(buffer)
        return call  # type: ignore[no-any-return]  # the library carries no types
