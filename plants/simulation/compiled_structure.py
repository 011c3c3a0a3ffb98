"""Compiled library of a structure, found without writing its equations where it is known.

Equations follow from the structure's fields and from the code of this package. So their library
has a name where all that the fields hold is a number, a text, or a class of this package; that of
a user's own effect or function has none, as its code may change between two processes. The code
counts by size and time of its files. A diagnosis in a new process takes some 30 structures, and to
write the equations of one costs more CPU than to compile them.
"""

import ctypes
import hashlib
import os
import re
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca

import estune.core
from estune.support import c_compiler
from plants.simulation.vector_code import vector_target

_PACKAGE = str(Path(__file__).parents[1])
_CODE = re.compile(r".*\.(py|c|h)").fullmatch


def compiled(
    structure: Any, purpose: str, source: Callable[[], str], optimise: str = "-O3"
) -> ctypes.CDLL:
    """The library of a structure for a purpose.

    Args:
        structure: Structure of a plant's equations.
        purpose: What distinguishes this source from others of the same structure.
        source: Writes the C source; it is called where no library is known.
        optimise: The compiler's option.

    Raises:
        PlantError: there is no compiler, it failed, or the library cannot be loaded.
    """
    name = structure_name(structure, purpose)
    if name is None:
        return c_compiler.load(source(), optimise)
    return c_compiler.load_named(name, source, optimise)


def structure_name(structure: Any, purpose: str) -> str | None:
    """Digest of a structure, the code and a purpose; None where other code has a part in it."""
    described = _described(structure)
    if described is None:
        return None
    parts = (purpose, described, _code(), vector_target())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def _described(value: Any) -> str | None:
    """A text that no other value has; None where code outside the package has a part in it."""
    if value is None or isinstance(value, bool | int | float | str):
        return repr(value)
    if isinstance(value, type):
        name = f"{value.__module__}.{value.__qualname__}"
        return name if _is_own(value) else None
    if is_dataclass(value):
        parts = (type(value), *(getattr(value, field.name) for field in fields(value)))
    elif isinstance(value, tuple):
        parts = (type(value).__name__, *value)
    else:
        return None
    texts = [_described(part) for part in parts]
    known = [text for text in texts if text is not None]
    return f"({', '.join(known)})" if len(known) == len(texts) else None


def _is_own(kind: type) -> bool:
    """Whether a class is the one that a module of this package has by its name."""
    module = sys.modules.get(kind.__module__)
    own = kind.__module__.partition(".")[0] == "plants"
    return own and getattr(module, kind.__qualname__, None) is kind


@cache
def _code() -> str:
    """Sizes and times of all files that equations may come from, and CasADi's version."""
    listed = [ca.CasadiMeta.version()]
    for folder in (_PACKAGE, *estune.core.__path__):
        for place, _, names in os.walk(folder):
            for name in filter(_CODE, names):
                state = os.stat(os.path.join(place, name))  # noqa: PTH116, PTH118  10 ms faster
                listed.append(f"{place} {name} {state.st_size} {state.st_mtime_ns}")
    return "\n".join(sorted(listed))
