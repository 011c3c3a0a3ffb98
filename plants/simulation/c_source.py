"""C source from CasADi functions and a hand-written loop around them."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import casadi as ca


def c_source(functions: Iterable[ca.Function], sizes: Mapping[str, int], loop: Path) -> str:
    """The C file: sizes as macros, generated functions, loop.

    Raises:
        OSError: the loop's file cannot be read.
    """
    generator = ca.CodeGenerator("estune_generated.c", {"with_header": False})
    for function in functions:
        generator.add(function)
    return "\n".join(
        [
            # A predicted branch is free; a conditional move waits for its arguments.
            "#if defined(__GNUC__) && !defined(__clang__)",
            '#pragma GCC optimize ("no-if-conversion", "no-if-conversion2")',
            "#endif",
            # Only the loop is exported, so that the compiler may inline the rest.
            "#define CASADI_SYMBOL_EXPORT static",
            *(f"#define {name} {value}" for name, value in sizes.items()),
            generator.dump(),
            loop.read_text(encoding="utf-8"),
        ]
    )
