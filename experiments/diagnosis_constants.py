"""How do verdicts and intervals of a diagnosis change with each number that decides it?

Command: `python -m experiments.diagnosis_constants`.
Target: none; a table for each number.

Each number of `plants.diagnosis.constants` is changed alone. Verdicts are worked out again
from the fits that `experiments.hidden_effects` stored (`--rows`); without such a file cases of the
validation block are diagnosed first. Intervals are worked out again from models that are right of
machines with one effect. Numbers that are found in the noise are tried on machines with mains
interference and coarse readings, and on sound ones.
"""

import json
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple
from unittest import mock

import plants
from experiments import hidden_machines
from experiments.hidden_effects import FIRST_SEED, OUT, tasks
from experiments.hidden_scores import DiagnosisTask, Row, diagnose, measurement, model
from experiments.results import command_line, print_results
from plants.diagnosis.constants import CONSTANTS, Constants
from plants.diagnosis.data import noise_floor
from plants.diagnosis.pipeline import intervals as interval_step
from plants.diagnosis.search import decide, intervals, mains_interference
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.effects import EFFECTS

DECIDING = {
    "nothing": (1.1, 1.3, 1.6, 2.0, 2.5),
    "floor": (1.0, 1.15, 1.3, 1.45, 1.6),
    "one_more": (0.4, 0.5, 0.6, 0.7, 0.8),
    "named_share": (0.6, 0.7, 0.8, 0.9, 0.95),
    "above_noise": (1.5, 2.0, 3.0, 4.0, 6.0),
    "tied": (0.05, 0.15, 0.3, 0.4, 0.5),
    "effective": (10.0, 20.0, 60.0, 200.0, 1000.0),
    "form": (0.0, 0.02, 0.05, 0.1, 0.2),
}
"""Numbers whose curve takes stored fits: verdicts and probabilities."""
WIDENING = {
    "form_least": (0.0, 0.0005, 0.001, 0.0025, 0.005),
    "form_taken_up": (0.0, 0.1, 0.2, 0.3, 0.4),
}
"""Those whose curve takes models that are right: intervals."""
IN_NOISE = {
    "above_noise": (1.0, 2.0, 3.0, 5.0, 8.0),
    "clear": (2.5, 4.0, 5.0, 8.0, 12.0),
    "shown": (0.1, 0.2, 0.3, 0.5, 1.0),
}
"""Numbers whose curve takes new base fits."""
CASES, NOISE_CASES, RIGHT_CASES = 100, 12, 60


class Point(NamedTuple):
    """Rates at one value of a number, in two kinds that pull either way."""

    value: float
    good: float
    bad: float


def again(rows: Iterable[Row], c: Constants) -> tuple[float, float]:
    """Shares of visible fitted effects with the right name, and of all cases with a wrong one."""
    right, wrong, visible, number = 0, 0, 0, 0
    for row in rows:
        if not row.models:
            continue
        with mock.patch.object(decide, "CONSTANTS", c):
            decision = decide.decide(row.models[0], row.models[1:])
        accepted = [frozenset(names) for names in row.accepted]
        named = decision.verdict in ("named", "incomplete")
        families = {hidden_machines.family(n) for names in accepted for n in names}
        wrong += not {hidden_machines.family(n) for n in decision.best} <= families
        number += 1
        known = [EFFECTS[n] for n in row.truth if n in EFFECTS]
        fitted = not any(e.in_noise or e.base_parameter for e in known)
        if row.truth and row.in_catalogue and row.visible and fitted:
            visible += 1
            right += named and decision.best in accepted
    return right / max(visible, 1), wrong / max(number, 1)


def confidence(rows: Iterable[Row], c: Constants) -> tuple[float, float]:
    """Mean probability of the models believed where they are right, and where they are not."""
    sums = {True: [0.0, 0.0], False: [0.0, 0.0]}
    for row in rows:
        decision = decide.decide(row.models[0], row.models[1:]) if row.models else None
        if decision is None or not decision.best:
            continue
        with mock.patch.object(decide, "CONSTANTS", c):
            p = decide.probabilities(row.models[0], row.models[1:])
        there = sums[decision.best in [frozenset(names) for names in row.accepted]]
        there[0] += p[decision.best]
        there[1] += 1.0
    return tuple(total / max(number, 1.0) for total, number in sums.values())  # type: ignore[return-value]


class RightModel(NamedTuple):
    """A model that was rightly believed, and the true values of what it fits, by name."""

    fits: tuple[ModelFitter, CandidateFit, CandidateFit]
    true: dict[str, float]


def right_models(cases: int) -> list[RightModel]:
    """The models believed of machines with one effect, where they are right."""
    found = []
    for n in range(cases):
        case, secret = hidden_machines.draw(FIRST_SEED + n, "plain")
        records = [measurement(record) for record in case.records]
        with mock.patch.object(
            interval_step, "fitted_intervals", wraps=intervals.intervals
        ) as last:
            answer = plants.explain(model(case), records)
        if tuple(sorted(e.name for e in answer.effects)) in secret.accepted:
            own = {f"{e}.{n}": v for e, of in secret.parameters.items() for n, v in of.items()}
            found.append(RightModel(last.call_args.args, own | secret.calibrations))
    return found


def coverage(models: Sequence[RightModel], c: Constants) -> tuple[float, float]:
    """Share of intervals that hold the truth, and their median relative half width."""
    held, widths = [], []
    with mock.patch.object(intervals, "CONSTANTS", c):
        for one in models:
            stated = intervals.intervals(*one.fits)
            for name in stated.keys() & one.true.keys():
                low, high = stated[name].low, stated[name].high
                held.append(low <= one.true[name] <= high)
                widths.append(0.5 * (high - low) / max(abs(stated[name].value), 1e-300))
    return sum(held) / max(len(held), 1), median(widths) if widths else math.nan


def in_noise(cases: int, c: Constants) -> tuple[float, float]:
    """Shares of noisy machines found and of sound ones blamed, no other effect declared."""
    names = ("mains_interference", "quantisation")
    found, blamed = 0, 0
    with (
        mock.patch.object(mains_interference, "CONSTANTS", c),
        mock.patch.object(noise_floor, "CONSTANTS", c),
    ):
        for n in range(cases):
            for name in (*names, "none"):
                case, _ = hidden_machines.draw(FIRST_SEED + n, "plain", name)
                records = [measurement(record) for record in case.records]
                answer = plants.explain(model(case), records, effects=names)
                slugs = {effect.name for effect in answer.effects}
                found += name in slugs
                blamed += name == "none" and bool(slugs)
    return found / (2.0 * cases), blamed / cases


def with_value(name: str, value: Any) -> Constants:
    """The table with another value of one number."""
    return CONSTANTS._replace(**{name: value})


def curve(
    name: str, values: Sequence[float], rates: Callable[[Constants], tuple[float, float]]
) -> list[Point]:
    """Rates over the values of one number."""
    return [Point(v, *rates(with_value(name, v))) for v in values]


def main() -> int:
    """Prints the curves."""
    parser = command_line(__doc__, quick="6 cases, two with noise")
    parser.add_argument("--rows", type=Path, default=OUT / "hidden_effects.jsonl")
    options = parser.parse_args()
    if options.rows.exists() and not options.quick:
        lines = options.rows.read_text(encoding="utf-8").splitlines()
        rows = [Row.from_json(json.loads(line)) for line in lines]
    else:
        todo: list[DiagnosisTask] = tasks(CASES, FIRST_SEED)
        rows = [diagnose(task) for task in (todo[:6] if options.quick else todo)]
    right = right_models(1 if options.quick else RIGHT_CASES)
    noisy = 1 if options.quick else NOISE_CASES
    curves = {
        **{n: curve(n, v, lambda c: again(rows, c)) for n, v in DECIDING.items()},
        **{
            f"{n}: probability": curve(n, DECIDING[n], lambda c: confidence(rows, c))
            for n in ("effective", "form")
        },
        **{n: curve(n, v, lambda c: coverage(right, c)) for n, v in WIDENING.items()},
        **{
            f"{n}: in noise": curve(
                n, v[1:4] if options.quick else v, lambda c: in_noise(noisy, c)
            )
            for n, v in IN_NOISE.items()
        },
    }
    figures = {
        f"{name} (in use: {getattr(CONSTANTS, name.partition(':')[0]):g})": [
            p._asdict() for p in points
        ]
        for name, points in curves.items()
    }
    return print_results(figures, {}, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
