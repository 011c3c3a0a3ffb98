"""One model-based search, its trials against the true constrained optimum, and its claim."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

import plants
from estune.core.gains import Gains
from estune.loop_model.claim import claim
from estune.loop_model.fitting import fit_loop
from estune.loop_model.prediction import StepTrial
from estune.loop_model.records import LoopRecord
from estune.tuners import Observation, SearchSpace
from estune.tuners.identified_loop import IdentifiedLoopTuner
from experiments.loop_claims.cases import LoopCase
from experiments.loop_claims.truth import TrueLoop, Truth
from experiments.sample_efficiency.problems import BOUNDS_FACTOR
from plants.simulation.noise import NoiseSource

TOLERANCE = 0.02
WITHIN = 0.05
"""Excess over the true constrained optimum that counts as having found it."""

REPEATS = 3
"""Trials of the initial gains and of the recommended ones, which the claim is made by, too."""

LIMITS_KEPT = (1.65, 0.06)
"""True Ms and overshoot up to which the limits of 1.6 and 5 % count as kept."""


class Searched(NamedTuple):
    """A search and its claim.

    Attributes:
        found: First trial after which the recommendation was within `WITHIN` of the constrained
            optimum, the limits kept; infinite if never.
        stays: First trial from which it stayed there.
        trials: Trials to its own stop.
        ended: Whether it stopped by itself.
        unsafe: Trials more than 1.5 times as costly as the initial gains.
        excess: Cost of the recommended gains at the stop over the constrained optimum, minus 1.
        gains: Those gains.
        at: What is true of them.
        claimed: Interval of Ms that is claimed; NaN where none is.
        misfit: rho near the recommended gains.
    """

    found: float
    stays: float
    trials: int
    ended: bool
    unsafe: int
    excess: float
    gains: Gains
    at: Truth
    claimed: tuple[float, float]
    misfit: float

    @property
    def kept(self) -> bool:
        """Whether the limits hold at the end."""
        return _kept(self.at)


def search(case: LoopCase, optimum: Truth, noise: float, seed: int, trials_max: int) -> Searched:
    """One model-based search with repeats of what it recommends."""
    plant, cost, step = case.plant, case.cost, case.plant.profile
    rate = plant.controller.sampling_Hz
    trial = StepTrial(plant.controller, cost, step.preload_N, step.shape(rate), step.samples(rate))
    true = TrueLoop(plant, cost)
    rng, run = np.random.default_rng(seed), _trials(case, seed)
    space = SearchSpace.around(case.start, BOUNDS_FACTOR)
    tuner = IdentifiedLoopTuner(space, trial)
    start_cost, first = run(case.start, 0)
    told = start_cost * math.exp(noise * rng.standard_normal())
    state = tuner.tell_start(tuner.start(), Observation(told, record=first))
    unsafe = settled = k = 0
    near: list[bool] = []
    while k < trials_max and settled < tuner.settled_trials:
        k += 1
        gains = space.gains(tuner.ask(state))
        eta, record = run(gains, k)
        unsafe += eta > 1.5 * start_cost
        noisy = eta * math.exp(noise * rng.standard_normal())
        censored = not eta < 3.0 * start_cost
        state = tuner.tell(state, Observation(noisy, censored, record=record))
        at = true.at(space.gains(tuner.recommend(state)))
        near.append(at.cost < (1.0 + WITHIN) * optimum.cost and _kept(at))
        estimate = tuner.convergence(state)
        left = math.inf if estimate is None else estimate.remaining_improvement
        settled = settled + 1 if left < TOLERANCE else 0
    gains = space.gains(tuner.recommend(state))
    at = true.at(gains)
    repeats = [run(gains, k + n)[1] for n in range(1, REPEATS + 1)]
    before = [run(case.start, trials_max + REPEATS + n)[1] for n in range(1, REPEATS + 1)]
    added = [record for record in [*before, *repeats] if record is not None]
    records = [*state.records, *added]
    claimed, misfit = (math.nan, math.nan), math.nan
    if records:
        last = state.fit
        fit = fit_loop(records, rate, cost.settling_time_s, last)
        made = claim(fit, records, trial, gains)
        misfit = made.misfit
        if made.margins:
            claimed = made.margins.sensitivity.low, made.margins.sensitivity.high
    stays = len(near) - near[::-1].index(False) + 1 if False in near else 1
    return Searched(
        found=near.index(True) + 1 if True in near else math.inf,
        stays=stays if near[-1] else math.inf,
        trials=k,
        ended=settled >= tuner.settled_trials,
        unsafe=unsafe,
        excess=at.cost / optimum.cost - 1.0,
        gains=gains,
        at=at,
        claimed=claimed,
        misfit=misfit,
    )


def _kept(at: Truth) -> bool:
    return not (at.sensitivity > LIMITS_KEPT[0] or at.overshoot > LIMITS_KEPT[1])


def _trials(case: LoopCase, seed: int) -> Callable[[Gains, int], tuple[float, LoopRecord | None]]:
    """A function that runs the trial of some gains with its number."""
    plant, step, source = case.plant, case.plant.profile, NoiseSource(seed)
    rate = plant.controller.sampling_Hz
    samples = step.samples(rate)

    def run(gains: Gains, number: int) -> tuple[float, LoopRecord | None]:
        noise = source.draw(number, samples, plant.noise_rms_N)
        r = plants.simulate(plant, gains, noise_N=noise)
        if r.diverged_at is not None:
            return math.inf, None
        columns = r.setpoint_N, r.tension_N, r.effort_N
        eta = float(case.cost.evaluate(rate, step.shape(rate), *columns))
        return eta, LoopRecord(r.effort_N, r.tension_N, r.setpoint_N, gains, at_rest=True)

    return run
