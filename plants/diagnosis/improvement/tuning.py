"""Tuning of a rig with its improved model: on the model, step by step towards it, on the rig."""

import math
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np

from estune import api
from estune.core.cost import StepCost, default_cost
from estune.core.gains import Gains
from estune.errors import UnsafeStart
from estune.run.loop import ProgressListener
from estune.run.results.result import TuneResult
from estune.trial import RigDescription
from estune.tuners import DEFAULT_TUNER, Tuner
from plants.diagnosis.improvement.experiment_runner import ExperimentRunner
from plants.diagnosis.improvement.result import Costs
from plants.simulation.batch import batch_costs

COST_TRIALS = 16
"""Noisy simulated trials whose mean is a predicted cost."""
STEP_MAX = 1.5
"""Greatest factor of a gain from one trial on the rig to the next, on the way to the gains tuned
on the model. A loop with a gain margin of 2, the least that is called robust, has room for it."""
CERTAIN = 2.0
"""Standard errors of a measured cost by which another is beyond doubt."""


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
        costs: Predicted and measured costs.
        result: The tuning on the rig; None where there is nothing to control.
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
    own, own_error = lab.measured(about.gains, cost, options.repeats)

    def compared(label: str, gains: Gains, measured: float, error: float) -> Costs:
        before, after = (_predicted_cost(plant, gains, about, cost) for plant in (given, improved))
        return Costs(label, gains, before, after, measured, error)

    rows = [compared("the rig's own", about.gains, own, own_error)]
    model = improved
    if is_worse(rows[0]):
        lab.remarks.append(
            f"the improved model predicts the rig's own cost, {own:.4g}, as "
            f"{rows[0].improved:.4g}, the model as given as {rows[0].given:.4g}: the improved "
            "model is refused"
        )
        model = given
    start = _approach(lab, _tuned_on(model, lab, cost, options), cost, own + CERTAIN * own_error)
    lab.say(f"tuning the rig from {start}")
    result = _on_rig(lab, start, cost, options)
    if result.start_gains != about.gains:
        first = result.start
        rows.append(compared("reached with the model", first.gains, first.cost, first.cost_error))
    if result.tuned is not None:
        last = result.tuned
        rows.append(compared("tuned on the rig", last.gains, last.cost, last.cost_error))
    else:
        lab.remarks.append(
            f"no gains better than the initial ones were found on the rig: {result.message}"
        )
    return Tuned(model, tuple(rows), result)


def is_worse(own: Costs) -> bool:
    """Whether the improved model predicts a measured cost worse than the given one does."""
    if not math.isfinite(own.measured) or not math.isfinite(own.given):
        return False
    off = abs(own.improved - own.measured)
    return not off <= abs(own.given - own.measured) + CERTAIN * own.error


def _tuned_on(
    model: Any, lab: ExperimentRunner, cost: StepCost, options: ImprovementOptions
) -> Gains:
    """The gains tuned on a model; the rig's own where it cannot be tuned from them."""
    lab.say("tuning on the model")
    try:
        return api.tune(
            model.rig(gains=lab.about.gains),
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
        found = lab.costs("approach", gains, cost, 1)[0]
        if not found <= most:
            lab.remarks.append(
                f"{gains}, on the way to those tuned on the model, cost {found:.4g} on the rig, "
                f"its own {most:.4g}: it was tuned from {reached}"
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


def _predicted_cost(plant: Any, gains: Gains, about: RigDescription, cost: StepCost) -> float:
    """Mean cost predicted by a model, with its own measurement noise; nan where it diverges."""
    rows = np.tile(gains.as_tuple(), (COST_TRIALS, 1))
    return float(batch_costs(plant, rows, about.step, cost, seed=0, workers=1).mean())
