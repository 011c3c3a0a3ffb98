"""C code of this package, compiled and cached; without a compiler NumPy finds the same."""

import ctypes
from functools import cache

from estune.errors import PlantError
from estune.support import c_compiler


@cache
def compiled(source: str) -> ctypes.CDLL | None:
    """The library of `poles.c` and a source of this name; None without a compiler."""
    try:
        return c_compiler.load_beside(__file__, "poles.c", f"{source}.c")
    except PlantError:
        return None
