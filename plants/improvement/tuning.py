"""Tuning of a rig with its improved model: on the model, step by step towards it, on the rig."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from estune import api
from estune.core.cost import StepCost, default_cost
from estune.core.gains import Gains
from estune.errors import UnsafeStart
from estune.run.loop import ProgressListener
from estune.run.results.result import TuneResult
from estune.trial import Outcome, RigDescription, TrialRecord
from estune.tuners import DEFAULT_TUNER, Tuner
from plants.diagnosis.constants import CONSTANTS
from plants.improvement.experiment_runner import ExperimentRunner
from plants.improvement.result import OWN, REACHED, TUNED, Costs
from plants.simulation.approach import Approach, ApproachedPlant
from plants.simulation.batch import batch_costs, simulate
from plants.simulation.noise import NoiseSource
from plants.simulation.plant import Plant
from plants.simulation.simulated_rig import SimulatedRig

COST_TRIALS = 16
"""Noisy simulated trials whose mean is a predicted cost."""
STEP_MAX = 1.5
"""Greatest factor of a gain from one trial on the rig to the next, on the way to the gains tuned
on the model. A loop with a gain margin of 2, the least that is called robust, has room for it."""
SETTLINGS = (2.0, 4.0, 8.0, 16.0)
"""Times a rig is tried to take back to its preload, in settling times. The emulated rig, which
moves back and settles in 0.5 s, is nearest to 4 to 8 of them; both predict its cost with friction
to 0.3 % at its own gains and to 2 % at others, 16 to 2 % and 5 %."""


class ImprovementOptions(NamedTuple):
    """Settings of the tuning on the model and then on the rig.

    Attributes:
        tuner: Name of a tuner, or one ready-made.
        model_trials: Greatest number of search trials on the model.
        rig_trials: Greatest number on the rig, from the gains tuned on the model.
        repeats: Trials of the start before a search, and of each candidate after it.
        watch: Callback after each trial on the rig; "auto" shows progress, None nothing.
    """

    tuner: str | Tuner[Any] = DEFAULT_TUNER
    model_trials: int = 120
    rig_trials: int = 40
    repeats: int = 3
    watch: ProgressListener | Literal["auto"] | None = "auto"


class Tuned(NamedTuple):
    """The tuning of a rig with a model.

    Attributes:
        model: The model it was done with: the improved one, or the given one where that predicts
            the rig better.
    """

    model: Any
    costs: tuple[Costs, ...] = ()
    result: TuneResult | None = None


def tune_with_model(
    lab: ExperimentRunner, given: Any, improved: Any, options: ImprovementOptions
) -> Tuned:
    """Tunes on the improved model, then on the rig from there, and compares the costs."""
    about = lab.about
    cost = default_cost(about.settling_time_s).scaled(about.effort_scale or 1.0)
    # The first begins where the last experiment ended, the others as all that follow.
    own_trials = lab.trials("start", about.gains, options.repeats + 1)[1:]
    own = lab.costs(own_trials, cost)
    own_error = float(own.std(ddof=1)) / math.sqrt(own.size) if own.size > 1 else 0.0
    approach = approach_of(improved, own_trials, about)

    def compared(label: str, gains: Gains, measured: float, error: float) -> Costs:
        before, after = (
            _predicted_cost(ApproachedPlant(plant, approach), gains, about, cost)
            for plant in (given, improved)
        )
        return Costs(label, gains, before, after, measured, error)

    rows = [compared(OWN, about.gains, float(own.mean()), own_error)]
    model = improved
    if is_worse(rows[0]):
        lab.remarks.append(
            f"the improved model predicts the rig's own cost, {rows[0].measured:.4g}, as "
            f"{rows[0].improved:.4g}, the model as given as {rows[0].given:.4g}: the improved "
            "model is refused"
        )
        model = given
    goal = _tuned_on(ApproachedPlant(model, approach), lab, cost, options)
    start = _approach(lab, goal, cost, rows[0].measured + CONSTANTS.quantile * own_error)
    lab.say(f"tuning the rig from {start}")
    result = _on_rig(lab, start, cost, options)
    if result.start_gains != about.gains:
        first = result.start
        rows.append(compared(REACHED, first.gains, first.cost, first.cost_error))
    if result.tuned is not None:
        last = result.tuned
        rows.append(compared(TUNED, last.gains, last.cost, last.cost_error))
    return Tuned(model, tuple(rows), result)


def approach_of(model: Plant, trials: Sequence[TrialRecord], about: RigDescription) -> Approach:
    """How the rig comes to the preload of its step, by what its own trials show before the step.

    Tension and effort there tell what friction the drum holds. Of trials that begin at rest, that
    come from the level of the step, as after a trial, or from as far on the other side, in several
    times, the one is taken that is the nearest.
    """
    step = about.step
    before = slice(0, step.step_index(about.controller.sampling_Hz))
    done = [record for record in trials if record.outcome is Outcome.DONE]
    candidates = [Approach()] + [
        Approach(from_N, settlings * about.settling_time_s)
        for settlings in SETTLINGS
        for from_N in (step.step_N, -step.step_N)
    ]
    if not done:
        return candidates[0]
    factors = {"tension_N": 1.0, "current_A": about.newtons_per_ampere}
    measured = [
        factor * np.mean([getattr(record, name)[before] for record in done], axis=0)
        for name, factor in factors.items()
    ]

    source, samples = NoiseSource(0), step.samples(about.controller.sampling_Hz)
    # Noise moves a drum that friction holds: without it the drum keeps what it holds for ever.
    noise = [source.draw(n, samples, model.noise_rms_N) for n in range(COST_TRIALS)]

    def distance(approach: Approach) -> float:
        plant = ApproachedPlant(model, approach)
        runs = [simulate(plant, about.gains, step, noise_N=noise_N) for noise_N in noise]
        if any(run.diverged_at is not None for run in runs):
            return math.inf
        columns = ("tension_N", "effort_N")
        simulated = (
            np.mean([getattr(run, name)[before] for run in runs], axis=0) for name in columns
        )
        return float(sum(np.mean((s - m) ** 2) for s, m in zip(simulated, measured, strict=True)))

    return min(candidates, key=distance)


def is_worse(own: Costs) -> bool:
    """Whether the improved model predicts a measured cost worse than the given one does."""
    if not math.isfinite(own.measured) or not math.isfinite(own.given):
        return False
    off = abs(own.improved - own.measured)
    return not off <= abs(own.given - own.measured) + CONSTANTS.quantile * own.error


def _tuned_on(
    model: Plant, lab: ExperimentRunner, cost: StepCost, options: ImprovementOptions
) -> Gains:
    """The gains tuned on a model; the rig's own where it cannot be tuned from them."""
    lab.say("tuning on the model")
    try:
        return api.tune(
            SimulatedRig(model, gains=lab.about.gains),
            tuner=options.tuner,
            trials=options.model_trials,
            repeats=options.repeats,
            step=lab.about.step,
            cost=cost,
            journal=False,
            watch=None,
        ).gains
    except UnsafeStart as error:
        lab.remarks.append(f"the model cannot be tuned from the rig's own gains: {error}")
        return lab.about.gains


def _approach(lab: ExperimentRunner, goal: Gains, cost: StepCost, most: float) -> Gains:
    """The gains nearest to a goal that the rig's own trials show to be safe, step by step.

    Each step is a trial. The way ends at the first whose cost is above `most`, that of the rig's
    own gains: the model does not hold there.
    """
    reached = lab.about.gains
    for gains in way(reached, goal):
        lab.say(f"trying {gains}")
        measured = lab.costs(lab.trials("approach", gains, 1), cost)[0]
        if not measured <= most:
            lab.remarks.append(
                f"{gains}, on the way to those tuned on the model, cost {measured:.4g} on the "
                f"rig, its own {most:.4g}: it was tuned from {reached}"
            )
            break
        reached = gains
    return reached


def way(start: Gains, goal: Gains) -> Iterator[Gains]:
    """Gains from a start to a goal, none changed by more than `STEP_MAX` from one to the next."""
    pairs = np.array([start.as_tuple(), goal.as_tuple()]).T
    positive = pairs[(pairs > 0.0).all(axis=1)]
    most = float(np.abs(np.log(positive[:, 1] / positive[:, 0])).max())
    steps = max(1, math.ceil(most / math.log(STEP_MAX) - 1e-9))
    for n in range(1, steps + (start != goal)):
        part = n / steps
        between = (
            a ** (1.0 - part) * b**part if a > 0.0 and b > 0.0 else a + (b - a) * part
            for a, b in pairs.tolist()
        )
        yield Gains(*between) if n < steps else goal


def _on_rig(
    lab: ExperimentRunner, start: Gains, cost: StepCost, options: ImprovementOptions
) -> TuneResult:
    """The rig's own tuning; from its own gains where those of the model are not safe on it."""
    for number, gains in enumerate((start, lab.about.gains)):
        run = f"tuning-{lab.stamp}-{number}"
        try:
            if (lab.folder / run).exists():
                return api.resume(lab.folder / run, lab.rig, watch=options.watch)
            return api.tune(
                lab.rig,
                tuner=options.tuner,
                trials=options.rig_trials,
                repeats=options.repeats,
                start=gains,
                step=lab.about.step,
                cost=cost,
                run=run,
                folder=lab.folder,
                watch=options.watch,
            )
        except UnsafeStart as error:
            lab.remarks.append(f"{gains} are not safe on the rig: {error}")
    raise UnsafeStart(lab.remarks[-1])


def _predicted_cost(plant: Plant, gains: Gains, about: RigDescription, cost: StepCost) -> float:
    """Mean cost predicted by a model, with its own measurement noise; nan where it diverges."""
    rows = np.tile(gains.as_tuple(), (COST_TRIALS, 1))
    return float(batch_costs(plant, rows, about.step, cost, seed=0, workers=1).mean())
