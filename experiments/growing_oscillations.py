"""Which unstable loops does a single trial show, and which stable ones does it call unstable?

Command: `python -m experiments.growing_oscillations`.
Target: 80 % of the trials of unstable loops named, none of the stable ones.

Trials of loops drawn at random, of two to four lags or of one lag and a lightly damped mode behind
it, with gains drawn far to both sides of the stability limit. The truth is that of the sampled
loop. The constants of `estune.core.oscillation` were chosen on seed 1, and seed 100 was looked at;
seed 200 was run once, after that, and is development from then on.
"""

from collections.abc import Iterator

import control
import numpy as np

import plants
from estune.core.gains import Gains
from estune.core.margins import is_stable
from estune.trial import TrialRequest
from estune.trial.profiles import StepProfile
from estune.trial.scoring import growing_oscillation_Hz
from experiments.results import at_least, at_most, command_line, print_results
from plants.models.linear_plant import LinearPlant

TRIALS = 3
"""Trials of each loop."""

CENTRE, SPREAD = (-0.7, 1.5, -5.0, -3.5), (1.0, 1.0, 1.2, 0.7)
"""Logarithms of the gains that are drawn: mean and standard deviation."""


def random_loop(rng: np.random.Generator, *, mode: bool) -> LinearPlant:
    """A plant of lags, or of one lag in series with a lightly damped mode."""
    transfer = control.tf([1.0], [1.0])
    for lag in [rng.uniform(0.02, 0.2)] if mode else rng.uniform(0.01, 0.2, rng.integers(2, 5)):
        transfer *= control.tf([1.0], [float(lag), 1.0])
    if mode:
        w, damping = 2.0 * np.pi * rng.uniform(5.0, 25.0), rng.uniform(0.005, 0.05)
        transfer *= control.tf([w * w], [1.0, 2.0 * damping * w, w * w])
    return plants.linear_plant(
        transfer,
        dead_time_s=float(rng.choice([0.0, 0.01, 0.05])),
        sampling_Hz=float(rng.choice([200.0, 632.0])),
        gains=Gains(0.1, 3.0, 0.001, 0.02),
        noise_rms_N=float(rng.choice([0.0, 0.003, 0.03])),
        profile=StepProfile(0.0, 1.0, 0.2, 1.4),
        settling_time_s=0.3,
    )


def trials(loops: int, seed: int) -> Iterator[tuple[bool, bool]]:
    """Of each trial that did not diverge: whether its loop is stable, whether it was named."""
    rng = np.random.default_rng(seed)
    for number in range(loops):
        plant = random_loop(rng, mode=bool(number % 2))
        rig, step = plant.rig(seed=number), plant.profile
        for trial in range(TRIALS):
            gains = Gains(*np.exp(rng.normal(CENTRE, SPREAD)).tolist())
            record = rig.run(TrialRequest("loop", trial, gains, step))
            if np.isfinite(record.tension_N).all():
                stable = is_stable(plant.sampled, gains, plant.controller)
                yield stable, growing_oscillation_Hz(record, step) is not None


def main() -> int:
    """Prints the shares, or with --json one object; returns 1 where a target is missed."""
    parser = command_line(__doc__, quick="20 loops")
    parser.add_argument("--loops", type=int, default=150, help="plants")
    parser.add_argument("--seed", type=int, default=200, help="1 and 100 are development")
    options = parser.parse_args()
    found = list(trials(20 if options.quick else options.loops, options.seed))
    unstable = [named for stable, named in found if not stable]
    stable = [named for stable, named in found if stable]
    figures = {
        "trials": len(found),
        "unstable": len(unstable),
        "unstable_named": sum(unstable),
        "stable_named": sum(stable),
    }
    targets = {
        "share of the unstable that are named": at_least(sum(unstable) / len(unstable), 0.8),
        "stable that are named": at_most(sum(stable), 0),
    }
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    raise SystemExit(main())
