"""Does `explain` answer every damaged record with a diagnosis or a reason?

Command: `python -m experiments.damaged_records --data FOLDER`.
Target: no traceback, less than 500 MB, less than 30 CPU s each, and every refusal names what it is
about and what to do.

One to three damages, drawn by the seed, befall one or all records of a machine; these are written
as CSV and diagnosed in this process. Printed are the number of cases by damage and ending, and
what went wrong.
"""

import re
import resource
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estune.errors import EstuneError
from experiments.damaged_records.damages import DAMAGES
from experiments.damaged_records.machines import Machine, Table, machines
from experiments.measured_data import folder
from experiments.results import Target, at_most, command_line, print_results
from plants.diagnosis.explain import explain

CASES = 500
MOST_MB, MOST_S = 500.0, 30.0
LONGEST = 1000
"""Letters of a refusal."""
VERDICTS = ("none", "named", "incomplete", "unknown", "ambiguous")
REMEDY = re.compile(
    "[;:] (align|ask|change|check|correct|excite|give|map|name|record|remove|rename|sort)"
)
"""What a remedy begins with."""


class DamagedCase(NamedTuple):
    """What came of one case.

    Attributes:
        machine: Name of the machine.
        damages: Names of the damages.
        ending: Verdict, or `refused`, or the name of what was raised.
        said: The refusals, or the error.
        cpu_s: CPU time, s.
    """

    machine: str
    damages: tuple[str, ...]
    ending: str
    said: tuple[str, ...]
    cpu_s: float


def answers(
    cases: int, seed: int, kinds: list[Machine], damages: tuple[str, ...] = tuple(DAMAGES)
) -> Iterator[DamagedCase]:
    """Answers to damaged records, case by case.

    Args:
        cases: Their number.
        seed: Seed; each case draws from its own.
        kinds: The machines, in turn.
        damages: The damages to draw from.
    """
    for case in range(cases):
        rng = np.random.default_rng([seed, case])
        machine = kinds[case % len(kinds)]
        names = tuple(rng.choice(damages, int(rng.integers(1, 4)), replace=False).tolist())
        everywhere = bool(rng.random() < 0.5)
        with tempfile.TemporaryDirectory() as place:
            for number, table in enumerate(machine.tables):
                if everywhere or number == 0:
                    table = _damaged(table, names, rng)  # noqa: PLW2901
                _write(Path(place, f"{number}.csv"), table)
            yield _answer(machine, names, Path(place))


def _damaged(table: Table, names: tuple[str, ...], rng: np.random.Generator) -> Table:
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in names:
            if min(values.size for values in table.values()) > 2:
                table = DAMAGES[name](table, rng)
    return table


def _write(path: Path, table: Table) -> None:
    rows = np.column_stack(list(table.values()))
    np.savetxt(path, rows, "%.10g", ",", header=",".join(table), comments="")


def _answer(machine: Machine, names: tuple[str, ...], place: Path) -> DamagedCase:
    began = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = explain(machine.model, place, columns=machine.columns)
        said = tuple(str(f) for f in found.findings if f.level == "refused")
        ending = str(found.verdict)
    except EstuneError as error:
        ending, said = "refused", (str(error),)
    except Exception as error:  # noqa: BLE001  this experiment looks for them
        ending, said = type(error).__name__, (_where(error),)
    return DamagedCase(machine.name, names, ending, said, time.process_time() - began)


def _where(error: Exception) -> str:
    frames, at = [], error.__traceback__
    while at is not None:
        frames.append(f"{Path(at.tb_frame.f_code.co_filename).name}:{at.tb_lineno}")
        at = at.tb_next
    return f"{error} at {' '.join(frames[-5:])}"


def is_helpful(refusal: str) -> bool:
    """Whether a refusal says what to do, in a length that is read."""
    return bool(REMEDY.search(refusal)) and len(refusal) < LONGEST


def main(arguments: list[str] | None = None) -> int:
    """Runs the experiment."""
    parser = command_line(__doc__, quick="a twentieth of the cases")
    parser.add_argument("--data", type=Path, help="folder of measured machines")
    parser.add_argument("--seed", type=int, default=1, help="seed of the damages")
    parser.add_argument("--cases", type=int, default=CASES, help="number of cases")
    options = parser.parse_args(arguments)
    cases = options.cases // 20 if options.quick else options.cases
    endings: Counter[str] = Counter()
    by_damage: dict[str, Counter[str]] = {}
    faults, slowest, bare = 0, 0.0, 0
    for number, answer in enumerate(answers(cases, options.seed, machines(folder(options.data)))):
        endings[answer.ending] += 1
        for name in answer.damages:
            by_damage.setdefault(name, Counter())[answer.ending] += 1
        slowest = max(slowest, answer.cpu_s)
        about = f"case {number}, {answer.machine}, {'+'.join(answer.damages)}"
        if answer.ending not in (*VERDICTS, "refused"):
            faults += 1
            print(f"{about}: {answer.ending}: {answer.said[0]}", file=sys.stderr, flush=True)
        for text in answer.said:
            if answer.ending in (*VERDICTS, "refused") and not is_helpful(text):
                bare += 1
                print(f"{about}: no remedy: {text}", file=sys.stderr, flush=True)
    figures = {
        "endings": dict(sorted(endings.items())),
        "by damage": {name: dict(sorted(c.items())) for name, c in sorted(by_damage.items())},
    }
    megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    targets: dict[str, Target] = {
        "tracebacks": at_most(faults, 0),
        "refusals_without_a_remedy": at_most(bare, 0),
        "memory_MB": at_most(megabytes, MOST_MB),
        "longest_cpu_s": at_most(slowest, MOST_S),
    }
    return print_results(figures, targets, as_json=options.json)


if __name__ == "__main__":
    sys.exit(main())
