"""Are small faults in the source noticed by the tests of what they change?

Command: `python -m experiments.small_faults`.
Target: at least 0.95 of the faults are caught, without those that change no behaviour.

In each area, faults are drawn by a seed: first a kind that its files have, then a place. Each is
put alone into a copy of the tree, never into the checkout, and the test files of its area are run
by day and, if they notice nothing, by night (`-m slow`). A run that takes ten times as long as
without the fault is stopped, and its fault counts as caught: a suite that hangs is noticed. What
was looked into and changes no behaviour is listed with its reason and left out.
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
from typing import NamedTuple

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

    def exit_code(self, tests: Sequence[str], lane: str, within_s: float) -> int | None:
        """Exit code of test files in a lane; that of a kill where they do not end in time."""
        files = [f"tests/test_{name}.py" for name in tests]
        how = ["-x", "-q", "-p", "no:cacheprovider", "--numprocesses=0", "-m", LANES[lane]]
        process = FORK.Process(target=_run, args=(self.folder, [*how, *files]))
        process.start()
        process.join(within_s)
        if process.exitcode is None:
            os.killpg(process.ident or 0, signal.SIGKILL)  # its servers and loops too
            process.join()
        return process.exitcode


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
    sys.exit(pytest.main(arguments))


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


def tried(tree: Tree, area: Area, drawn: Sequence[Drawn]) -> Iterator[tuple[Drawn, str]]:
    """Each fault, and the lane that caught it or `not caught`."""
    took: dict[str, float] = {}

    def noticed(lane: str) -> bool:
        if lane not in took:  # before the first fault that this lane has to notice
            tree.take_out(one)
            begun = time.monotonic()
            code = tree.exit_code(area.tests, lane, 3600.0)
            if code not in (0, NO_TESTS):
                raise SystemExit(f"tests of {area.tests} fail without a fault, by {lane}")
            took[lane] = 0.0 if code else time.monotonic() - begun
        tree.put(one)
        within_s = 60.0 + 10.0 * took[lane]
        return took[lane] > 0.0 and tree.exit_code(area.tests, lane, within_s) != 0

    for one in drawn:
        yield one, next(filter(noticed, LANES), "not caught")
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
            told = [(one, "unchanged") for one in drawn if one.reason]
            todo = [one for one in drawn if not one.reason]
            results = (
                ((one, "") for one in todo) if options.list else tried(tree, AREAS[name], todo)
            )
            for one, noticed in chain(told, results):
                print(noticed, one.place, one.fault, file=sys.stderr, flush=True)
                row = {"area": name, "place": one.place, "fault": str(one.fault)}
                rows.append(row | {"noticed": one.reason or noticed})
                if noticed:
                    counts[noticed] += 1
    caught = sum(counts[lane] for lane in LANES)
    share = caught / max(caught + counts["not caught"], 1)
    targets: dict[str, Target] = {} if options.list else {"share_caught": at_least(share, 0.95)}
    figures = {**counts, "faults": rows}
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
