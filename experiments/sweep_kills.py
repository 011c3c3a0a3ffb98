"""Does a sweep lose or repeat a finished tuning when its process is killed again and again?

`estune sweep` runs as a process with worker processes, and gets SIGKILL at a random moment, twenty
times; then it runs to its end. A tuning is finished once it is in the sweep's file. It is lost if
it was there before a kill and is not there later. It is repeated if it was finished and was begun
again, by a log that the model writes whenever a rig of it is made. The final results are compared,
number by number, with those of an undisturbed sweep.
"""

import json
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import estune
import plants
from estune.errors import JournalError
from estune.studies.sweep.cells import expand_cells
from estune.studies.sweep.design import read_design
from estune.studies.sweep.outcome import KIND
from estune.studies.sweep.store import FILE_NAME
from estune.support.sqlite import SqliteFile
from estune.trial import Rig
from experiments.results import at_most, command_line, print_results

LOG = "ESTUNE_SWEEP_KILLS_LOG"
FURTHER_CELLS_MAX = 4
"""A kill comes once at most this many further cells are finished, ..."""
DELAY_MAX_s = 0.3
"""... and up to this much later; the start of the process alone takes longer."""


class LoggedReel:
    """The reference reel, which logs each time a rig of it is made."""

    def __init__(self, cable_length_m: float) -> None:
        self._reel = plants.reference_reel(cable_length_m)

    def rig(self, name: str, seed: int) -> Rig:
        """The reel's rig; its seed identifies the cell."""
        with Path(os.environ[LOG]).open("a", encoding="utf-8") as log:
            log.write(f"{seed}\n")
        return self._reel.rig(name=name, seed=seed)


def design(seeds: int) -> dict[str, Any]:
    """A sweep of ten lengths."""
    return {
        "lengths_m": np.linspace(0.5, 1.4, 10).round(3).tolist(),
        "rigs": ["experiments.sweep_kills:LoggedReel"],
        "seeds": seeds,
        "trials": 60,
        "repeats": 2,
    }


def finish_times(folder: Path) -> dict[str, str]:
    """When each cell in a sweep's file was finished, by its key."""
    try:
        with SqliteFile.open_reader(folder / FILE_NAME, KIND) as file:
            return dict(file.rows("SELECT key, finished_at FROM cell"))
    except JournalError:  # no file yet, or killed before its table was there
        return {}


class Counts(NamedTuple):
    """Counts of kills and of cells, the tunings of the sweep."""

    kills: int
    amid: int  # kills with some tunings finished and some not
    lost: int  # finished tunings lost
    repeated: int  # finished tunings begun again
    differing: int  # tunings that differ from those of an undisturbed sweep
    cells: int


def count_losses(seeds: int, kills: int, seed: int = 0) -> Counts:
    """Kills a sweep repeatedly, lets it end, and counts."""
    dice = random.Random(seed)  # noqa: S311  moments, not secrets
    with tempfile.TemporaryDirectory() as place:
        folder, file, log = Path(place, "sweep"), Path(place, "design.json"), Path(place, "log")
        file.write_text(json.dumps(design(seeds)))
        os.environ[LOG] = str(log)
        log.touch()
        cells = expand_cells(read_design(design(seeds)))
        by_seed = {str(cell.noise_seed): cell.key for cell in cells}
        lost = repeated = amid = 0
        before: dict[str, str] = {}
        _kill(file, folder, 1, 0.0)
        for _ in range(kills):
            after = finish_times(folder)
            lost += len(before.items() - after.items())
            begun = log.read_text().split()
            further = dice.randint(0, FURTHER_CELLS_MAX)
            _kill(file, folder, len(after) + further, dice.uniform(0.0, DELAY_MAX_s))
            repeated += _repeated(log, len(begun), after, by_seed)
            before = after
            amid += 0 < len(finish_times(folder)) < len(by_seed)
        after, begun = finish_times(folder), log.read_text().split()
        _run_to_end(file, folder)
        repeated += _repeated(log, len(begun), after, by_seed)
        ended = finish_times(folder)
        lost += len(after.items() - ended.items()) + len(by_seed) - len(ended)
        differing = _differing(seeds, folder, Path(place, "undisturbed"))
    return Counts(kills, amid, lost, repeated, differing, len(by_seed))


def _repeated(log: Path, seen: int, finished: dict[str, str], by_seed: dict[str, str]) -> int:
    """Number of finished cells in the newer lines of the log."""
    begun = log.read_text().split()[seen:]
    return sum(by_seed.get(seed) in finished for seed in begun)


def _kill(file: Path, folder: Path, cells: int, later_s: float) -> None:
    """Continues the sweep, and kills it some time after a number of cells are finished."""
    process = _start(file, folder)
    while len(finish_times(folder)) < cells and process.poll() is None:
        time.sleep(0.01)
    time.sleep(later_s)
    process.kill()
    process.wait()


def _start(file: Path, folder: Path) -> subprocess.Popen[bytes]:
    code = (
        "import json, pathlib, sys, estune; "
        "estune.sweep(json.loads(pathlib.Path(sys.argv[1]).read_text()), folder=sys.argv[2], "
        "jobs=2, watch=None)"
    )
    return subprocess.Popen(  # noqa: S603  this very interpreter
        [sys.executable, "-c", code, str(file), str(folder)],
        stderr=subprocess.DEVNULL,
    )


def _run_to_end(file: Path, folder: Path) -> None:
    code = _start(file, folder).wait()
    if code:
        raise RuntimeError(f"the sweep ended with code {code}")


def _differing(seeds: int, folder: Path, other: Path) -> int:
    """Number of cells that differ from those of an undisturbed sweep."""
    one = estune.sweep(design(seeds), folder=folder, jobs=1, watch=None)
    undisturbed = estune.sweep(design(seeds), folder=other, jobs=1, watch=None)
    pairs = zip(one.outcomes, undisturbed.outcomes, strict=True)
    return sum(a.gains != b.gains or not np.array_equal(a.trace, b.trace) for a, b in pairs)


def main() -> int:
    """Measures and prints; exit code 1 if a target is missed."""
    options = command_line(__doc__, quick="two kills of a smaller sweep").parse_args()
    counts = count_losses(*((1, 1) if options.quick else (12, 20)))
    figures = {name: float(value) for name, value in counts._asdict().items()}
    targets = {name: at_most(figures[name], 0.0) for name in ("lost", "repeated", "differing")}
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
