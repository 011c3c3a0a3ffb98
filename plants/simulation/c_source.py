"""C source from CasADi functions and a hand-written loop around them."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import casadi as ca

from plants.simulation.vector_code import vector_code, vector_target


def c_source(
    functions: Iterable[ca.Function],
    sizes: Mapping[str, int],
    loop: Path,
    rows: tuple[str, ...] = (),
) -> str:
    """The C file: sizes as macros, generated functions, loop.

    Args:
        functions: The functions the loop calls.
        sizes: Macros by name.
        loop: The file with the loop.
        rows: Names of functions that the loop calls for several rows at once, see `vector_code`.

    Raises:
        OSError: the loop's file cannot be read.
    """
    generator = ca.CodeGenerator("estune_generated.c", {"with_header": False})
    for function in functions:
        generator.add(function)
    generated = generator.dump()
    return "\n".join(
        [
            # A predicted branch is free; a conditional move waits for its arguments.
            "#if defined(__GNUC__) && !defined(__clang__)",
            '#pragma GCC optimize ("no-if-conversion", "no-if-conversion2", "fp-contract=off")',
            *([vector_target()] if rows else []),
            "#endif",
            # Only the loop is exported, so that the compiler may inline the rest.
            "#define CASADI_SYMBOL_EXPORT static",
            *(f"#define {name} {value}" for name, value in sizes.items()),
            generated,
            *([vector_code(generated, rows)] if rows else []),
            loop.read_text(encoding="utf-8"),
        ]
    )
