"""Weights of the evidence by which `suggest` names a cause.

Command: `python -m experiments.service_records.cause_weights`.
Target: none; it prints `estune/service_records/cause/weights.py`, in about four minutes of CPU.

Two ridge-penalised logistic regressions on simulated loops of known cause: that of sticking on
loops of a textbook (`loops`) and of a plant (`plant_loops`), that of the others on the former.
Seeds are development.
"""

import inspect
import itertools
import sys
import textwrap
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from estune.service_records.cause import weights
from estune.service_records.cause.evidence import evidence
from estune.service_records.cause.loop_signals import JudgedSignals
from estune.service_records.cause.probability import FARTHEST, other_terms, sticking_terms
from experiments.results import command_line
from experiments.service_records import loops, plant_loops
from experiments.service_records.loops import DrawnLog

RIDGE = 1.0
"""Penalty of the squares of the weights: of 1 and 3 the likelier on seeds that were left out."""

TEXTBOOK, PLANT = 300, 1000
"""First seeds of either kind of loops."""

OTHERS = ("tuning", "outside", "none")


class Loops(NamedTuple):
    """Evidence of simulated loops.

    Attributes:
        numbers: Shape (loops, numbers).
        causes: What is wrong with each, shape (loops,).
    """

    numbers: FloatArray
    causes: NDArray[np.str_]


def drawn(draw: Callable[[int, str], DrawnLog], seeds: Iterable[int]) -> Loops:
    """Loops of each cause but a sensor's, which is told by its laws."""
    numbers, causes = list[FloatArray](), list[str]()
    for seed, cause in itertools.product(seeds, plant_loops.CAUSES):
        log = draw(seed, cause)
        with np.errstate(all="ignore"):
            found = evidence(JudgedSignals(log.setpoint, log.measurement, log.output, 1.0))
        if not found.faults:
            numbers.append(found.numbers)
            causes.append(cause)
    return Loops(np.array(numbers), np.array(causes))


def logistic(terms: FloatArray, classes: FloatArray, count: int) -> tuple[FloatArray, ...]:
    """Means and deviations of the terms, constants (count,) and slopes (count, terms)."""
    from scipy.optimize import minimize  # noqa: PLC0415  slow to import

    mean, deviation = terms.mean(axis=0), terms.std(axis=0) + 1e-9
    away = np.clip((terms - mean) / deviation, -FARTHEST, FARTHEST)
    design = np.column_stack([np.ones(len(away)), away])
    wanted = np.eye(count)[classes]

    def loss(flat: FloatArray) -> tuple[float, FloatArray]:
        weights = flat.reshape(design.shape[1], count)
        score = design @ weights
        score -= score.max(axis=1, keepdims=True)
        log_share = score - np.log(np.exp(score).sum(axis=1, keepdims=True))
        slope = design.T @ (np.exp(log_share) - wanted)
        slope[1:] += RIDGE * weights[1:]
        penalty = 0.5 * RIDGE * float((weights[1:] ** 2).sum())
        return penalty - float((wanted * log_share).sum()), slope.ravel()

    found = minimize(loss, np.zeros(design.shape[1] * count), jac=True, method="L-BFGS-B")
    weights = found.x.reshape(design.shape[1], count).T
    return mean, deviation, weights[:, 0], weights[:, 1:]


def fitted(textbook: Loops, plant: Loops) -> dict[str, tuple[FloatArray, ...]]:
    """Both regressions."""
    both = np.concatenate([textbook.numbers, plant.numbers])
    sticks = np.concatenate([textbook.causes, plant.causes]) == "sticking"
    other = textbook.causes != "sticking"
    classes = np.array([OTHERS.index(name) for name in textbook.causes[other].tolist()])
    return {
        "STICKING": logistic(sticking_terms(both), sticks.astype(int), 2),
        "OTHERS": logistic(other_terms(textbook.numbers[other]), classes, 3),
    }


def text(name: str, found: tuple[FloatArray, ...]) -> str:
    """A regression as the lines of a module, the first class without weights."""
    mean, deviation, constant, slopes = found
    fields = {"mean": mean, "deviation": deviation, "constant": constant[1:] - constant[0]}
    lines = [f"{name} = Weights("]
    for field, x in fields.items():
        lines += [f"    {field}=(", _wrapped(x, 8), "    ),"]
    lines += ["    slopes=("]
    for row in slopes[1:] - slopes[0]:
        lines += ["        (", _wrapped(row, 12), "        ),"]
    return "\n".join([*lines, "    ),", ")"])


def _wrapped(x: FloatArray, indent: int) -> str:
    numbers = ", ".join(f"{value:.4g}" for value in x.tolist()) + ","
    return textwrap.indent(textwrap.fill(numbers, 99 - indent), " " * indent)


def main() -> int:
    """Prints the module."""
    parser = command_line(__doc__, quick="eight seeds of a textbook's loops, five of a plant's")
    parser.add_argument("--loops", type=int, default=240, help="a textbook's loops of each cause")
    options = parser.parse_args()
    count = 8 if options.quick else options.loops
    textbook = drawn(loops.draw, range(TEXTBOOK, TEXTBOOK + count))
    plant = drawn(plant_loops.draw, range(PLANT, PLANT + 2 * count // 3))
    head = inspect.getsource(weights).partition("STICKING = ")[0].rstrip()
    print(head)
    print(*(text(name, one) for name, one in fitted(textbook, plant).items()), sep="\n\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
