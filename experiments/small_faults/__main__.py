"""Are small faults in the source noticed by the tests of what they change?

Command: `python -m experiments.small_faults`.
Target: at least 0.95 of the faults are caught, without those that change no behaviour.

In each area, faults are drawn by a seed: first a kind that its files have, then a place. Each is
put alone into a copy of the tree, never into the checkout, and the test files of its area are run
by day and, if they notice nothing, by night (`-m slow`). A run that takes ten times as long as
without the fault is stopped, and its fault counts as caught: a suite that hangs is noticed. What
was looked into and changes no behaviour is listed with its reason and left out.
"""

import os
import resource
import shutil
import subprocess
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
from experiments.small_faults.faults import Fault, faults_of

ROOT = Path(__file__).resolve().parents[2]
LANES = {"day": "not slow", "slow": "slow"}
MEMORY_BYTES = 4 << 30
"""Memory of a run of tests: a fault in the lease made a search of its states take 7 GB."""
NO_TESTS = 5
"""Exit code of pytest where a lane has no test of these files."""


class Drawn(NamedTuple):
    """A fault of a file."""

    file: str
    fault: Fault

    @property
    def place(self) -> str:
        """File and line."""
        return f"{self.file}:{self.fault.line}"

    @property
    def reason(self) -> str:
        """Why it changes no behaviour; empty where it does, or nobody has looked into it."""
        lines = (ROOT / self.file).read_text(encoding="utf-8").splitlines()
        return UNCHANGED.get((lines[self.fault.line - 1].strip(), str(self.fault)), "")


class Tree:
    """A copy of the tree, in which faults are put and tests run."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        unused = shutil.ignore_patterns(".*", "__pycache__", "out", "runs")
        shutil.copytree(ROOT, folder, ignore=unused, symlinks=True, dirs_exist_ok=True)
        self._env = os.environ | {"PYTHONPATH": str(folder)}

    def put(self, drawn: Drawn | None, file: str) -> None:
        """Puts a fault into a file, or its own text back.

        Python compiles a file anew whose time differs by a second, which a run of tests takes.
        """
        source = (ROOT / file).read_bytes()
        (self._folder / file).write_bytes(drawn.fault.put_into(source) if drawn else source)

    def fails(self, tests: Sequence[str], lane: str, within_s: float) -> bool:
        """Whether a test file fails in a lane, or does not end in time."""
        files = [f"tests/test_{name}.py" for name in tests]
        how = ["-x", "-q", "-p", "no:cacheprovider", "--numprocesses=0", "-m", LANES[lane]]
        process = subprocess.Popen(  # noqa: S603  the interpreter of these tests
            [sys.executable, "-m", "pytest", *how, *files],
            cwd=self._folder,
            env=self._env,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            return process.wait(within_s) not in (0, NO_TESTS)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, 9)  # its servers and loops too
            process.wait()
            return True


def drawn_in(area: Area, number: int, random: Random) -> list[Drawn]:
    """Faults of an area: kinds in turn, so that no frequent kind crowds out the others."""
    by_kind: dict[str, list[Drawn]] = {}
    for file in area.files:
        for fault in faults_of((ROOT / file).read_bytes()):
            by_kind.setdefault(fault.kind, []).append(Drawn(file, fault))
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
            tree.put(None, one.file)
            begun = time.monotonic()
            if tree.fails(area.tests, lane, 3600.0):
                raise SystemExit(
                    f"{lane}: tests of {', '.join(area.tests)} fail without any fault"
                )
            took[lane] = time.monotonic() - begun
        tree.put(one, one.file)
        return tree.fails(area.tests, lane, 60.0 + 10.0 * took[lane])

    for one in drawn:
        yield one, next(filter(noticed, LANES), "not caught")
        tree.put(None, one.file)


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
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
    with TemporaryDirectory(prefix="small-faults-") as folder:
        tree = Tree(Path(folder))
        for name in names:
            random = Random(f"{options.seed} {name}")  # noqa: S311  no secret
            drawn = drawn_in(AREAS[name], 2 if options.quick else options.each, random)
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
