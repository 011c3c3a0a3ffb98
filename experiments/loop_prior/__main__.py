"""How alike are the costs of PIDF loops drawn at random, and how well does the prior predict one?

Command: `python -m experiments.loop_prior`.
Target: the prior predicts at least as well as an isotropic one fitted to the same loops.

The loops are independent of those of `experiments.sample_efficiency`: plants of first to fifth
order, with and without dead time and limits of the effort, each with a cost of its own. The first
trials of a search on each are compared with two priors: that of `estune.tuners.gaussian_process`,
and an isotropic one, fitted to these loops. `--fit` fits all numbers to one half of the loops and
evaluates them on the other.
"""

import sys
from typing import Any

import numpy as np
from joblib import Parallel, delayed

from estune.tuners.gaussian_process import PIDF_LOOP_PRIOR
from experiments.loop_prior.fitting import fitted, isotropic, likelihood, mean_curvature
from experiments.loop_prior.loops import RandomLoop, draw
from experiments.results import at_least, command_line, print_results

FIRST_SEED = 10_000
"""The prior was fitted to searches with seeds below."""

LOOPS, QUICK_LOOPS = 300, 5
STEPS = 80  # of a fit


def drawn(count: int, workers: int) -> list[RandomLoop]:
    """The given number of loops, less those with an optimum at a bound."""
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    loops = Parallel(n_jobs=workers)(delayed(draw)(seed) for seed in seeds)
    return [loop for loop in loops if loop is not None]


def main() -> int:
    """Prints the likelihoods; returns 1 if the prior is worse than the isotropic one."""
    parser = command_line(__doc__, quick=f"{QUICK_LOOPS} loops")
    parser.add_argument("--loops", type=int, default=LOOPS, help="number of loops drawn")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument(
        "--fit", action="store_true", help="fit all numbers, in minutes; see --json"
    )
    options = parser.parse_args()
    loops = drawn(QUICK_LOOPS if options.quick else options.loops, options.jobs)
    held = loops[len(loops) // 2 :] if options.fit else loops
    priors = {"safe_bayesian": PIDF_LOOP_PRIOR, "isotropic": isotropic(held)}
    if options.fit:
        priors["other half"] = fitted(loops[: len(loops) // 2], PIDF_LOOP_PRIOR, STEPS)
    figures: dict[str, Any] = {name: likelihood(prior, held) for name, prior in priors.items()}
    figures["loops"] = len(held)
    figures["curvature"] = {
        "mean at the optimum, of log P, I, D and the filter": mean_curvature(loops).tolist(),
        "of the prior": np.asarray(PIDF_LOOP_PRIOR.curvature).tolist(),
    }
    if options.fit:
        fit = priors["other half"]._asdict()
        figures["fit"] = {name: np.asarray(part).tolist() for name, part in fit.items()}
    gain = figures["safe_bayesian"] - figures["isotropic"]
    reached = {"log likelihood gained over the isotropic prior": at_least(gain, 0.0)}
    return print_results(figures, reached, as_json=options.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
