"""Does a sweep lose or repeat a finished tuning when its process is killed again and again?

`estune sweep` runs as a process with worker processes, and gets SIGKILL at a random moment, twenty
times; then it is let run to its end. A tuning counts as finished once it is in the sweep's file.
Lost is one that was finished before a kill and is not there after it, or not at the end; repeated
is one that was finished and was begun again, by a log that the model itself writes when it is
begun. What was found in the end is compared, number by number, with a sweep that nobody disturbed.
"""

import json
import os
import random
import sqlite3
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import estune
import plants
from estune.studies.sweep.cell import noise_seed
from estune.studies.sweep.design import read_design
from estune.studies.sweep.expand import expand_cells
from estune.studies.sweep.store import FILE_NAME
from estune.trial import Rig
from experiments.judged import at_most, command_line, tell

LOG = "ESTUNE_SWEEP_KILLS_LOG"
MOST_FURTHER = 4
"""A kill comes once none to so many further cells are finished, ..."""
LATER_s = 0.3
"""... and up to so much later; a start alone takes longer."""


class Told:
    """The reference reel, which writes down each time a rig of it is made."""

    def __init__(self, cable_length_m: float) -> None:
        self._reel = plants.reference_reel(cable_length_m)

    def rig(self, name: str, seed: int) -> Rig:
        """The reel's rig; its seed tells which cell it is for."""
        with Path(os.environ[LOG]).open("a", encoding="utf-8") as log:
            log.write(f"{seed}\n")
        return self._reel.rig(name=name, seed=seed)


def told_reel(cable_length_m: float) -> Told:
    """The model of the sweep."""
    return Told(cable_length_m)


def design(seeds: int) -> dict[str, Any]:
    """A sweep of ten lengths."""
    return {
        "lengths_m": np.linspace(0.5, 1.4, 10).round(3).tolist(),
        "rigs": ["experiments.sweep_kills:told_reel"],
        "seeds": seeds,
        "trials": 60,
        "repeats": 2,
    }


def kept(folder: Path) -> dict[str, str]:
    """When each cell in a sweep's file was finished, by its key."""
    if not (folder / FILE_NAME).exists():
        return {}
    connection = sqlite3.connect(f"file:{folder / FILE_NAME}?mode=ro", uri=True)
    try:
        return dict(connection.execute("SELECT key, finished_at FROM cell"))
    except sqlite3.OperationalError:  # killed before its table was there
        return {}
    finally:
        connection.close()


class Counts(NamedTuple):
    """What the kills came to.

    Attributes:
        kills: Processes killed.
        amid: Of these, with some cells finished and some not.
        lost: Finished cells that were not there later.
        repeated: Finished cells that were begun again.
        differing: Cells that differ from those of an undisturbed sweep.
        cells: Cells in all.
    """

    kills: int
    amid: int
    lost: int
    repeated: int
    differing: int
    cells: int


def killed(seeds: int, kills: int, seed: int = 0) -> Counts:
    """Kills a sweep again and again, lets it end, and counts."""
    dice = random.Random(seed)  # noqa: S311  moments, not secrets
    with tempfile.TemporaryDirectory() as place:
        folder, file, log = Path(place, "sweep"), Path(place, "design.json"), Path(place, "log")
        file.write_text(json.dumps(design(seeds)))
        os.environ[LOG] = str(log)
        log.touch()
        by_seed = {str(noise_seed(c)): c.key for c in expand_cells(read_design(design(seeds)))}
        lost = repeated = amid = 0
        before: dict[str, str] = {}
        _kill(file, folder, 1, 0.0)
        for _ in range(kills):
            after = kept(folder)
            lost += len(before.items() - after.items())
            begun = log.read_text().split()
            further = dice.randint(0, MOST_FURTHER)
            _kill(file, folder, len(after) + further, dice.uniform(0.0, LATER_s))
            repeated += _again(log, len(begun), after, by_seed)
            before = after
            amid += 0 < len(kept(folder)) < len(by_seed)
        after, begun = kept(folder), log.read_text().split()
        _ended(file, folder)
        repeated += _again(log, len(begun), after, by_seed)
        lost += len(after.items() - kept(folder).items()) + len(by_seed) - len(kept(folder))
        differing = _differing(seeds, folder, Path(place, "undisturbed"))
    return Counts(kills, amid, lost, repeated, differing, len(by_seed))


def _again(log: Path, seen: int, finished: dict[str, str], by_seed: dict[str, str]) -> int:
    """Finished cells that the log's newer lines tell of."""
    begun = log.read_text().split()[seen:]
    return sum(by_seed.get(seed) in finished for seed in begun)


def _kill(file: Path, folder: Path, cells: int, later_s: float) -> None:
    """Goes on with the sweep, and kills it some time after so many cells are finished."""
    process = _started(file, folder)
    while len(kept(folder)) < cells and process.poll() is None:
        time.sleep(0.01)
    time.sleep(later_s)
    process.kill()
    process.wait()


def _started(file: Path, folder: Path) -> subprocess.Popen[bytes]:
    code = (
        "import json, pathlib, sys, estune; "
        "estune.sweep(json.loads(pathlib.Path(sys.argv[1]).read_text()), folder=sys.argv[2], "
        "jobs=2, watch=None)"
    )
    return subprocess.Popen(  # noqa: S603  this very interpreter
        [sys.executable, "-c", code, str(file), str(folder)],
        cwd=Path(__file__).parents[1],
        stderr=subprocess.DEVNULL,
    )


def _ended(file: Path, folder: Path) -> None:
    code = _started(file, folder).wait()
    if code:
        raise RuntimeError(f"the sweep ended with code {code}")


def _differing(seeds: int, folder: Path, other: Path) -> int:
    """Cells that differ from those of a sweep nobody disturbs."""
    one = estune.sweep(design(seeds), folder=folder, jobs=1, watch=None)
    undisturbed = estune.sweep(design(seeds), folder=other, jobs=1, watch=None)
    pairs = zip(one.outcomes, undisturbed.outcomes, strict=True)
    return sum(a.gains != b.gains or not np.array_equal(a.trace, b.trace) for a, b in pairs)


WORDS = {
    "kills": "times killed",
    "amid": "  of these with some tunings finished and some not",
    "cells": "tunings in all",
    "lost": "finished tunings lost",
    "repeated": "finished tunings begun again",
    "differing": "tunings that differ from those of an undisturbed sweep",
}


def main() -> int:
    """Measures, prints, and says by its exit code whether every target was met."""
    options = command_line(__doc__, quick="two kills of a smaller sweep").parse_args()
    found = killed(*((1, 1) if options.quick else (12, 20)))
    figures = {name: float(value) for name, value in found._asdict().items()}
    targets = {name: at_most(figures[name], 0.0) for name in ("lost", "repeated", "differing")}
    if not options.json:
        for name, words in WORDS.items():
            print(f"{figures[name]:6g}  {words}")
    return tell(figures, targets, as_json=options.json)


if __name__ == "__main__":
    raise SystemExit(main())
