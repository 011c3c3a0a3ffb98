"""C code of this package, compiled and cached; without a compiler NumPy finds the same."""

import ctypes
from collections.abc import Sequence
from functools import cache
from itertools import accumulate
from typing import Any

from numpy.typing import NDArray

from estune.errors import PlantError
from estune.support import c_compiler


@cache
def compiled(source: str) -> ctypes.CDLL | None:
    """The library of `poles.c` and a source of this name; None without a compiler."""
    try:
        return c_compiler.load_beside(__file__, "poles.c", f"{source}.c")
    except PlantError:
        return None


def places(block: NDArray[Any], sizes: Sequence[int]) -> list[int]:
    """Addresses of consecutive arrays of such sizes in one: to ask for each takes as long."""
    first: int = block.ctypes.data
    return [first + block.itemsize * before for before in accumulate((0, *sizes[:-1]))]
