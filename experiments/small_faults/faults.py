"""Small faults that can be put into a source file, each at one place.

Messages, annotations and docstrings have none: they change no number and no decision.
"""

import ast
import math
import re
from collections.abc import Iterator
from typing import NamedTuple

COMPARED: dict[type[ast.cmpop], tuple[str, str]] = {
    ast.Lt: ("<", ">"),
    ast.LtE: ("<=", ">"),
    ast.Gt: (">", "<"),
    ast.GtE: (">=", "<"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.Is: ("is", "is not"),
    ast.IsNot: (r"is\s+not", "is"),
    ast.In: ("in", "not in"),
    ast.NotIn: (r"not\s+in", "in"),
}
COUNTED: dict[type[ast.operator], tuple[str, str]] = {
    ast.Add: (r"\+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: (r"\*", "/"),
    ast.Div: ("/", "*"),
}
EXTREMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum"}
WORDLESS = ast.JoinedStr | ast.Raise | ast.arg
SCALE = 2
"""Factor of a constant."""


class SourceFault(NamedTuple):
    """A small fault of one file.

    Attributes:
        line: Line, from 1.
        kind: What is done.
        start: First byte that is replaced.
        end: Byte after the last one.
        old: What stands there.
        new: What is put there.
    """

    line: int
    kind: str
    start: int
    end: int
    old: str
    new: str

    def put_into(self, source: bytes) -> bytes:
        """The file with the fault."""
        return source[: self.start] + self.new.encode() + source[self.end :]

    def __str__(self) -> str:
        old, new = (" ".join(text.split()) for text in (self.old, self.new))
        return f"{self.kind}: `{old}` becomes `{new}`"


def faults_of(source: bytes) -> list[SourceFault]:
    """All small faults of a file."""
    places = _Places(source)
    found = [f for node in _nodes(ast.parse(source)) for f in places.faults(node)]
    return sorted(set(found), key=lambda f: (f.start, f.kind, f.new))


def _nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes whose change may change a number or a decision."""
    for name, value in ast.iter_fields(node):
        if name in {"annotation", "returns", "decorator_list", "bases", "type_params"}:
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not isinstance(child, WORDLESS):
                yield child
                yield from _nodes(child)


class _Places:
    """Places of a source file, and what can be put there."""

    def __init__(self, source: bytes) -> None:
        self._source = source
        self._lines = [0]
        for line in source.splitlines(keepends=True):
            self._lines.append(self._lines[-1] + len(line))

    def faults(self, node: ast.AST) -> Iterator[SourceFault]:
        """Faults at one node."""
        yield from self._conditions(node)
        yield from self._numbers(node)
        yield from self._orders(node)

    def _conditions(self, node: ast.AST) -> Iterator[SourceFault]:
        match node:
            case ast.Compare(left=left, ops=[op, *_], comparators=[right, *_]):
                yield from self._between("comparison flipped", left, right, *COMPARED[type(op)])
            case ast.BoolOp(values=[first, *_, last]):
                for kept in (first, last):
                    yield self._whole("part of a condition dropped", node, self._text(kept))
            case ast.If(test=test, orelse=[], body=[*_, ast.Return() | ast.Raise()]):
                yield self._whole("guard dropped", test, "False")
                yield self._whole("not added", test, f"not ({self._text(test)})")
            case ast.If(test=test) | ast.IfExp(test=test):
                yield self._whole("condition replaced", test, "True")
                yield self._whole("condition replaced", test, "False")
                yield self._whole("not added", test, f"not ({self._text(test)})")
            case ast.comprehension(ifs=[test, *_]):
                yield self._whole("condition replaced", test, "True")

    def _numbers(self, node: ast.AST) -> Iterator[SourceFault]:
        match node:
            case ast.BinOp(op=op, left=left, right=right) if type(op) in COUNTED:
                if not (_is_text(left) or _is_text(right)):
                    yield from self._between(
                        "arithmetic exchanged", left, right, *COUNTED[type(op)]
                    )
            case ast.BinOp(op=ast.Pow(), left=left, right=ast.Constant()):
                yield self._whole("power dropped", node, f"({self._text(left)})")
            case ast.Constant(value=float(value)) if value not in (0.0, math.inf):
                yield self._whole("constant scaled", node, repr(SCALE * value))
            case ast.Call():
                yield from self._extreme(node)

    def _orders(self, node: ast.AST) -> Iterator[SourceFault]:
        match node:
            case ast.Subscript(slice=ast.Constant(value=0) as place):
                yield self._whole("first and last exchanged", place, "-1")
            case ast.Subscript(slice=ast.UnaryOp(ast.USub(), ast.Constant(value=1)) as place):
                yield self._whole("first and last exchanged", place, "0")
            case ast.Return(value=ast.Tuple(elts=[first, *middle, last]) as returned):
                new = ", ".join(map(self._text, (last, *middle, first)))
                yield self._whole("first and last exchanged", returned, f"({new})")
            case ast.Expr(value=ast.Call() as call) if not _is_logged(call):
                yield self._whole("call dropped", call, "None")

    def _extreme(self, call: ast.Call) -> Iterator[SourceFault]:
        name = _name(call.func)
        if name in EXTREMES:
            end = self._span(call.func)[1]
            yield self._at(
                "min and max exchanged", call.lineno, (end - len(name), end), EXTREMES[name]
            )
        is_clamp = len(call.args) >= 2 and not call.keywords and name in {*EXTREMES, "clip"}
        if is_clamp and not any(isinstance(a, ast.Starred) for a in call.args):
            free = [a for a in call.args if not _is_limit(a)] or call.args
            yield self._whole("clamp dropped", call, f"({self._text(free[0])})")

    def _between(
        self, kind: str, left: ast.expr, right: ast.expr, token: str, new: str
    ) -> Iterator[SourceFault]:
        """The operator between two operands, beside which may be parentheses and comments."""
        start, end = self._span(left)[1], self._span(right)[0]
        gap = re.sub(rb"#[^\n]*", lambda c: b" " * len(c[0]), self._source[start:end])
        if found := re.search(token.encode(), gap):
            line = left.end_lineno or left.lineno
            yield self._at(kind, line, (start + found.start(), start + found.end()), new)

    def _whole(self, kind: str, node: ast.expr, new: str) -> SourceFault:
        return self._at(kind, node.lineno, self._span(node), new)

    def _at(self, kind: str, line: int, span: tuple[int, int], new: str) -> SourceFault:
        return SourceFault(line, kind, *span, self._source[slice(*span)].decode(), new)

    def _text(self, node: ast.expr) -> str:
        return self._source[slice(*self._span(node))].decode()

    def _span(self, node: ast.expr) -> tuple[int, int]:
        line, column = node.end_lineno or node.lineno, node.end_col_offset or 0
        return self._lines[node.lineno - 1] + node.col_offset, self._lines[line - 1] + column


LOGGED = frozenset(("debug", "info", "warning", "error", "exception", "log"))


def _name(node: ast.expr) -> str:
    return str(getattr(node, "attr", getattr(node, "id", "")))


def _is_logged(call: ast.Call) -> bool:
    return isinstance(call.func, ast.Attribute) and call.func.attr in LOGGED


def _is_text(node: ast.expr) -> bool:
    """Whether an operand is text or a sequence, as far as it shows."""
    return isinstance(node, ast.JoinedStr | ast.List | ast.Tuple) or (
        isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


def _is_limit(argument: ast.expr) -> bool:
    """Whether an argument of a clamp is its limit: a number, or a constant by its name."""
    if isinstance(argument, ast.UnaryOp):
        argument = argument.operand
    return isinstance(argument, ast.Constant) or _name(argument) == _name(argument).upper() != ""
