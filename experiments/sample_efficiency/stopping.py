"""Whole runs by their own stop rule and confirmation: what is left to gain, and what is claimed.

The session of a tuning is driven here as it is by `estune tune`, with costs for trials.
"""

import math
from dataclasses import dataclass

import numpy as np

from estune.run.plan import make_tuner
from estune.run.session import Plan, after_trial, new_session, next_request
from estune.run.summary import summarise
from estune.trial import Outcome
from experiments.sample_efficiency.optimum import optimum
from experiments.sample_efficiency.problems import PROBLEMS

TRIALS = 200
"""Search trials after which a run ends that has not stopped by itself."""


@dataclass(frozen=True, slots=True)
class StoppedRun:
    """A run that came to its end.

    Attributes:
        problem: Name of the problem.
        noise: Relative standard deviation of a trial's cost.
        seed: Of the noise.
        searched: Search trials made.
        trials: All trials of the run.
        by_itself: Whether the search ended before it had used all its trials.
        excess: Cost of the gains it ended with over that of the optimum, less one; no noise.
        improved: Whether it claims an improvement.
        change_inside: Whether the true change of the cost lies in the interval given for it; None
            where none was given.
        gains_inside: The same of the optimum of each gain; empty where no intervals were given.
    """

    problem: str
    noise: float
    seed: int
    searched: int
    trials: int
    by_itself: bool
    excess: float
    improved: bool
    change_inside: bool | None
    gains_inside: tuple[bool, ...]


def stopped_run(name: str, tuner_name: str, noise: float, seed: int) -> StoppedRun:
    """Runs a tuning on a problem from its weak gains to its verdict."""
    problem = PROBLEMS[name]
    tuner = make_tuner(tuner_name, problem.start, None)
    plan = Plan("run", tuner, problem.start, problem.plant.profile, problem.cost, trials=TRIALS)
    # Of each problem its own: runs that end after as many trials would else share their repeats.
    key = [seed, list(PROBLEMS).index(name)]
    random = np.random.Generator(np.random.Philox(key=key))
    draws = 1.0 + noise * random.standard_normal(plan.most_trials)
    session = new_session(plan)
    while (request := next_request(session)) is not None:
        quiet = float(problem.costs(np.log([request.gains.as_tuple()]))[0])
        session = after_trial(session, Outcome.DONE, quiet * float(draws[request.number]))
    found, best = summarise(session), optimum(problem)
    ended = np.log([found.gains.as_tuple(), problem.start.as_tuple()])
    costs = problem.costs(ended)
    change_inside = None
    if found.change is not None and session.candidate is not None:
        after = problem.costs(np.log([session.candidate.as_tuple()]))[0]
        change_inside = found.change.low <= after / costs[1] - 1.0 <= found.change.high
    inside = zip(best.coordinates, found.intervals, strict=False)
    return StoppedRun(
        problem=name,
        noise=noise,
        seed=seed,
        searched=session.searched,
        trials=session.number,
        by_itself=session.searched < TRIALS,
        excess=float(costs[0]) / best.cost - 1.0,
        improved=found.improved,
        change_inside=None if change_inside is None else bool(change_inside),
        gains_inside=tuple(low <= math.exp(x) <= high for x, (_, low, high) in inside),
    )
