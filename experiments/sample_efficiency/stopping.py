"""Complete runs with stopping rule and confirmation: remaining excess and claimed improvement.

The session of a tuning is driven as by `estune tune`, with computed costs in place of trials.
"""

import math
from dataclasses import dataclass

import numpy as np

from estune.run.plan import Plan
from estune.run.planning import make_tuner
from estune.run.session import after_trial, new_session, next_request
from estune.run.summary import summarise
from estune.trial import Outcome
from experiments.sample_efficiency.optimum import optimum
from experiments.sample_efficiency.problems import PROBLEMS

TRIALS = 200
"""Greatest number of search trials."""


@dataclass(frozen=True, slots=True)
class StoppedRun:
    """A completed run.

    Attributes:
        problem: Name of the problem.
        noise: Relative standard deviation of a trial's cost.
        seed: Of the noise.
        searched: Number of search trials.
        trials: Number of all trials.
        by_itself: Whether the search converged before it had used all its trials.
        excess: Noise-free cost of the final gains over that of the optimum, less one.
        improved: Whether the run claims an improvement.
        change_inside: Whether the true change of the cost lies in its interval; None without one.
        gains_inside: Whether the optimum of each gain lies in its interval; empty without any.
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
    """Runs a tuning on a problem from its weak gains to its summary."""
    problem = PROBLEMS[name]
    tuner = make_tuner(tuner_name, problem.start, None)
    plan = Plan("run", tuner, problem.start, problem.plant.profile, problem.cost, trials=TRIALS)
    # A key for each problem, or runs of equal length would share the noise of their repeats.
    key = [seed, list(PROBLEMS).index(name)]
    random = np.random.Generator(np.random.Philox(key=key))
    draws = 1.0 + noise * random.standard_normal(plan.max_trials)
    session = new_session(plan)
    while (request := next_request(session)) is not None:
        quiet = float(problem.costs(np.log([request.gains.as_tuple()]))[0])
        session = after_trial(session, Outcome.DONE, quiet * float(draws[request.number]))
    summary, best = summarise(session), optimum(problem)
    ended = np.log([summary.gains.as_tuple(), problem.start.as_tuple()])
    costs = problem.costs(ended)
    change_inside = None
    if summary.change is not None and session.candidate is not None:
        after = problem.costs(np.log([session.candidate.as_tuple()]))[0]
        change_inside = summary.change.low <= after / costs[1] - 1.0 <= summary.change.high
    inside = zip(best.coordinates, summary.intervals, strict=False)
    return StoppedRun(
        problem=name,
        noise=noise,
        seed=seed,
        searched=session.search_trials,
        trials=session.number,
        by_itself=session.search_trials < TRIALS,
        excess=float(costs[0]) / best.cost - 1.0,
        improved=summary.improved,
        change_inside=None if change_inside is None else bool(change_inside),
        gains_inside=tuple(low <= math.exp(x) <= high for x, (_, low, high) in inside),
    )
