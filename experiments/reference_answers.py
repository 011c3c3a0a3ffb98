"""Does a change of the code leave the answers of the diagnosis as they were?

Command: `python -m experiments.reference_answers --against FILE`.
Target: the same verdicts and names as in the file, and values within 1e-6 of them.

Cases are those of `experiments.diagnosis_numbers`, of development seeds. The code before the
change writes the file, with `--into FILE`.
"""

import json
import math
import tempfile
from pathlib import Path
from typing import Any

import plants
from experiments.diagnosis_numbers.cases import CASES, case_of
from experiments.results import Target, at_most, command_line, print_results

WITHIN = 1e-6
"""Relative difference of values that the order of sums explains."""


def answer(name: str) -> dict[str, Any]:
    """Verdict, names and values of a case."""
    with tempfile.TemporaryDirectory() as place:
        case = case_of(name, Path(place))
        found = plants.explain(
            case.model, case.records, effects=case.effects, columns=case.columns
        )
    names = sorted(effect.name for effect in found.effects)
    said = " ".join([found.verdict, *names, *found.ambiguous])
    return {"said": said, "values": {name: float(value) for name, value in found.values.items()}}


def difference(before: dict[str, float], after: dict[str, float]) -> float:
    """Greatest relative difference of two sets of values; infinite where others are in them."""
    if before.keys() != after.keys():
        return math.inf
    sizes = {name: max(abs(before[name]), abs(after[name]), 1e-12) for name in before}
    return max((abs(after[n] - before[n]) / sizes[n] for n in before), default=0.0)


def main() -> int:
    """Prints a line for each case; returns 1 where an answer is another than in the file."""
    parser = command_line(__doc__, quick="one case")
    parser.add_argument("--into", type=Path, help="write the answers into this file")
    parser.add_argument("--against", type=Path, help="compare the answers with this file")
    parser.add_argument("--cases", type=int, default=len(CASES), help="number of cases")
    options = parser.parse_args()
    known = {} if options.against is None else json.loads(options.against.read_text("utf-8"))
    answers, changed, furthest = {}, 0, 0.0
    for name in CASES[: 1 if options.quick else options.cases]:
        answers[name] = found = answer(name)
        line = f"{name}: {found['said']}"
        if name in known:
            apart = difference(known[name]["values"], found["values"])
            changed += known[name]["said"] != found["said"]
            furthest = max(furthest, apart)
            line += f"; before: {known[name]['said']}; values differ by {apart:.1e}"
        if not options.json:
            print(line, flush=True)
    if options.into is not None:
        options.into.write_text(json.dumps(answers, indent=1), encoding="utf-8")
    targets: dict[str, Target] = {}
    if known:
        targets = {"changed": at_most(changed, 0), "values": at_most(furthest, WITHIN)}
    return print_results({"answers": answers}, targets, as_json=options.json)


if __name__ == "__main__":
    raise SystemExit(main())
