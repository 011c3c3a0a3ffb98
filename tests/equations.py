"""Where is each numbered equation of the paper implemented, and which test checks it?

Reads the docstrings with `Implements (n).` and the tests marked `equation(n)` of a checkout, and
writes its docs/reference/equations.md. After a change of either, run:
./dev python -m tests.equations
"""

import argparse
import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from estune.support.garbage import collection_paused

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "docs" / "reference" / "equations.md"
FOLDERS = ("estune", "plants", "experiments/paper")
NUMBERS = range(1, 38)

_DECLARED = re.compile(r"Implements\s+((?:\(\d+\)(?:,\s+|\s+and\s+|\s+to\s+)?)+)")
_HEAD = """# The paper's equations in the code

Written by `./dev python -m tests.equations` from the docstrings and the tests.

| equation | where | checked by |
| --- | --- | --- |
"""


@cache
@collection_paused()
def implementations() -> dict[int, list[str]]:
    """Modules, classes or functions that implement each equation; there must be one for each."""
    places = defaultdict(list)
    for path in sorted(p for folder in FOLDERS for p in (ROOT / folder).rglob("*.py")):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        if "Implements" not in (text := path.read_text("utf-8")):
            continue  # to parse every file takes 4 s
        for name, docstring in _docstrings(ast.parse(text), module):
            for declared in _DECLARED.finditer(docstring):
                for number in _numbers(declared.group(1)):
                    places[number].append(name)
    return dict(places)


@cache
@collection_paused()
def checks() -> dict[int, list[str]]:
    """The tests marked with each equation."""
    tests = defaultdict(list)
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        if "equation(" not in (text := path.read_text("utf-8")):
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                for number in _marks(node):
                    tests[number].append(f"{path.stem}.{node.name}")
    return dict(tests)


def table() -> str:
    """The page, as Markdown."""
    where, checked = implementations(), checks()
    rows: dict[str, list[int]] = {}
    for number in NUMBERS:
        places, tests = where.get(number, []), checked.get(number, [])
        cells = " | ".join(", ".join(f"`{name}`" for name in names) for names in (places, tests))
        rows.setdefault(cells, []).append(number)
    numbered = (f"| {', '.join(f'({n})' for n in ns)} | {cells} |\n" for cells, ns in rows.items())
    return _HEAD + "".join(numbered)


def _docstrings(tree: ast.Module, module: str) -> Iterator[tuple[str, str]]:
    """Name and docstring of the module and of the classes and functions in it."""
    inside: list[tuple[str, ast.Module | ast.ClassDef | ast.FunctionDef]] = [(module, tree)]
    while inside:
        name, node = inside.pop(0)
        if docstring := ast.get_docstring(node):
            yield name, docstring
        named = (n for n in node.body if isinstance(n, ast.ClassDef | ast.FunctionDef))
        inside.extend((f"{name}.{child.name}", child) for child in named)


def _numbers(declared: str) -> Iterator[int]:
    """The numbers of "(3), (4) and (5)" or "(32) to (34)"."""
    numbers = [int(n) for n in re.findall(r"\d+", declared)]
    yield from range(numbers[0], numbers[-1] + 1) if " to " in declared else numbers


def _marks(node: ast.FunctionDef) -> Iterator[int]:
    for decorator in node.decorator_list:
        if isinstance(decorator, ast.Call) and ast.unparse(decorator.func).endswith("equation"):
            yield from (int(ast.literal_eval(argument)) for argument in decorator.args)


def main() -> None:
    """Writes the page and prints what is missing."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    TABLE.write_text(table(), "utf-8")
    where, checked = implementations(), checks()
    print(f"{len(where)} equations implemented, {len(checked)} checked: {TABLE}")
    for number in NUMBERS:
        places, tests = len(where.get(number, [])), len(checked.get(number, []))
        if places != 1 or not tests:
            print(f"({number}): {places} docstrings, {tests} tests")


if __name__ == "__main__":
    main()
