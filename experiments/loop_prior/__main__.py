"""How alike are the costs of PIDF loops, and do the numbers `newton` knows foretell them?

Loops are drawn at random that have nothing to do with those of `experiments.sample_efficiency`:
plants of the first to the fifth order, with dead time and limits of the effort or without, each
with a cost of its own. The first trials of a search on each are held against what is known before
the first one: the numbers in `estune.tuners.loop_prior`, and the likeliest numbers that know
no parameter from another, which are fitted to these very loops. `--fit` fits all numbers to one
half of the loops and holds them against the other.
"""

import sys
from typing import Any

import numpy as np
from joblib import Parallel, delayed

from estune.tuners.loop_prior import PIDF_LOOP_PRIOR, CostPrior
from experiments.judged import at_least, command_line, tell
from experiments.loop_prior.fitting import fitted, isotropic, likelihood, mean_curvature
from experiments.loop_prior.loops import Loop, draw

FIRST_SEED = 10_000
"""The numbers were fitted to searches with seeds below."""

LOOPS, QUICK_LOOPS = 300, 30
STEPS = 80  # of a fit


def drawn(count: int, workers: int) -> list[Loop]:
    """So many loops, less those whose optimum lies at a bound."""
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    found = Parallel(n_jobs=workers)(delayed(draw)(seed) for seed in seeds)
    return [loop for loop in found if loop is not None]


def main() -> int:
    """Prints how well costs are foretold; returns 1 where experience is worth too little."""
    parser = command_line(__doc__, quick=f"{QUICK_LOOPS} loops")
    parser.add_argument("--loops", type=int, default=LOOPS, help="number of loops drawn")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--fit", action="store_true", help="fit all numbers; takes minutes")
    options = parser.parse_args()
    loops = drawn(QUICK_LOOPS if options.quick else options.loops, options.jobs)
    held = loops[len(loops) // 2 :] if options.fit else loops
    known = {"what newton knows": PIDF_LOOP_PRIOR, "no parameter from another": isotropic(held)}
    if options.fit:
        known["fitted to the other half"] = fitted(
            loops[: len(loops) // 2], PIDF_LOOP_PRIOR, STEPS
        )
    figures: dict[str, Any] = {name: likelihood(one, held) for name, one in known.items()}
    figures["loops"] = len(held)
    curvature = mean_curvature(loops)
    figures["mean curvature"] = curvature.tolist()
    if not options.json:
        print("logarithm of the likelihood of a trial's cost")
        for name in known:
            print(f"  {name:28s} {figures[name]:7.3f}")
        _show("mean curvature at the optimum, of log P, I, D and the filter", curvature)
        _show("the same as newton knows it", PIDF_LOOP_PRIOR.curvature)
        if options.fit:
            _show_all(known["fitted to the other half"])
    gained = figures["what newton knows"] - figures["no parameter from another"]
    reached = {"logarithm of the likelihood gained by experience": at_least(gained, 0.0)}
    return tell(figures, reached, as_json=options.json)


def _show_all(known: CostPrior) -> None:
    for name in ("slope", "bowl", "rest", "bend"):
        _show(name, getattr(known, name))
    print(f"rest_size {known.rest_size:.3f}")


def _show(title: str, matrix: Any) -> None:
    print(title)
    for row in np.asarray(matrix):
        print("  " + " ".join(f"{value:8.3f}" for value in row))


if __name__ == "__main__":
    sys.exit(main())
