"""Which definitions of the product does a command, an entry point or a public name reach?

A definition is reached where the body of a reached one names it. An import reaches nothing by
itself: a package whose `__init__` lists its modules does not keep them. Reads the source as text.
`./dev python -m tests.reached` prints what nothing reaches, with its lines.
"""

import ast
import re
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import estune.cli
import plants.commands
from estune.support.garbage import collection_paused

ROOT = Path(__file__).parents[1]
PACKAGES = ("estune", "plants")
CONFORMANCE = ("estune.conformance", "plants.conformance")
PLACE = re.compile(r"[a-z_][\w.]*:[A-Za-z_]\w*")  # module:name, as of an entry point
SHOWN = re.compile(
    r"^(?:>>> )?(from (?:estune|plants)[\w.]* import (?:\([^)]*\)|[^(\n]+))$", re.MULTILINE
)
STABLE = ROOT / "docs" / "reference" / "stable.md"

Definition = tuple[str, str]
"""Module and name; the name is empty for what a module does when it is imported."""


@dataclass
class Module:
    """What a module defines and imports.

    Attributes:
        name: Its dotted name.
        path: Its file.
        bodies: Statements that define each name; those that define none stand under "".
        imports: Each imported name: the module, and the name in it, "" for the module itself.
        listed: Names in `__all__`.
    """

    name: str
    path: Path
    bodies: dict[str, list[ast.stmt]] = field(default_factory=dict)
    imports: dict[str, Definition] = field(default_factory=dict)
    listed: tuple[str, ...] = ()


def imported(node: ast.Import | ast.ImportFrom) -> dict[str, Definition]:
    """The names that an import binds."""
    if isinstance(node, ast.ImportFrom):
        return {each.asname or each.name: (node.module or "", each.name) for each in node.names}
    tops = {each.name.split(".")[0] for each in node.names if not each.asname}
    return {top: (top, "") for top in tops} | {
        each.asname: (each.name, "") for each in node.names if each.asname
    }


def defined(statement: ast.stmt) -> list[str]:
    """The names that a statement at the top of a module defines; none of Python's own."""
    match statement:
        case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
            found = [name]
        case ast.AnnAssign(target=ast.Name(id=name)):
            found = [name]
        case ast.Assign(targets=targets):
            inside = (node for target in targets for node in ast.walk(target))
            found = [node.id for node in inside if isinstance(node, ast.Name)]
        case _:
            found = []
    return [name for name in found if not name.startswith("__")]


def _read(path: Path) -> Module:
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    module = Module(name, path)
    for statement in ast.parse(path.read_text("utf-8")).body:
        typing = isinstance(statement, ast.If) and "TYPE_CHECKING" in ast.unparse(statement.test)
        for each in statement.body if typing else [statement]:
            if isinstance(each, ast.Import | ast.ImportFrom):
                module.imports |= imported(each)
            elif isinstance(each, ast.Assign) and ast.unparse(each.targets[0]) == "__all__":
                module.listed = tuple(ast.literal_eval(each.value))
            else:
                for name in defined(each) or [""]:
                    module.bodies.setdefault(name, []).append(each)
    return module


@cache
@collection_paused()
def modules() -> dict[str, Module]:
    """All modules of the product by name."""
    paths = (p for package in PACKAGES for p in sorted((ROOT / package).rglob("*.py")))
    return {module.name: module for module in map(_read, paths)}


def resolve(module: str, name: str) -> Definition | None:
    """Where a name of a module is defined, or the module for an empty name; None: not here."""
    known = modules().get(module)
    if known is None:
        return None
    if not name or name in known.bodies:
        return module, name
    if name in known.imports:
        return resolve(*known.imports[name])
    return (f"{module}.{name}", "") if f"{module}.{name}" in modules() else None


def public(module: str) -> Iterator[Definition]:
    """What a module offers: the names it lists, or all that it defines and imports."""
    known = modules()[module]
    for name in known.listed or ("", *known.bodies, *known.imports):
        if found := resolve(module, name):
            yield found


class Uses(ast.NodeVisitor):
    """The definitions that a statement of a module names."""

    def __init__(self, module: Module) -> None:
        self.module = module
        self.bound = dict(module.imports)
        self.found: set[Definition] = set()

    def visit_Import(self, node: ast.Import) -> None:
        self.bound |= imported(node)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        self.bound |= imported(node)

    def visit_Attribute(self, node: ast.Attribute) -> None:
        chain, inner = [node.attr], node.value
        while isinstance(inner, ast.Attribute):
            chain, inner = [inner.attr, *chain], inner.value
        if not (isinstance(inner, ast.Name) and inner.id in self.bound):
            self.generic_visit(node)
            return
        found = resolve(*self.bound[inner.id])
        while found and not found[1] and chain:
            found = resolve(found[0], chain.pop(0))
        if found:
            self.found.add(found)

    def visit_Call(self, node: ast.Call) -> None:
        if (
            isinstance(node.func, ast.Name)
            and node.func.id in ("vars", "globals")
            and not node.args
        ):
            self.found.update(public(self.module.name))
        self.generic_visit(node)

    def visit_Name(self, node: ast.Name) -> None:
        if node.id in self.bound:
            found = resolve(*self.bound[node.id])
            if found and not found[1]:  # a module as a value: all that it has may be used
                self.found.update(public(found[0]))
            elif found:
                self.found.add(found)
                through = modules()[self.bound[node.id][0]]
                if through.path.name != "__init__.py":  # a module that gives a name another place
                    self.found.add((through.name, ""))
        elif node.id in self.module.bodies:
            self.found.add((self.module.name, node.id))

    def visit_Constant(self, node: ast.Constant) -> None:
        if not isinstance(node.value, str):
            return
        if node.value in modules():  # the name of a program
            self.found |= {(node.value, ""), (f"{node.value}.__main__", "")}
        elif node.value.endswith(".toml") and (self.module.path.parent / node.value).is_file():
            text = (self.module.path.parent / node.value).read_text("utf-8")
            self._add_places(PLACE.findall(text))
        elif PLACE.fullmatch(node.value):
            self._add_places([node.value])
        elif re.fullmatch(r"[A-Za-z_][\w.\[\]|, ]*", node.value):  # an annotation in quotes
            for word in re.findall(r"\w+", node.value):
                if word in self.bound and (found := resolve(*self.bound[word])) and found[1]:
                    self.found.add(found)

    def _add_places(self, places: Iterable[str]) -> None:
        """Adds `module:name`; the module may be one of this module's package."""
        package = self.module.name.rpartition(".")[0]
        for where, name in (place.split(":") for place in places):
            inside = (n for n in modules() if n.startswith(package) and n.endswith(f".{where}"))
            self.found |= {(module, name) for module in (where, *inside)}


def uses(module: Module, statements: Iterable[ast.stmt]) -> set[Definition]:
    """The definitions that some statements of a module name."""
    visitor = Uses(module)
    for statement in statements:
        visitor.visit(statement)
    return visitor.found


def roots() -> Iterator[Definition]:
    """Commands, entry points, stable names, conformance suites, and what pages show."""
    places = [f"estune.cli.{where}" for _, where, *_ in estune.cli.COMMANDS]
    places += [where for _, where, *_ in plants.commands.COMMANDS]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    for group in (project["scripts"], *project["entry-points"].values()):
        places += group.values()
    for module, name in (place.split(":") for place in places):
        yield module, name
    row = next(line for line in STABLE.read_text("utf-8").splitlines() if "`__all__`" in line)
    for package in re.findall(r"`(estune[\w.]*|plants[\w.]*)`", row):
        yield from public(package)
    for module in modules():
        if module.startswith(CONFORMANCE):
            yield from public(module)
    yield from shown()


def shown() -> Iterator[Definition]:
    """The programs that pages start, and what their snippets import."""
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        text = page.read_text("utf-8")
        for program in re.findall(r"python -m ((?:estune|plants)[\w.]*)", text):
            yield f"{program}.__main__", ""
        for line in SHOWN.findall(text):
            statement = ast.parse(line).body[0]
            assert isinstance(statement, ast.ImportFrom)
            yield from imported(statement).values()


@cache
@collection_paused()
def reached() -> frozenset[Definition]:
    """All definitions that are reached."""
    found: set[Definition] = set()
    waiting = set(roots())
    while waiting:
        one = resolve(*waiting.pop())
        if one is None or one in found:
            continue
        found.add(one)
        module = modules()[one[0]]
        waiting.add((module.name, ""))
        waiting |= uses(module, module.bodies.get(one[1], ()))
    return frozenset(found)


def unreached() -> dict[str, int]:
    """The definitions that nothing reaches, with their lines."""
    return {
        f"{module.name}.{name}": sum((s.end_lineno or 0) - s.lineno + 1 for s in body)
        for module in modules().values()
        for name, body in module.bodies.items()
        if name and (module.name, name) not in reached()
    }


def main() -> None:
    """Prints them."""
    for name, lines in unreached().items():
        print(f"{lines:5} {name}")
    print(f"{sum(unreached().values()):5} lines")


if __name__ == "__main__":
    main()
