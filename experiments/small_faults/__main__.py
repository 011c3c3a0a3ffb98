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

With `--all`, every fault of the areas is tried, by day only, as `every.py` says. The results are
added to `small_faults_AREA.jsonl` in the folder `--out`; what stands there is not tried again.
"""

import math
import sys
from argparse import Namespace
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

from experiments.results import Target, at_least, command_line, print_results
from experiments.small_faults.areas import AREAS, Area
from experiments.small_faults.every import (
    CANDIDATE,
    NOT_CAUGHT,
    Results,
    candidates,
    confirmed,
    every_fault,
)
from experiments.small_faults.faults import faults_of
from experiments.small_faults.tree import LANES, Drawn, Lane, Tree, prepare


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


def tried(tree: Tree, area: Area, drawn: Sequence[Drawn]) -> Iterator[tuple[Drawn, str, str]]:
    """Each fault, the lane that caught it or `not caught`, and the test that did."""
    lanes = [Lane(tree, area, name) for name in LANES]
    for one in drawn:
        found = ((lane.name, test) for lane in lanes if (test := lane.noticed(one)))
        yield one, *next(found, ("not caught", ""))
        tree.take_out(one)


def tried_all(
    tree: Tree, name: str, drawn: Sequence[Drawn], options: Namespace
) -> Iterator[tuple[Drawn, str, str]]:
    """Each fault of an area, as `tried` says it, by what was known before and is found now."""
    area, file = AREAS[name], options.out / f"small_faults_{name}.jsonl"
    results = Results(file)
    again = ("", CANDIDATE, NOT_CAUGHT) if options.again else ("",)
    if todo := [one for one in drawn if results.of(one)[0] in again]:
        candidates(tree, area, todo, file, longest_s=options.longest)
        results = Results(file)
    if not options.candidates:
        left = [one for one in drawn if results.of(one)[0] == CANDIDATE]
        confirmed(tree, area, left, results)
    for one in drawn:
        yield one, *results.of(one)


def judged(tree: Tree, name: str, options: Namespace) -> Iterator[tuple[Drawn, str, str]]:
    """Each fault that an area is tried with, or its list, as `tried` says it."""
    area = AREAS[name]
    if options.all:
        drawn = every_fault(tree.folder, area, options.file)
    else:
        random = Random(f"{options.seed} {name}")  # noqa: S311  no secret
        drawn = drawn_in(tree.folder, area, 2 if options.quick else options.each, random)
    told = ((one, "unchanged", "") for one in drawn if one.reason)
    todo = [one for one in drawn if not one.reason]
    if options.list:
        return chain(told, ((one, "", "") for one in todo))
    return chain(
        told, tried_all(tree, name, todo, options) if options.all else tried(tree, area, todo)
    )


def main() -> int:
    """Puts the faults in and prints what noticed them."""
    parser = command_line(__doc__, quick="two faults in the lease", out="results of --all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--each", type=int, default=6, help="faults of each area")
    parser.add_argument("--area", choices=AREAS, action="append", help="only this area")
    parser.add_argument("--list", action="store_true", help="list the faults, and run nothing")
    parser.add_argument("--all", action="store_true", help="all faults, by day; goes on if begun")
    parser.add_argument("--file", default="", help="with --all: only files with this in the name")
    parser.add_argument(
        "--again", action="store_true", help="with --all: what was not caught, too"
    )
    parser.add_argument("--candidates", action="store_true", help="with --all: confirm nothing")
    longest = "with --all: first only tests that take at most this, s"
    parser.add_argument("--longest", type=float, default=math.inf, help=longest)
    options = parser.parse_args()
    names = ["lease"] if options.quick else options.area or list(AREAS)
    rows = []
    counts: dict[str, int] = dict.fromkeys((*LANES, CANDIDATE, NOT_CAUGHT, "unchanged"), 0)
    prepare()
    with TemporaryDirectory(prefix="small-faults-") as folder:
        tree = Tree(Path(folder).resolve())
        for name in names:
            for one, noticed, test in judged(tree, name, options):
                print(noticed, one.place, one.fault, test, file=sys.stderr, flush=True)
                row = {"area": name, "place": one.place, "fault": str(one.fault)}
                rows.append(row | {"noticed": one.reason or noticed, "test": test})
                if noticed:
                    counts[noticed] += 1
    caught = sum(counts[lane] for lane in LANES)
    share = caught / max(caught + counts[CANDIDATE] + counts[NOT_CAUGHT], 1)
    targets: dict[str, Target] = {} if options.list else {"share_caught": at_least(share, 0.95)}
    figures = {**counts, "faults": rows}
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
