"""Public names of a package that are imported at their first use, and listed before it."""

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any


def lazy_exports(
    package: str, modules: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package, by the names that it has of each module."""
    places = {name: module for module, names in modules.items() for name in names}

    def get_attribute(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(places[name]), name)

    def list_names() -> list[str]:
        loaded = vars(sys.modules[package]).items()
        others = {name for name, value in loaded if isinstance(value, ModuleType)}
        return sorted({*places, *others, "__doc__", "__file__", "__name__", "__path__"})

    return get_attribute, list_names
