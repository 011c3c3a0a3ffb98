"""What time does each physical effect cost, and how does it change the step response?

Every effect alone and all together, with their usual parameters, beside the bare reel. The time of
a trial is relative to that of the bare reel, both timed alternately on one core. The change is the
rms difference between step responses without noise: one up to nearly the greatest tension, one
down to nearly slack. All effects together are timed in `plants.simulate`, in a batch with noise
and cost function, and in the compiled call alone.
"""

from typing import Any

import numpy as np

import plants
from estune.core import pidf
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.trial.profiles import StepProfile
from experiments.benchmark_trials import Timed, alternate
from experiments.results import at_most, command_line, print_results
from plants.effects import EFFECTS, Effect
from plants.models.reel import Reel
from plants.simulation.batch import divergence_limit_N
from plants.simulation.plant import drive_of

GAINS = Gains(P=1.2, I=50.0, D=0.02, setpoint_filter_s=0.004)
BARE = plants.reference_reel()
UP = StepProfile(preload_N=15.0, step_N=20.0, step_at_s=0.2, duration_s=1.0)
DOWN = StepProfile(preload_N=15.0, step_N=-14.0, step_at_s=0.2, duration_s=1.0)
MOST_TIMES_BARE = 5.0


def with_all() -> Reel:
    """The reel with every effect of the package."""
    reel = BARE
    for effect in EFFECTS.values():
        reel = reel + effect()
    return reel


def costs(rounds: int) -> dict[str, float]:
    """Time of a trial with each effect relative to the bare reel, by slug."""
    timed = {"": timed_simulation(BARE)}
    timed |= {name: timed_simulation(BARE + effect()) for name, effect in EFFECTS.items()}
    times = alternate(timed, rounds)
    return {name: times[name] / times[""] for name in EFFECTS}


def timed_simulation(reel: Reel) -> Timed:
    """Ten trials with `plants.simulate`."""
    return Timed(lambda: plants.simulate(reel, GAINS), blocks=10)


def all_at_once(rounds: int, trials: int) -> dict[str, float]:
    """Time with all effects relative to the bare reel, for three ways to run a trial."""
    table, row = np.tile(GAINS.as_tuple(), (trials, 1)), pidf.coefficients(BARE.controller, GAINS)
    coefficients, profile, everything = np.array([row]), BARE.profile, with_all()

    def batch(reel: Reel) -> Timed:
        cost = StepCost(settling_time_s=0.13)
        return Timed(lambda: plants.batch_costs(reel, table, None, cost, seed=1, workers=1))

    def alone(reel: Reel) -> Timed:
        limit, drive = divergence_limit_N(profile), drive_of(profile, reel.sampling_Hz)
        return Timed(lambda: reel.respond(coefficients, drive, None, limit), blocks=10)

    ratios = {}
    for name, timed in (("", timed_simulation), ("_batch", batch), ("_compiled_call", alone)):
        times = alternate({"bare": timed(BARE), "all": timed(everything)}, rounds)
        ratios[f"all_times_bare{name}"] = times["all"] / times["bare"]
    return ratios


def change(effect: Effect, profile: StepProfile) -> float:
    """Rms change of a step response by the effect, N."""
    bare, changed = (plants.simulate(reel, GAINS, profile) for reel in (BARE, BARE + effect))
    if changed.diverged_at is not None:
        return float("inf")
    return float(np.sqrt(np.mean((changed.tension_N - bare.tension_N) ** 2)))


def measure(rounds: int, trials: int) -> dict[str, Any]:
    """All figures by name."""
    ratios = costs(rounds)
    return all_at_once(rounds, trials) | {
        "effects": {
            name: {
                "port": effect.port.value,
                "times_bare": ratios[name],
                "change_of_step_up_N": change(effect(), UP),
                "change_of_step_down_N": change(effect(), DOWN),
            }
            for name, effect in EFFECTS.items()
        }
    }


def main() -> int:
    """Measures and prints; the exit code tells whether every target was met."""
    options = command_line(__doc__, quick="fewer repeats").parse_args()
    figures = measure(*((8, 200) if options.quick else (40, 1000)))
    targets = {
        name: at_most(figures[name], MOST_TIMES_BARE)
        for name in ("all_times_bare", "all_times_bare_batch")
    }
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
