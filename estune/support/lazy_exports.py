"""Public names of a package that are imported at their first use, and listed before it."""

import importlib
import sys
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any


def lazy_exports(
    package: str, modules: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package."""

    def get_attribute(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(modules[name]), name)

    def list_names() -> list[str]:
        loaded = vars(sys.modules[package]).items()
        others = {name for name, value in loaded if isinstance(value, ModuleType)}
        return sorted({*modules, *others, "__doc__", "__file__", "__name__", "__path__"})

    return get_attribute, list_names
