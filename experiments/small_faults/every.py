"""Every fault of an area, each tried by the tests alone that run its statement.

The tests of the day are collected once, and run once without a fault, while each statement of a
function notes that it was run. Then a process is forked for each fault: it gives the functions of
the file the code that they have with the fault, and runs the tests that ran its statement, the
quickest first, until one fails. That one is run again without the fault. A statement outside of
functions is run by no test, but when its file is loaded.

What no test noticed in this way is a candidate. It is confirmed as all drawn faults are judged, by
all tests of the day over a file with the fault: they may start processes, which load it anew.
"""

import ast
import gc
import importlib
import json
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from itertools import chain, pairwise
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple
from zlib import crc32

import pytest

from experiments.small_faults.areas import Area
from experiments.small_faults.faults import faults_of
from experiments.small_faults.tree import FORK, LANES, OPTIONS, Drawn, Lane, Tree, run, test_files

CANDIDATE, NOT_CAUGHT = "candidate", "not caught"
LEAST_S, TIMES = 30.0, 20.0
"""Time in which a test has to end: this, and this many times what it took without a fault."""
LAST, RAN = ".last", ".ran"
"""Files in the copy of the tree: the test that was begun last; what a test ran, and its time."""
Place = tuple[str, int]
"""File, and line of a statement."""


class Ran(NamedTuple):
    """What a test ran without a fault."""

    took_s: float
    places: frozenset[Place]


class Results:
    """What is known of each fault, in a file to which every result is added as it comes."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._known: dict[str, dict[str, Any]] = {}
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.exists():
            rows = map(json.loads, file.read_text().splitlines())
            self._known = {row["key"]: row for row in rows}

    def add(self, drawn: Drawn, noticed: str, test: str = "") -> None:
        """Adds the result of a fault."""
        row = {"key": _key(drawn), "place": drawn.place, "fault": str(drawn.fault)}
        row |= {"noticed": noticed, "test": test}
        self._known[row["key"]] = row
        with self._file.open("a") as file:
            file.write(json.dumps(row) + "\n")

    def of(self, drawn: Drawn) -> tuple[str, str]:
        """How a fault of a file as it is now was noticed, and by which test; empty if unknown."""
        row = self._known.get(_key(drawn), {})
        return row.get("noticed", ""), row.get("test", "")


def _key(drawn: Drawn) -> str:
    return f"{drawn.place} {drawn.fault.start} {crc32(drawn.source)} {drawn.fault}"


def every_fault(root: Path, area: Area, only: str) -> list[Drawn]:
    """All faults of the files of an area in whose names a text is."""
    files = {file: (root / file).read_bytes() for file in area.files if only in file}
    return [
        Drawn(file, fault, source) for file, source in files.items() for fault in faults_of(source)
    ]


def candidates(
    tree: Tree, area: Area, todo: Sequence[Drawn], file: Path, *, longest_s: float
) -> None:
    """Tries faults by the tests that run their statements, and adds the results to a file."""
    arguments = [*OPTIONS, "-m", LANES["day"], f"--basetemp={tree.folder / '.tests'}"]
    plugin = _Forked(tree, area, todo, Results(file), longest_s)
    process = FORK.Process(target=run, args=(tree.folder, [*arguments, *test_files(area)], plugin))
    process.start()
    process.join()
    if process.exitcode:
        raise SystemExit(f"exit code {process.exitcode} of the tests without a fault, by day")


def confirmed(tree: Tree, area: Area, drawn: Sequence[Drawn], results: Results) -> None:
    """Judges candidates by all tests of the day, and adds what they say to the results."""
    lane = Lane(tree, area, "day")
    for one in drawn:
        test = lane.noticed(one)
        results.add(one, "day" if test else NOT_CAUGHT, test)
        tree.take_out(one)


class _Forked:
    """Plugin of pytest that runs the collected tests once for each fault, in forked processes."""

    def __init__(
        self, tree: Tree, area: Area, todo: Sequence[Drawn], results: Results, longest_s: float
    ) -> None:
        self._folder = tree.folder
        self._todo = todo
        self._results = results
        self._longest_s = longest_s
        self._sources = {file: (tree.folder / file).read_bytes() for file in area.files}
        self._modules: dict[str, ModuleType] = {}
        self._functions: dict[str, list[FunctionType]] = {}
        self._ran: dict[Any, Ran] = {}
        self._noted: set[Place] = set()
        self._set_up: dict[Any, set[Place]] = {}
        self._failed = False

    def pytest_collection_finish(self) -> None:
        """Finds the functions, before the collector of garbage leaves them out."""
        for file in self._sources:
            name = file.removesuffix(".py").replace("/", ".")
            self._modules[file] = importlib.import_module(name)
        functions = [one for one in gc.get_objects() if isinstance(one, FunctionType)]
        for file, module in self._modules.items():
            path = module.__file__
            self._functions[file] = [f for f in functions if f.__code__.co_filename == path]

    def pytest_runtest_logreport(self, report: Any) -> None:
        self._failed = self._failed or report.failed

    def pytest_runtestloop(self, session: Any) -> bool:
        """Runs the tests without a fault, then with each."""
        self._failed_in_fork(partial(self._note, session.items))
        ran = json.loads((self._folder / RAN).read_text())
        for test in session.items:
            if test.nodeid in ran:
                took_s, places = ran[test.nodeid]
                self._ran[test] = Ran(took_s, frozenset(map(tuple, places)))
        quick = (test for test, ran in self._ran.items() if ran.took_s <= self._longest_s)
        by_time = sorted(quick, key=lambda test: self._ran[test].took_s)
        statements = {file: _statements(source) for file, source in self._sources.items()}
        for one in self._todo:
            place = (one.file, statements[one.file].get(one.fault.line, 0))
            tests = [test for test in by_time if place in self._ran[test].places]
            self._results.add(one, *self._noticed(one, tests))
        return True

    def _noticed(self, drawn: Drawn, tests: Sequence[Any]) -> tuple[str, str]:
        """How a fault was noticed, and by which test."""
        (self._folder / LAST).write_text("")
        if tests and self._failed_in_fork(partial(self._with, drawn, tests)):
            begun = (self._folder / LAST).read_text()
            last = [test for test in tests if test.nodeid == begun]
            if last and not self._failed_in_fork(partial(self._within_time, last)):
                return "day", begun
        return CANDIDATE, ""

    def _failed_in_fork(self, work: Callable[[], None]) -> bool:
        """Whether a test failed in a process that was forked for some work, or it was killed."""
        process = FORK.Process(target=self._in_fork, args=(work,))
        process.start()
        process.join()
        with suppress(ProcessLookupError):
            os.killpg(process.ident or 0, signal.SIGKILL)  # its servers and loops
        return process.exitcode != 0

    def _in_fork(self, work: Callable[[], None]) -> None:
        os.setsid()
        work()
        os._exit(self._failed)  # no wait for threads

    def _note(self, tests: Sequence[Any]) -> None:
        """Runs tests, and writes down the time of each and what it and its fixtures ran."""
        for file, module in self._modules.items():
            vars(module)["__noted__"] = self._noted.add
            self._swap(file, _with_notes(file, self._sources[file]))
        ran: dict[str, tuple[float, list[Place]]] = {}
        for test, following in pairwise([*tests, None]):
            self._noted.clear()
            begun = time.monotonic()
            if self._failed_in(test, following):
                self._failed = False  # it fails by itself, and can notice nothing
                continue
            fixtures = chain.from_iterable(test._fixtureinfo.name2fixturedefs.values())  # noqa: SLF001
            places = self._noted.union(*(self._set_up.get(one, ()) for one in fixtures))
            ran[test.nodeid] = time.monotonic() - begun, list(places)
        (self._folder / RAN).write_text(json.dumps(ran))

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        before = self._noted.copy()
        self._noted.clear()
        try:
            return (yield)
        finally:
            self._set_up.setdefault(fixturedef, set()).update(self._noted)
            self._noted |= before

    def _with(self, drawn: Drawn, tests: Sequence[Any]) -> None:
        """Runs tests with a fault."""
        with suppress(ValueError):  # a function that needs other variables around it
            self._swap(drawn.file, ast.parse(drawn.fault.put_into(drawn.source)))
            self._within_time(tests)

    def _within_time(self, tests: Sequence[Any]) -> None:
        """Runs tests until one fails; one that takes too long kills this process."""
        for test, following in pairwise([*tests, None]):
            signal.setitimer(signal.ITIMER_REAL, LEAST_S + TIMES * self._ran[test].took_s)
            if self._failed_in(test, following):
                return

    def _failed_in(self, test: Any, following: Any) -> bool:
        (self._folder / LAST).write_text(test.nodeid)
        test.config.hook.pytest_runtest_protocol(item=test, nextitem=following)
        return self._failed

    def _swap(self, file: str, tree: ast.Module) -> None:
        """Gives the functions of a file the code of a tree."""
        codes = {
            _name(code): code for code in _codes(compile(tree, str(self._folder / file), "exec"))
        }
        for function in self._functions[file]:
            code = codes.get(_name(function.__code__))
            if code and code.co_name != "<lambda>":  # of which a line may have several
                function.__code__ = code


def _codes(code: CodeType) -> Iterator[CodeType]:
    """The code of all functions in some code."""
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield constant
            yield from _codes(constant)


def _name(code: CodeType) -> tuple[str, int]:
    return code.co_qualname, code.co_firstlineno


def _in_functions(tree: ast.Module) -> Iterator[ast.AST]:
    """All that is in functions, the outer before the inner."""
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            yield from chain.from_iterable(map(ast.walk, function.body))


def _statements(source: bytes) -> dict[int, int]:
    """The line at which the innermost statement begins, of each line in functions."""
    found = [one for one in _in_functions(ast.parse(source)) if isinstance(one, ast.stmt)]
    found.sort(key=lambda one: (one.end_lineno or one.lineno) - one.lineno, reverse=True)
    return {
        line: one.lineno for one in found for line in range(one.lineno, (one.end_lineno or 0) + 1)
    }


def _with_notes(file: str, source: bytes) -> ast.Module:
    """The tree of a file in which each statement of a function is noted before it is run."""
    tree = ast.parse(source)
    functions = (ast.FunctionDef, ast.AsyncFunctionDef)
    outer = [one for one in ast.walk(tree) if isinstance(one, functions)]
    blocks: dict[int, list[ast.stmt]] = {id(one.body): one.body for one in outer}
    for node in _in_functions(tree):
        for name in ("body", "orelse", "finalbody"):
            block = getattr(node, name, None)
            if isinstance(block, list):
                blocks[id(block)] = block
    for block in blocks.values():
        notes = (ast.parse(f"__noted__(({file!r}, {one.lineno}))").body[0] for one in block)
        block[:] = chain.from_iterable(zip(notes, list(block), strict=True))
    return tree
