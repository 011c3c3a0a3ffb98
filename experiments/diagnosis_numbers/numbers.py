"""The numbers that decide in `plants.diagnosis`, found in its source, and what replaces them.

All stand in the table `constants.py`. A number outside it decides, and is listed, if it has a name
of its own at the top of a module, alone or among others, or is compared. Left out are the tables
of units, 0, 1, 2 and 0.5 in a comparison, guards of a division (1e-6 and less), and what is only
shown, planned or told: `report`, `experiments`, and the exit codes of `result.py`.
"""

import ast
import itertools
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import plants.diagnosis
from estune.support.garbage import collection_paused
from plants.diagnosis.constants import CONSTANTS

FOLDER = Path(plants.diagnosis.__file__).parent
SHOWN = ("report", "experiments", "result.py")
"""What decides no verdict."""
PLAIN = (0.0, 0.5, 1.0, 2.0)
GUARD = 1e-6
Value = float | tuple[float, ...]
"""Of a number of the table, or of several that are tried in turn."""
Functions = ast.FunctionDef | ast.AsyncFunctionDef


class Number(NamedTuple):
    """A number of the table.

    Attributes:
        name: Its name.
        value: The value.
        uses: Functions that use it, as (file, first line), outermost of nested ones.
    """

    name: str
    value: Value
    uses: frozenset[tuple[str, int]]


class _Source(NamedTuple):
    path: Path
    tree: ast.Module
    parents: dict[ast.AST, ast.AST]

    @classmethod
    def of(cls, path: Path) -> "_Source":
        tree = ast.parse(path.read_text(encoding="utf-8"))
        parents = {c: n for n in ast.walk(tree) for c in ast.iter_child_nodes(n)}
        return cls(path, tree, parents)

    def above(self, node: ast.AST) -> Iterator[ast.AST]:
        """The nodes that a node lies in, innermost first."""
        while node in self.parents:
            node = self.parents[node]
            yield node

    def function(self, node: ast.AST) -> tuple[str, int] | None:
        """The outermost function that a node lies in."""
        around = [n for n in self.above(node) if isinstance(n, Functions)]
        if not around:
            return None
        decorators = [d.lineno for d in around[-1].decorator_list]
        return str(self.path), min([around[-1].lineno, *decorators])


@cache
@collection_paused()
def _sources(folder: Path = FOLDER) -> list[_Source]:
    paths = sorted(folder.rglob("*.py"))
    return [_Source.of(p) for p in paths if p.relative_to(folder).parts[0] not in SHOWN]


def numbers() -> list[Number]:
    """All numbers of the table."""
    uses: dict[str, set[tuple[str, int]]] = {name: set() for name in CONSTANTS._fields}
    for source in _sources():
        for node in ast.walk(source.tree):
            if isinstance(node, ast.Attribute) and _of_table(node):
                uses[node.attr].update(filter(None, [source.function(node)]))
    return [Number(n, getattr(CONSTANTS, n), frozenset(uses[n])) for n in CONSTANTS._fields]


def outside(folder: Path = FOLDER) -> list[str]:
    """Numbers that decide and do not stand in the table: file, line, and the line itself."""
    found = []
    for source in _sources(folder):
        lines = source.path.read_text(encoding="utf-8").splitlines()
        for node in ast.walk(source.tree):
            if not isinstance(node, ast.Constant):
                continue
            if _is_compared(source, node) or _is_named(source, node):
                place = f"{source.path.relative_to(folder)}:{node.lineno}"
                found.append(f"{place}  {lines[node.lineno - 1].strip()}")
    return found


def _of_table(node: ast.Attribute) -> bool:
    return isinstance(node.value, ast.Name) and node.value.id == "CONSTANTS"


def _is_named(source: _Source, node: ast.Constant) -> bool:
    """Whether a node is a number in the value of a name at the top of a module.

    Not in a dictionary: tables of units are.
    """
    if type(node.value) not in (int, float):
        return False
    around = itertools.takewhile(lambda n: not isinstance(n, ast.Dict), source.above(node))
    assigned = next((n for n in around if isinstance(n, ast.stmt)), None)
    is_assigned = isinstance(assigned, ast.Assign | ast.AnnAssign)
    return is_assigned and assigned in source.tree.body


def _is_compared(source: _Source, node: ast.Constant) -> bool:
    """Whether a node is a number in a comparison, no index and no plain one."""
    if type(node.value) not in (int, float):
        return False
    if abs(node.value) in PLAIN or abs(node.value) <= GUARD:  # type: ignore[arg-type]
        return False
    around = list(source.above(node))
    for inner, outer in zip([node, *around], around, strict=False):
        if isinstance(outer, ast.Subscript) and outer.slice is inner:
            return False
        if isinstance(outer, ast.Compare) or _asks_a_ratio(outer):
            return True
        if isinstance(outer, ast.stmt | ast.FormattedValue):
            return False
    return False


def _asks_a_ratio(node: ast.AST) -> bool:
    """Whether a node is a call of `within_factor`, which compares."""
    is_named = isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    return is_named and node.func.id == "within_factor"  # type: ignore[attr-defined]


def scaled(number: Number, factor: float) -> Value:
    """A value of the table times a factor; of a count the nearest one from one up."""
    match number.value:
        case int(count):
            return max(round(factor * count), 1)
        case tuple(several):
            return tuple(factor * one for one in several)
        case float(value):
            return factor * value


@contextmanager
def replaced(values: Mapping[Number, Value]) -> Iterator[None]:
    """The diagnosis with other values of some numbers, as long as the context lasts."""
    before = CONSTANTS
    others: dict[str, Any] = {number.name: value for number, value in values.items()}
    changed = before._replace(**others)
    holders = [m for m in sys.modules.values() if getattr(m, "CONSTANTS", None) is before]
    for module in holders:
        module.CONSTANTS = changed  # type: ignore[attr-defined]
    try:
        yield
    finally:
        for module in holders:
            module.CONSTANTS = before  # type: ignore[attr-defined]
