"""Does the interval of the improvement hold the true one, and what is claimed without a gain?

Command: `python -m experiments.confirmation`.
Target: coverage of 93 to 97 %, at most 5 % false claims, excess cost at the stop of 1 % in the
median and 5 % at worst.

Each run searches, stops by itself, and confirms by repeats; its summary is compared with
noise-free costs. On one problem it starts from weak gains, from optimal gains, on a rig whose cost
drifts up by a fifth during the run, or on one with one outlier in twenty trials; on every family
of `experiments.sample_efficiency` it starts from weak gains, at three levels of noise. The figures
are the coverage of the 95 % intervals of the improvement and of the optimal gains, the share of
false claims, and the excess cost of the final gains.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from statistics import fmean, median
from typing import Any

import numpy as np
from joblib import Parallel, delayed

from estune.core.gains import Gains
from estune.run.plan import TRIALS, Plan
from estune.run.planning import make_tuner
from estune.run.results.summary import summarise
from estune.run.session import after_trial, new_session, next_request
from estune.trial import Outcome
from experiments.results import Target, at_least, at_most, between, command_line, print_results
from experiments.sample_efficiency.optimum import optimum
from experiments.sample_efficiency.problems import PROBLEMS, Problem

PROBLEM = "8 Hz"
NOISE = 0.03
FAMILY_NOISES, FAMILY_TRIALS = (0.01, NOISE, 0.10), 200
TUNER = "safe_bayesian"  # it tunes by the cost alone, as no records are simulated here
DRIFT = 0.2
OUTLIER_SHARE, OUTLIER = 0.05, 1.5
FIRST_SEED = 5000
COVERED_LEAST, COVERED_MOST = 0.93, 0.97
FALSE_CLAIMS_MOST = 0.05
EXCESS_MEDIAN, EXCESS_WORST = 0.01, 0.05
SIGMAS = 3.09
"""Standard deviations exceeded to one side once in a thousand times."""

STREAMS = (PROBLEM, *(name for name in PROBLEMS if name != PROBLEM))
"""Problems in the order of their random numbers: equal ones would share the noise of repeats."""


@dataclass(frozen=True, slots=True)
class Situation:
    """The start of a run, its disturbances, and its greatest number of search trials."""

    name: str
    problem: str = PROBLEM
    noise: float = NOISE
    from_optimum: bool = False
    drift: float = 0.0
    outlier_share: float = 0.0
    trials: int = TRIALS


SITUATIONS = (
    Situation("weak start"),
    Situation("nothing to gain", from_optimum=True),
    Situation("drift", drift=DRIFT),
    Situation("spoilt trials", outlier_share=OUTLIER_SHARE),
)
PLAIN = ("weak start", "nothing to gain")
"""Situations with noise alone, for which the interval is valid."""

FAMILIES = tuple(
    Situation(f"families, {noise:.0%} noise", problem, noise, trials=FAMILY_TRIALS)
    for noise, problem in product(FAMILY_NOISES, PROBLEMS)
)


@dataclass(frozen=True, slots=True)
class RunClaim:
    """The claim of a run, and the true values.

    Attributes:
        situation: Name of the situation.
        searched: Number of search trials.
        trials: Number of all trials.
        by_itself: Whether the search converged before it had used all its trials.
        claimed: Whether the run claims an improvement.
        low: Lower end of its interval of the change; nan without one.
        high: Upper end.
        true: The noise-free change.
        excess: Noise-free cost of the final gains over that of the optimum, less one.
        gains_inside: Whether the optimum of each gain lies in its interval; empty without any.
    """

    situation: str
    searched: int
    trials: int
    by_itself: bool
    claimed: bool
    low: float
    high: float
    true: float
    excess: float
    gains_inside: tuple[bool, ...]

    @property
    def held(self) -> bool:
        """Whether the true change lies in the interval."""
        return self.low <= self.true <= self.high


def claim(situation: Situation, seed: int) -> RunClaim:
    """Runs one tuning to its summary."""
    problem = PROBLEMS[situation.problem]
    best = optimum(problem)
    start = Gains(*map(math.exp, best.coordinates)) if situation.from_optimum else problem.start
    tuner = make_tuner(TUNER, start, None)
    step, cost, trials = problem.plant.profile, problem.cost, situation.trials
    plan = Plan("run", tuner, start, step, cost, trials=trials)
    random = np.random.default_rng([seed, STREAMS.index(situation.problem)])
    factors = 1.0 + situation.noise * random.standard_normal(plan.max_trials)
    factors *= 1.0 + situation.drift * np.linspace(0.0, 1.0, plan.max_trials)
    factors[random.random(plan.max_trials) < situation.outlier_share] *= OUTLIER
    session = new_session(plan)
    while (request := next_request(session)) is not None:
        measured = _quiet(problem, request.gains) * float(factors[request.number])
        session = after_trial(session, Outcome.DONE, measured)
    summary, final = summarise(session), session.candidate or start
    intervals = zip(best.coordinates, summary.intervals, strict=False)
    return RunClaim(
        situation=situation.name,
        searched=session.search_trials,
        trials=session.number,
        by_itself=session.search_trials < plan.trials,
        claimed=summary.improved,
        low=math.nan if summary.change is None else summary.change.low,
        high=math.nan if summary.change is None else summary.change.high,
        true=_quiet(problem, final) / _quiet(problem, start) - 1.0,
        excess=_quiet(problem, summary.gains) / best.cost - 1.0,
        gains_inside=tuple(low <= math.exp(x) <= high for x, (_, low, high) in intervals),
    )


def _quiet(problem: Problem, gains: Gains) -> float:
    return float(problem.costs(np.log([gains.as_tuple()]))[0])


def figures_of(claims: Sequence[RunClaim]) -> dict[str, Any]:
    """The figures of some runs."""
    compared = [c for c in claims if not math.isnan(c.low)]
    inside = [each for c in claims for each in c.gains_inside]
    return {
        "runs": len(claims),
        "by_itself": fmean(c.by_itself for c in claims),
        "searched_median": median(c.searched for c in claims),
        "trials_median": median(c.trials for c in claims),
        "claimed": fmean(c.claimed for c in claims),
        "claimed_falsely": fmean(c.claimed and c.true >= 0.0 for c in claims),
        "covered": fmean(c.held for c in compared) if compared else None,
        "gains_covered": fmean(inside) if inside else None,
        "excess_median": median(c.excess for c in claims),
        "excess_worst": max(c.excess for c in claims),
    }


def targets(figures: dict[str, Any]) -> dict[str, Target]:
    """The targets."""
    plain, covered = figures["weak start"], figures["covered_by_noise_alone"]
    false = max(figures[s.name]["claimed_falsely"] for s in SITUATIONS)
    found = {
        "coverage of the 95 % interval, noise alone": between(
            covered, *_coverage(sum(figures[name]["runs"] for name in PLAIN))
        ),
        "improvements claimed where there is none, worst situation": at_most(
            false, FALSE_CLAIMS_MOST
        ),
        "excess at the stop from a weak start, median": at_most(
            plain["excess_median"], EXCESS_MEDIAN
        ),
        "excess at the stop from a weak start, worst": at_most(
            plain["excess_worst"], EXCESS_WORST
        ),
    }
    return found | _family_targets(figures)


def _coverage(runs: int) -> tuple[float, float]:
    """Least and largest coverage, with an allowance for the number of runs."""
    low, high = (
        SIGMAS * math.sqrt(covered * (1.0 - covered) / runs)
        for covered in (COVERED_LEAST, COVERED_MOST)
    )
    return COVERED_LEAST - low, COVERED_MOST + high


def _family_targets(figures: dict[str, Any]) -> dict[str, Target]:
    """Targets on all families.

    The gains of a run are not independent, so that its intervals count as one.
    """
    if "families" not in figures:
        return {}
    every, usual = figures["families"], figures[f"families, {NOISE:.0%} noise"]
    least, _ = _coverage(every["runs"])
    return {
        "excess at the stop on the families, median": at_most(
            usual["excess_median"], EXCESS_MEDIAN
        ),
        "coverage on the families, change": at_least(every["covered"], least),
        "coverage on the families, each gain": at_least(every["gains_covered"], least),
    }


def _runs(seeds: range, *, families: bool) -> Iterator[tuple[Situation, int]]:
    """The runs: all families together have about as many as one other situation."""
    yield from product(SITUATIONS, seeds)
    if families:
        yield from product(FAMILIES, seeds[: -(-len(seeds) // len(PROBLEMS))])


def main() -> int:
    """Runs, prints, and returns 1 if a target is missed."""
    parser = command_line(__doc__, quick="two runs of each situation, without the families")
    parser.add_argument("--runs", type=int, default=150, help="runs of each situation")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    options = parser.parse_args()
    seeds = range(FIRST_SEED, FIRST_SEED + (2 if options.quick else options.runs))
    runs = list(_runs(seeds, families=not options.quick))
    for name in {situation.problem for situation, _ in runs}:
        optimum(PROBLEMS[name])  # cached before the workers need it
    claims = Parallel(n_jobs=options.jobs)(delayed(claim)(*run) for run in runs)
    figures: dict[str, Any] = {
        name: figures_of([c for c in claims if c.situation == name])
        for name in dict.fromkeys(situation.name for situation, _ in runs)
    }
    if not options.quick:
        figures["families"] = figures_of([c for c in claims if c.situation.startswith("families")])
    plain = [c for c in claims if c.situation in PLAIN]
    figures["covered_by_noise_alone"] = figures_of(plain)["covered"]
    return print_results(figures, targets(figures), as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
