"""Do the margins claimed from the records of a search hold, and where are they claimed?

Model-based searches run on plants within the class of the identified loop (second order with dead
time, reels) and outside it (friction, backlash, ripple, stiffening). After the search four trials
repeat the recommended gains. Then the claim is compared with the margins of the plant's own linear
part, which the search does not know.
"""

import math
import sys
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import plants
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.margins import SampledPlant, controller_response
from estune.interop import sampled_model
from estune.loop_model.claim import TRIALS_MIN, claim
from estune.loop_model.identification import LoopRecord, fit_loop
from estune.loop_model.prediction import StepTrial
from estune.tuners import Observation
from estune.tuners.identified_loop import IdentifiedLoopTuner
from experiments.results import (
    Target,
    at_least,
    at_most,
    command_line,
    print_results,
    print_tables,
)
from experiments.sample_efficiency.problems import PROBLEMS, WEAK_ON_A_REEL
from plants.effects import (
    Backlash,
    CableStiffening,
    CoulombFriction,
    EyeletFriction,
    TorqueRipple,
)
from plants.simulation.noise import NoiseSource
from plants.simulation.plant import Plant

TRIALS_MAX = 20
IMPROVEMENT_LEFT = 0.03
COST_NOISE = 0.03
RECORD_NOISE = 0.004
"""Noise of plants that have none of their own, as a share of the step."""

OUTSIDE: dict[str, Callable[[], Plant]] = {
    "Coulomb 0.005 N m": partial(lambda e: plants.reference_reel() + e, CoulombFriction(0.005)),
    "Coulomb 0.02 N m": partial(lambda e: plants.reference_reel() + e, CoulombFriction(0.02)),
    "Coulomb 0.05 N m": partial(lambda e: plants.reference_reel() + e, CoulombFriction(0.05)),
    "eyelet 0.93": partial(lambda e: plants.reference_reel() + e, EyeletFriction(0.93)),
    "backlash": partial(lambda e: plants.reference_reel() + e, Backlash()),
    "torque ripple": partial(lambda e: plants.reference_reel() + e, TorqueRipple()),
    "stiffening": partial(lambda e: plants.reference_reel() + e, CableStiffening()),
}
"""Plants outside the class of the identified loop, each with its effect at the usual size."""


class Searched(NamedTuple):
    """A search and its claim.

    Attributes:
        trials: Search trials.
        unsafe: Trials more than 1.5 times as costly as the initial gains.
        claimed: Upper end of the interval of Ms that is claimed; NaN where none is.
        true: Ms of the plant's own linear part.
        misfit: rho near the recommended gains.
    """

    trials: int
    unsafe: int
    claimed: float
    true: float
    misfit: float


def search(plant: Plant, cost: StepCost, start: Gains, seed: int) -> Searched:
    """One model-based search with repeats of what it recommends."""
    step, controller = plant.profile, plant.controller
    rate = controller.sampling_Hz
    index, samples = step.step_index(rate), step.samples(rate)
    trial = StepTrial(controller, cost, step.preload_N, step.step_N, index, samples)
    rng, noise = np.random.default_rng(seed), NoiseSource(seed)
    rms_N = plant.noise_rms_N or RECORD_NOISE * abs(step.step_N)

    def run(gains: Gains, number: int) -> tuple[float, LoopRecord | None]:
        r = plants.simulate(plant, gains, noise_N=noise.draw(number, samples, rms_N))
        if r.diverged_at is not None:
            return math.inf, None
        columns = r.setpoint_N, r.tension_N, r.effort_N
        eta = float(cost.evaluate(rate, index, step.step_N, *columns))
        return eta, LoopRecord(r.effort_N, r.tension_N, step.step_N, index)

    space = PROBLEMS["8 Hz"].space(start)
    tuner = IdentifiedLoopTuner(space, trial)
    state, limit = tuner.start(), 3.0 * run(start, 0)[0]
    unsafe = settled = k = 0
    tried: list[Gains] = []
    while k < TRIALS_MAX and settled < tuner.settled_trials:
        k += 1
        gains = space.gains(tuner.ask(state))
        eta, record = run(gains, k)
        unsafe += eta > 0.5 * limit
        noisy = eta * (1.0 + COST_NOISE * rng.standard_normal())
        censored = not eta < limit
        state = tuner.tell(state, Observation(noisy, censored, record=record))
        if not censored:
            tried.append(gains)
        estimate = tuner.convergence(state)
        left = math.inf if estimate is None else estimate.remaining_improvement
        settled = settled + 1 if left < IMPROVEMENT_LEFT else 0
    gains = space.gains(tuner.recommend(state))
    repeats = [run(gains, k + n)[1] for n in range(1, TRIALS_MIN + 1)]
    stable = [record for record in repeats if record is not None]
    records, tried = [*state.records, *stable], [*tried, *[gains] * len(stable)]
    fit = fit_loop(records, rate, cost.settling_time_s, state.fit.model if state.fit else None)
    made = claim(fit, trial, gains, tried[-len(records) :])
    claimed = made.margins.sensitivity.high if made.margins else math.nan
    return Searched(k, unsafe, claimed, true_sensitivity(plant, gains), made.misfit)


def true_sensitivity(plant: Plant, gains: Gains) -> float:
    """Ms of the loop with the plant's own linear model, on a dense grid; NaN without a model."""
    model = plant.describe("plant", gains).linear_model
    if model is None:
        return math.nan
    sampled: SampledPlant = sampled_model(model, plant.controller)
    theta = np.linspace(1e-4, math.pi, 50_000)
    loop = controller_response(gains, plant.controller, theta) * sampled.response(theta)
    return float(np.max(1.0 / np.abs(1.0 + loop)))


def measure(seeds: int, thin: int) -> list[dict[str, Any]]:
    """A row per plant, or for every `thin`-th of them."""
    reel_cost = PROBLEMS["friction"].cost
    cases = [
        *((n, p.build, p.cost, p.start, True) for n, p in PROBLEMS.items() if n != "friction"),
        *((n, build, reel_cost, WEAK_ON_A_REEL, False) for n, build in OUTSIDE.items()),
    ]
    rows: list[dict[str, Any]] = []
    for name, build, cost, start, inside in cases[::thin]:
        plant = build()
        found = [search(plant, cost, start, seed) for seed in range(1000, 1000 + seeds)]
        made = [one for one in found if not math.isnan(one.claimed)]
        row: dict[str, Any] = {
            "plant": name,
            "inside": inside,
            "seeds": seeds,
            "trials": float(np.median([one.trials for one in found])),
            "unsafe": max(one.unsafe for one in found),
            "claims": len(made) / len(found),
            "worst": max((one.true / one.claimed for one in made), default=math.nan),
            "misfit": float(np.nanmedian([one.misfit for one in found])),
        }
        rows.append(row)
        print(
            f"{name:20} {row['trials']:7.0f} {row['unsafe']:7d} {row['claims']:9.0%} "
            f"{row['worst']:10.3f} {row['misfit']:9.2%}",
            flush=True,
        )
    return rows


def main() -> int:
    """Prints the table, or with --json one object; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="one search instead of ten, a third of the plants")
    options = parser.parse_args()
    if not options.json:
        heads = f"{'trials':>7} {'unsafe':>7} {'claimed':>9} {'true/claim':>10} {'rho':>9}"
        print(f"{'plant':20} {heads}")
    with print_tables(hidden=options.json):
        rows = measure(1, 3) if options.quick else measure(10, 1)
    inside = [row for row in rows if row["inside"]]
    worst = [row["worst"] for row in rows if not math.isnan(row["worst"])]
    targets: dict[str, Target] = {
        "median_trials": at_most(float(np.median([row["trials"] for row in inside])), 12.0),
        "unsafe_in_a_search": at_most(max(row["unsafe"] for row in rows), 1.0),
        "claimed_inside": at_least(float(np.mean([row["claims"] for row in inside])), 0.9),
        "broken_claim": at_most(max(worst, default=math.nan), 1.1),
    }
    return print_results({"rows": rows}, targets, as_json=options.json)


if __name__ == "__main__":
    sys.exit(main())
