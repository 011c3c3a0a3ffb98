"""Which numbers of the diagnosis change a verdict when they are halved or doubled?

Command: `python -m experiments.diagnosis_numbers --into FILE`.
Target: none; a line for each number, with the cases whose verdict or names it changes.

Numbers are those of `numbers.py`, in cases of the development seeds of
`experiments.hidden_machines` and `experiments.independent_drives`. Those last used in one step
are changed all at once; where that changes the answer, halves of the group are, until each number
that does is alone. A case begins with the step in which one is first used, and ends where
records, noise and base fit are as they were and no later step uses one. `--list` prints the
numbers, `--rows` the table of a file, `--functions` the functions of the room that a call of
`explain` enters: of a drive and of a reel that is left unexplained, whose is more.
"""

import itertools
import json
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

import plants
from estune.support.blas import one_blas_thread
from experiments.diagnosis_numbers.cases import CASES, DiagnosisCase, case_of
from experiments.diagnosis_numbers.numbers import (
    FOLDER,
    Number,
    numbers,
    outside,
    replaced,
    scaled,
)
from experiments.results import command_line, print_results
from plants.diagnosis.data.noise_floor import noise_floor
from plants.diagnosis.data.records import read
from plants.diagnosis.models.diagnosed_model import diagnosed
from plants.diagnosis.pipeline.check import check
from plants.diagnosis.pipeline.compare import compare
from plants.diagnosis.pipeline.fit import fit
from plants.diagnosis.pipeline.screen import screen
from plants.diagnosis.progress import silent
from plants.diagnosis.search import least_squares, model_fitter, validation
from plants.diagnosis.search.effect_choices import EffectChoices

FITTED_WITH = ("prediction/", "models/", "search/least_squares.py")
"""What a fit is made with: with numbers of these each fit is made anew."""
ENTERED = ("servo 1", "outside 20001")
"""Cases of which the functions entered are listed."""


class Said(NamedTuple):
    """What a diagnosis answers, and the values of its steps."""

    answer: str
    values: dict[str, Any]
    used: dict[str, frozenset[tuple[str, int]]]


def diagnose(
    case: DiagnosisCase, known: dict[str, Any], stop: Callable[[str, Any], bool]
) -> Said | None:
    """Runs the steps that are not known; None where one says that nothing will change.

    The functions used are listed only where no step is known: that takes time.
    """
    values, used, first = dict(known), {}, not known

    def step(name: str, of: Callable[[], Any]) -> Any:
        if name in values:
            return values[name]
        watched: AbstractContextManager[set[tuple[str, int]]] = (
            functions_entered() if first else nullcontext(set())
        )
        with watched as entered:
            values[name] = of()
        used[name] = frozenset(entered)
        return values[name]

    logged = step("read", lambda: read(case.records, case.model, case.columns))
    usable = step("check", lambda: check(logged, case.model))
    sensors = step("noise", lambda: noise_floor(usable.measurements))
    if stop("noise", values):
        return None
    plant = step("plant", lambda: diagnosed(case.model, usable.measurements))
    choices = EffectChoices.of(plant, case.effects)
    fitted = step("fit", lambda: fit(plant, sensors, choices))
    if stop("fit", values):
        return None
    screening = step("screen", lambda: screen(fitted))
    last = step("compare", lambda: compare(usable, fitted, screening, (), silent))
    names = sorted(effect.name for effect in last.effects)
    tied = sorted(last.conclusion.tied) if last.verdict == "ambiguous" else []
    answer = " ".join([last.verdict, *names, *(["tied:", *tied] if tied else [])])
    return Said(answer, values, used)


@contextmanager
def functions_entered() -> Iterator[set[tuple[str, int]]]:
    """The functions entered meanwhile, as (file, first line)."""
    entered: set[tuple[str, int]] = set()

    def note(frame: Any, event: str, _: Any) -> None:
        if event == "call":
            entered.add((frame.f_code.co_filename, frame.f_code.co_firstlineno))

    with profiled(note):
        yield entered


@contextmanager
def profiled(note: Callable[[Any, str, Any], None]) -> Iterator[None]:
    """Calls a function at each call and return meanwhile."""
    sys.setprofile(note)
    try:
        yield
    finally:
        sys.setprofile(None)


@contextmanager
def fits_made_once(made: dict[Any, Any]) -> Iterator[None]:
    """Fits of the same predictor from the same values are not made again."""
    plain = least_squares.fit

    def content(argument: Any) -> Any:
        return argument.tobytes() if isinstance(argument, np.ndarray) else argument

    def once(predictor: Any, *arguments: Any, **options: Any) -> Any:
        named = sorted((name, content(value)) for name, value in options.items())
        key = (id(predictor), *map(content, arguments), *named)
        if key not in made:
            made[key] = plain(predictor, *arguments, **options)
        return made[key]

    with mock.patch.object(model_fitter, "fit", once), mock.patch.object(validation, "fit", once):
        yield


def answer_with(
    case: DiagnosisCase,
    numbers: Sequence[Number],
    factor: float,
    first: Said,
    made: dict[Any, Any],
) -> str:
    """The answer with some numbers times a factor, all at once."""
    uses = frozenset[tuple[str, int]]().union(*(n.uses for n in numbers))
    steps = [name for name, entered in first.used.items() if entered & uses]
    order = list(first.values)
    kept = order[: order.index(steps[0])]
    known = {name: first.values[name] for name in kept}
    last = max(order.index(name) for name in steps)

    def stop(name: str, values: dict[str, Any]) -> bool:
        if last > order.index(name) or name in known:
            return False
        return bool(_content(name, values) == _content(name, first.values))

    anew = any(part in path for path, _ in uses for part in FITTED_WITH)
    anew |= any(n.name in ("effective", "range") for n in numbers)
    others = {n: scaled(n, factor) for n in numbers}
    try:
        with replaced(others), fits_made_once({} if anew else made):
            said = diagnose(case, known, stop)
    except Exception as error:  # noqa: BLE001  a number that breaks it decides
        return f"{type(error).__name__}: {error}"[:120]
    return first.answer if said is None else said.answer


def changed_by(
    numbers: Sequence[Number], answer: Callable[[Sequence[Number]], str], before: str
) -> dict[Number, str]:
    """The answers with the numbers that change it, found by halving the group of them.

    Numbers that change nothing all at once are not tried alone: two that undo each other are
    missed.
    """
    after = answer(numbers)
    if after == before:
        return {}
    if len(numbers) == 1:
        return {numbers[0]: after}
    middle = len(numbers) // 2
    halves = numbers[:middle], numbers[middle:]
    return {n: said for half in halves for n, said in changed_by(half, answer, before).items()}


def _content(name: str, values: dict[str, Any]) -> Any:
    """What later steps take of the steps up to one."""
    usable, sensors = values["check"], values["noise"]
    records = [(m.name, m.samples) for m in usable.measurements]
    found = (records, [str(issue) for issue in usable.findings], sensors.channels)
    if name == "noise":
        return found
    fitter, base = values["fit"].fitter, values["fit"].models.base
    line = values["fit"].line
    return (
        *(found, fitter.base.free, fitter.base.index.sigma.tobytes(), base.values),
        *(values["fit"].where.blocks, values["fit"].scale, line and line.frequency_Hz),
    )


def read_rows(path: Path | None) -> list[dict[str, Any]]:
    """The rows of a file; none where there is no file."""
    if path is None or not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def measure(name: str, todo: list[Number]) -> Iterator[dict[str, Any]]:
    """Halves and doubles the numbers in one case, those together whose last step is one."""
    with tempfile.TemporaryDirectory() as place, one_blas_thread():
        case = case_of(name, Path(place))
        made: dict[Any, Any] = {}
        with fits_made_once(made):
            first = diagnose(case, {}, lambda *_: False)
        assert first is not None  # noqa: S101  nothing stops it
        groups: dict[str, list[Number]] = defaultdict(list)
        for number in todo:
            steps = [step for step, entered in first.used.items() if entered & number.uses]
            if steps:
                groups[steps[-1]].append(number)
        for group, factor in itertools.product(groups.values(), (0.5, 2.0)):
            answer = partial(answer_with, case, factor=factor, first=first, made=made)
            after = changed_by(group, answer, first.answer)
            for number in group:
                about = {"case": name, "number": number.name, "factor": factor}
                said = after.get(number, first.answer)
                yield {**about, "before": first.answer, "after": said}


def functions_of(name: str) -> list[str]:
    """Functions of the room that a call enters, as file:line."""
    entered: set[tuple[str, int, str]] = set()

    def note(frame: Any, event: str, _: Any) -> None:
        code = frame.f_code
        # Comprehensions and lambdas are parts of a function.
        if event == "call" and not code.co_name.startswith("<"):
            entered.add((code.co_filename, code.co_firstlineno, code.co_qualname))

    with tempfile.TemporaryDirectory() as place:
        case = case_of(name, Path(place))
        with profiled(note):
            plants.explain(case.model, case.records, effects=case.effects, columns=case.columns)
    inside = sorted(at for at in entered if Path(at[0]).is_relative_to(FOLDER))
    return [f"{Path(path).relative_to(FOLDER)}:{line} {name}" for path, line, name in inside]


def table(rows: list[dict[str, Any]], known: list[Number]) -> dict[str, Any]:
    """For each number the cases it was used in, and what changed there."""
    used: dict[str, set[str]] = defaultdict(set)
    changed: dict[str, list[str]] = defaultdict(list)
    for row in rows:
        used[row["number"]].add(row["case"])
        if row["before"] != row["after"]:
            what = f"{row['case']} x{row['factor']:g}: {row['before']} -> {row['after']}"
            changed[row["number"]].append(what)
    return {
        f"{n.name} = {n.value}": {"cases": len(used[n.name]), "changed": changed[n.name]}
        for n in known
    }


def main() -> int:
    """Prints the table, or with --json one object."""
    parser = command_line(__doc__, quick="one case, two numbers")
    parser.add_argument("--into", type=Path, help="continue this file of rows")
    parser.add_argument("--rows", type=Path, help="print the table of this file; run nothing")
    parser.add_argument("--list", action="store_true", help="print the numbers; run nothing")
    parser.add_argument("--functions", action="store_true", help="print those entered in a call")
    parser.add_argument("--only", default="", help="names, or beginnings of names, of numbers")
    parser.add_argument("--cases", type=int, default=len(CASES), help="number of cases")
    options = parser.parse_args()
    only = tuple(filter(None, options.only.split(",")))
    known = [n for n in numbers() if not only or n.name.startswith(only)]
    if options.functions or options.list:
        listed = [*(f"{n.name} = {n.value}" for n in known), *outside()]
        calls = (functions_of(name) for name in ENTERED) if options.functions else ()
        lines = max(calls, key=len, default=listed)
        print("\n".join(lines), f"{len(lines)} in all", sep="\n")
        return 0
    rows = read_rows(options.rows or options.into)
    if options.rows is None:
        for name in CASES[: 1 if options.quick else options.cases]:
            done = {(row["case"], row["number"]) for row in rows}
            todo = [n for n in known if (name, n.name) not in done]
            for row in measure(name, todo[:2] if options.quick else todo):
                rows.append(row)
                if options.into is not None:
                    with options.into.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(row) + "\n")
    figures = table(rows, known)
    if not options.json:
        for name, about in figures.items():
            print(f"{name}: {about['cases']} cases, {len(about['changed'])} changed")
            print("".join(f"    {what}\n" for what in about["changed"]), end="")
    return print_results(figures, {}, as_json=options.json)


if __name__ == "__main__":
    raise SystemExit(main())
