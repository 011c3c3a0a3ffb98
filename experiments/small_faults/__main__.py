"""Are small faults in the source noticed by the tests of what they change?

Command: `python -m experiments.small_faults`.
Target: at least 0.95 of the faults are caught, without those that change no behaviour.

In each area, faults are drawn by a seed: first a kind that its files have, then a place. Each is
put alone into a copy of the tree, never into the checkout, and the test files of its area are run
by day and, if they notice nothing, by night (`-m slow`). The test that failed is run again without
the fault, so that one which fails by itself, from load, is no catch. A run that takes ten times as
long as without the fault is stopped, and its fault counts as caught, unless the tests take that
long without it by then: a suite that hangs is noticed, a slow machine is not. What was looked into
and changes no behaviour is listed with its reason and left out.
"""

import importlib
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from experiments.results import Target, at_least, command_line, print_results
from experiments.small_faults.areas import AREAS, UNCHANGED, Area
from experiments.small_faults.faults import SourceFault, faults_of

ROOT = Path(__file__).resolve().parents[2]
LANES = {"day": "not slow", "slow": "slow"}
MEMORY_BYTES = 4 << 30
"""Memory of a run of tests: a fault in the lease made a search of its states take 7 GB."""
LIBRARIES = ("casadi", "control", "pydantic", "scipy.stats", "zenoh")
"""Loaded once, before a process is forked for each run of tests: that takes 3 s of CPU."""
FORK = multiprocessing.get_context("fork")
NO_TESTS = 5
"""Exit code of pytest where a lane has no test of these files."""
LONGEST_S = 3600.0
"""Of tests without a fault."""
STOPPED = "stopped"
FAILED = ".failed"
"""File in the copy of the tree: the test that failed in the last run."""


class NoTests(Exception):
    """A lane has no test of an area."""


class Drawn(NamedTuple):
    """A fault of a file."""

    file: str
    fault: SourceFault
    source: bytes

    @property
    def place(self) -> str:
        """File and line."""
        return f"{self.file}:{self.fault.line}"

    @property
    def reason(self) -> str:
        """Why it changes no behaviour; empty where it does, or nobody has looked into it."""
        line = self.source.decode().splitlines()[self.fault.line - 1].strip()
        return UNCHANGED.get((line, self.fault.kind), "")


class Tree:
    """A copy of the tree, in which faults are put and tests run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        unused = shutil.ignore_patterns(".*", "__pycache__", "out", "runs")
        shutil.copytree(ROOT, folder, ignore=unused, symlinks=True, dirs_exist_ok=True)

    def put(self, drawn: Drawn) -> None:
        """Puts a fault into its file.

        Python compiles a file anew whose time differs by a second, which a run of tests takes.
        """
        (self.folder / drawn.file).write_bytes(drawn.fault.put_into(drawn.source))

    def take_out(self, drawn: Drawn) -> None:
        """Puts the file's own text back."""
        (self.folder / drawn.file).write_bytes(drawn.source)

    def failed(self, tests: Sequence[str], lane: str, within_s: float) -> str:
        """The test that failed in a lane, or `STOPPED` where they do not end in time; else empty.

        Raises:
            NoTests: If the lane has none.
        """
        (self.folder / FAILED).write_text("")
        how = ["-x", "-q", "-p", "no:cacheprovider", "--numprocesses=0", "-m", LANES[lane]]
        process = FORK.Process(target=_run, args=(self.folder, [*how, *tests]))
        process.start()
        process.join(within_s)
        if process.exitcode is None:
            os.killpg(process.ident or 0, signal.SIGKILL)  # its servers and loops too
            process.join()
            return STOPPED
        if process.exitcode == NO_TESTS:
            raise NoTests
        failed = (self.folder / FAILED).read_text()
        return failed or (f"exit code {process.exitcode}" if process.exitcode else "")


class _Failed:
    """Plugin of pytest that writes down which test, or which file, failed."""

    def __init__(self) -> None:
        self._file = Path(FAILED).absolute()  # a test may work in another folder

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            self._file.write_text(report.nodeid)

    pytest_collectreport = pytest_runtest_logreport


def _run(folder: Path, arguments: list[str]) -> None:
    """Runs tests in a copy of the tree; ends this process with their exit code."""
    import pytest  # noqa: PLC0415  one of the libraries

    os.setsid()
    os.chdir(folder)
    sys.path.insert(0, str(folder))
    os.environ["PYTHONPATH"] = str(folder)
    for name in [name for name in sys.modules if name.partition(".")[0] == "experiments"]:
        del sys.modules[name]  # the copy has its own
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    sys.exit(pytest.main(arguments, plugins=[_Failed()]))


def drawn_in(root: Path, area: Area, number: int, random: Random) -> list[Drawn]:
    """Faults of an area: kinds in turn, so that no frequent kind crowds out the others."""
    by_kind: dict[str, list[Drawn]] = {}
    for file in area.files:
        source = (root / file).read_bytes()
        for fault in faults_of(source):
            by_kind.setdefault(fault.kind, []).append(Drawn(file, fault, source))
    kinds = sorted(by_kind)
    random.shuffle(kinds)
    found: list[Drawn] = []
    while len(found) < number and kinds:
        kind = kinds.pop(0)
        places = by_kind[kind]
        found.append(places.pop(random.randrange(len(places))))
        if places:
            kinds.append(kind)
    return found


class Lane:
    """Tests of an area in one lane."""

    def __init__(self, tree: Tree, area: Area, name: str) -> None:
        self.name = name
        self._tree = tree
        self._files = [f"tests/test_{test}.py" for test in area.tests]
        self._took_s = 0.0

    def noticed(self, drawn: Drawn) -> str:
        """The test that notices a fault, or `STOPPED`; empty if none does."""
        try:
            if not self._took_s:  # before the first fault that this lane has to notice
                self._run_without(drawn)
            while (found := self._run_with(drawn)) and self._fails_without(drawn, found):
                print("fails without the fault:", found, file=sys.stderr, flush=True)
        except NoTests:
            return ""
        return found

    def _run_with(self, drawn: Drawn) -> str:
        self._tree.put(drawn)
        return self._tree.failed(self._files, self.name, 60.0 + 10.0 * self._took_s)

    def _run_without(self, drawn: Drawn) -> None:
        """Runs all tests without a fault, and notes how long they take."""
        self._tree.take_out(drawn)
        begun = time.monotonic()
        if found := self._tree.failed(self._files, self.name, LONGEST_S):
            raise SystemExit(f"{found} without a fault, by {self.name}")
        self._took_s = time.monotonic() - begun

    def _fails_without(self, drawn: Drawn, found: str) -> bool:
        """Whether a test fails, or all take as long, by themselves on this machine now."""
        took_s = self._took_s
        if found == STOPPED:
            self._run_without(drawn)
            return self._took_s > 3.0 * took_s  # then it is tried again, with more time
        self._tree.take_out(drawn)
        return "::" in found and bool(self._tree.failed([found], self.name, LONGEST_S))


def tried(tree: Tree, area: Area, drawn: Sequence[Drawn]) -> Iterator[tuple[Drawn, str, str]]:
    """Each fault, the lane that caught it or `not caught`, and the test that did."""
    lanes = [Lane(tree, area, name) for name in LANES]
    for one in drawn:
        found = ((lane.name, test) for lane in lanes if (test := lane.noticed(one)))
        yield one, *next(found, ("not caught", ""))
        tree.take_out(one)


def main() -> int:
    """Puts the faults in and prints what noticed them."""
    parser = command_line(__doc__, quick="two faults in the lease")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--each", type=int, default=6, help="faults of each area")
    parser.add_argument("--area", choices=AREAS, action="append", help="only this area")
    parser.add_argument("--list", action="store_true", help="list the faults, and run nothing")
    options = parser.parse_args()
    names = ["lease"] if options.quick else options.area or list(AREAS)
    rows = []
    counts: dict[str, int] = dict.fromkeys((*LANES, "not caught", "unchanged"), 0)
    for library in LIBRARIES:
        importlib.import_module(library)
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
    with TemporaryDirectory(prefix="small-faults-") as folder:
        tree = Tree(Path(folder))
        for name in names:
            random = Random(f"{options.seed} {name}")  # noqa: S311  no secret
            number = 2 if options.quick else options.each
            drawn = drawn_in(tree.folder, AREAS[name], number, random)
            told = [(one, "unchanged", "") for one in drawn if one.reason]
            todo = [one for one in drawn if not one.reason]
            results = (
                ((one, "", "") for one in todo) if options.list else tried(tree, AREAS[name], todo)
            )
            for one, noticed, test in chain(told, results):
                print(noticed, one.place, one.fault, test, file=sys.stderr, flush=True)
                row = {"area": name, "place": one.place, "fault": str(one.fault)}
                rows.append(row | {"noticed": one.reason or noticed, "test": test})
                if noticed:
                    counts[noticed] += 1
    caught = sum(counts[lane] for lane in LANES)
    share = caught / max(caught + counts["not caught"], 1)
    targets: dict[str, Target] = {} if options.list else {"share_caught": at_least(share, 0.95)}
    figures = {**counts, "faults": rows}
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
