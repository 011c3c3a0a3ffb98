"""The numbers that decide in `plants.diagnosis`, found in its source, and what replaces them.

A number decides if it stands in the table `constants.py`, under a name of its own at the top of a
module, or in a comparison. Left out are 0, 1, 2 and 0.5, guards of a division (1e-6 and less), and
what is only shown or planned: `report` and `experiments`.
"""

import ast
import gc
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FunctionType
from typing import NamedTuple

import plants.diagnosis
from plants.diagnosis.constants import CONSTANTS

FOLDER = Path(plants.diagnosis.__file__).parent
SHOWN = ("report", "experiments")
"""Folders that decide no verdict."""
PLAIN = (0.0, 0.5, 1.0, 2.0)
GUARD = 1e-6
Functions = ast.FunctionDef | ast.AsyncFunctionDef


class Number(NamedTuple):
    """A number that decides.

    Attributes:
        name: Name in the table, `file:name`, or `file:line:column`.
        value: The value.
        text: The line of source, or empty.
        uses: Functions that use it, as (file, first line), outermost of nested ones.
    """

    name: str
    value: float
    text: str
    uses: frozenset[tuple[str, int]]

    @property
    def in_table(self) -> bool:
        """Whether it stands in the table."""
        return ":" not in self.name

    @property
    def kind(self) -> str:
        """Where it stands, in words."""
        if self.in_table:
            return "in the table"
        return "in checks of single records" if self.name.startswith("checks/") else "elsewhere"


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


def _sources() -> list[_Source]:
    paths = sorted(FOLDER.rglob("*.py"))
    return [_Source.of(p) for p in paths if p.relative_to(FOLDER).parts[0] not in SHOWN]


def numbers() -> list[Number]:
    """All numbers that decide, those of the table first."""
    sources = _sources()
    uses: dict[str, set[tuple[str, int]]] = {name: set() for name in CONSTANTS._fields}
    named = {name: (s.path, value) for s in sources for name, value in _named(s.tree)}
    uses |= {name: set() for name in named}
    compared = []
    for source in sources:
        for node in ast.walk(source.tree):
            function = source.function(node)
            if function is None:
                continue
            if isinstance(node, ast.Attribute) and node.attr in uses and _of_table(node):
                uses[node.attr].add(function)
            elif isinstance(node, ast.Name) and node.id in named:
                uses[node.id].add(function)
            elif _is_compared(source, node):
                assert isinstance(node, ast.Constant)  # noqa: S101  for the types
                line = source.path.read_text(encoding="utf-8").splitlines()[node.lineno - 1]
                place = f"{source.path.relative_to(FOLDER)}:{node.lineno}:{node.col_offset}"
                number = Number(place, node.value, line.strip(), frozenset([function]))  # type: ignore[arg-type]
                compared.append(number)
    table = [Number(n, getattr(CONSTANTS, n), "", frozenset(uses[n])) for n in CONSTANTS._fields]
    own = [
        Number(f"{path.relative_to(FOLDER)}:{name}", value, "", frozenset(uses[name]))
        for name, (path, value) in named.items()
    ]
    return [*table, *own, *compared]


def _named(tree: ast.Module) -> Iterator[tuple[str, float]]:
    """Numbers with a name at the top of a module."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant):
            (target,), value = node.targets, node.value.value
            if isinstance(target, ast.Name) and type(value) in (int, float):
                yield target.id, value  # type: ignore[misc]


def _of_table(node: ast.Attribute) -> bool:
    return isinstance(node.value, ast.Name) and node.value.id == "CONSTANTS"


def _is_compared(source: _Source, node: ast.AST) -> bool:
    """Whether a node is a number in a comparison, no index and no plain one."""
    if not isinstance(node, ast.Constant) or type(node.value) not in (int, float):
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


Undo = list[tuple[object, str, object]]


@contextmanager
def replaced(values: Mapping[Number, float]) -> Iterator[None]:
    """The diagnosis with other values of some numbers, as long as the context lasts."""
    table = {n.name: value for n, value in values.items() if n.in_table}
    undo = _in_table(table) if table else []
    for number, value in values.items():
        if number.name.count(":") == 1:
            undo += _in_modules(number, value)
    in_code = {n: value for n, value in values.items() if n.name.count(":") == 2}
    undo += _in_code(in_code)
    try:
        yield
    finally:
        for holder, name, before in undo:
            setattr(holder, name, before)


def _in_table(values: Mapping[str, float]) -> Undo:
    before = CONSTANTS
    changed = before._replace(**values)
    holders = [m for m in sys.modules.values() if getattr(m, "CONSTANTS", None) is before]
    for module in holders:
        module.CONSTANTS = changed  # type: ignore[attr-defined]
    return [(module, "CONSTANTS", before) for module in holders]


def _in_modules(number: Number, value: float) -> Undo:
    """Modules that define or import it."""
    name = number.name.rpartition(":")[2]
    ours = (m for n, m in sys.modules.items() if n.startswith(plants.diagnosis.__name__))
    holders = [m for m in ours if hasattr(m, name)]
    undo: Undo = [(m, name, getattr(m, name)) for m in holders]
    for module in holders:
        setattr(module, name, type(number.value)(value) or 1)
    return undo


def _in_code(values: Mapping[Number, float]) -> Undo:
    """Functions take the code that their module would have with the other values."""
    codes: dict[tuple[str, int], CodeType] = {}
    for path in {path for number in values for path, _ in number.uses}:
        tree = ast.parse(Path(path).read_text(encoding="utf-8"))
        of_path = {n: value for n, value in values.items() if path in dict(n.uses)}
        others = {tuple(n.name.split(":")[1:]): (n, value) for n, value in of_path.items()}
        for node in ast.walk(tree):
            at = str(getattr(node, "lineno", 0)), str(getattr(node, "col_offset", -1))
            if isinstance(node, ast.Constant) and at in others:
                number, value = others[at]
                node.value = type(number.value)(value) or 1
        made = {c.co_firstlineno: c for c in _codes(compile(tree, path, "exec"))}
        codes |= {use: made[use[1]] for number in of_path for use in number.uses}
    undo: Undo = []
    for function in [f for f in gc.get_objects() if isinstance(f, FunctionType)]:
        before = function.__code__
        code = codes.get((before.co_filename, before.co_firstlineno))
        if code is not None and code.co_name == before.co_name:
            undo.append((function, "__code__", before))
            function.__code__ = code
    return undo


def _codes(code: CodeType) -> Iterator[CodeType]:
    """Code of all functions and methods of a module, none that is nested in another."""
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            is_class = not constant.co_flags & 0x2  # CO_NEWLOCALS: functions alone have it
            yield from _codes(constant) if is_class else (constant,)
