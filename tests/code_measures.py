"""Prints what a change of the code costs: files, functions of a call, names, rooms, lines, words.

./dev python -m tests.code_measures
"""

import re
import statistics
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter
from pathlib import Path

import grimp

import estune
import plants
from experiments.diagnosis_numbers.__main__ import functions_of
from experiments.diagnosis_numbers.cases import CASES
from tests.page_words import page_words
from tests.test_names import SHARED, class_names

ROOT = Path(__file__).parents[1]
PACKAGES = ("estune", "plants")


def recipes() -> dict[str, str]:
    """Number of files of each change, as CONTRIBUTING.md has it."""
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    return dict(re.findall(r"^### (.+?) \((\d+ files?.*)\)$", text, re.MULTILINE))


def functions_of_a_trial() -> float:
    """Functions entered from one search trial to the next, its rig and its journal included.

    The median of a tuning of the reference reel by the least-squares gradient.
    """
    entered: set[tuple[str, str]] = set()
    numbers = []
    here = tuple(f"{ROOT / name}/" for name in PACKAGES)

    def note(frame, event, _):
        code = frame.f_code
        # Comprehensions and lambdas are parts of a function.
        if event == "call" and code.co_filename.startswith(here) and code.co_name[0] != "<":
            entered.add((code.co_filename, code.co_qualname))

    def count(progress):
        if progress.entry.phase == "search":
            numbers.append(len(entered))
        entered.clear()

    with tempfile.TemporaryDirectory() as folder:
        sys.setprofile(note)
        try:
            reel, tuner = plants.reference_reel(), "least_squares_gradient"
            estune.tune(reel, tuner=tuner, trials=20, watch=count, folder=folder)
        finally:
            sys.setprofile(None)
    return statistics.median(numbers)


def floors(package: str) -> list[str]:
    """The floors of a package from the top to the bottom, by the contract of imports."""
    text = (ROOT / "pyproject.toml").read_text("utf-8")
    contracts = tomllib.loads(text)["tool"]["importlinter"]["contracts"]
    return next(c["layers"] for c in contracts if c["name"] == f"floors of {package}")


def arrows(package: str) -> set[tuple[str, str]]:
    """Pairs of rooms of which one imports the other."""
    graph = grimp.build_graph(package)
    rooms = {name for name in graph.find_children(package) if graph.find_children(name)}
    return {
        (one, other)
        for one in rooms
        for other in rooms - {one}
        if graph.direct_import_exists(importer=one, imported=other, as_packages=True)
    }


def lines() -> dict[str, int]:
    """Lines of Python of each room, and of all experiments and tests."""
    listed = subprocess.run(
        ["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    counts: Counter[str] = Counter()
    for name in listed.stdout.splitlines():
        top, *rest = Path(name).parts
        room = "/".join([top, *rest[:-1][:1]]) if top in PACKAGES else top
        counts[room] += (ROOT / name).read_bytes().count(b"\n")
    return dict(counts.most_common())


def main() -> None:
    """Prints them."""
    print("files of a change, by the recipes of CONTRIBUTING.md")
    for change, files in recipes().items():
        print(f"  {change:45} {files}")
    print("\nfunctions entered")
    print(f"  in one trial of a tuning{functions_of_a_trial():26g}")
    print(f"  in one call of explain, of plants/diagnosis{len(functions_of(CASES[0])):7}")
    print("\npublic class names that mean several things")
    for name, files in class_names().items():
        if len(files) > 1:
            print(f"  {name}: {SHARED.get(name, 'no reason given')}")
    for package in PACKAGES:
        count, found = sum(len(f.split(" | ")) for f in floors(package)), arrows(package)
        print(
            f"\n{package}: {count} rooms and modules on {len(floors(package))} floors, "
            f"{len(found)} arrows between rooms"
        )
    print("\nlines")
    counts = lines()
    product = sum(n for room, n in counts.items() if room.startswith(PACKAGES))
    for room, n in ({"estune and plants": product} | counts).items():
        print(f"  {room:25} {n:6}")
    print(f"\nwords of docs/ {sum(page_words().values()):18}")


if __name__ == "__main__":
    main()
