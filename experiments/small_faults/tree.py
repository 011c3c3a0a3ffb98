"""A copy of the tree, and the lanes of tests that are run in it with a fault and without."""

import importlib
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.small_faults.areas import UNCHANGED, Area
from experiments.small_faults.faults import SourceFault

ROOT = Path(__file__).resolve().parents[2]
LANES = {"day": "not slow", "slow": "slow"}
MEMORY_BYTES = 4 << 30
"""Memory of a run of tests: a fault in the lease made a search of its states take 7 GB."""
LIBRARIES = ("casadi", "control", "pydantic", "scipy.stats", "zenoh")
"""Loaded once, before a process is forked for each run of tests: that takes 3 s of CPU."""
FORK = multiprocessing.get_context("fork")
OPTIONS = ("-q", "-p", "no:cacheprovider", "--numprocesses=0")
"""Options of every run of tests, which is one process."""
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
        arguments = ["-x", *OPTIONS, "-m", LANES[lane], *tests]
        process = FORK.Process(target=run, args=(self.folder, arguments, FailedTest()))
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


class FailedTest:
    """Plugin of pytest that writes down which test, or which file, failed."""

    def pytest_configure(self) -> None:
        """Finds the file."""
        self._file = Path(FAILED).absolute()  # a test may work in another folder

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Writes into it."""
        if report.failed:
            self._file.write_text(report.nodeid)

    pytest_collectreport = pytest_runtest_logreport


def prepare() -> None:
    """Loads the libraries, and limits the memory, of all processes that are forked."""
    for library in LIBRARIES:
        importlib.import_module(library)
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))


def run(folder: Path, arguments: list[str], plugin: object) -> None:
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
    sys.exit(pytest.main(arguments, plugins=[plugin]))


def test_files(area: Area) -> list[str]:
    """The test files of an area, the quickest first."""
    return [f"tests/test_{test}.py" for test in area.tests]


class Lane:
    """Tests of an area in one lane."""

    def __init__(self, tree: Tree, area: Area, name: str) -> None:
        self.name = name
        self._tree = tree
        self._files = test_files(area)
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
