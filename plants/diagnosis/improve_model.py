"""Improvement of a rig's model by experiment: measure, explain, add, measure again; then tune.

The rig keeps its live gains throughout. A trial that is interrupted is aborted, and the live gains
are restored before the call ends.
"""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from estune import api
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.errors import InvalidInput, RigError, UnsafeStart
from estune.run.export import replace_file, write_record
from estune.run.loop import ProgressListener, Stopped
from estune.run.plan import MOVE_WEIGHT
from estune.run.result import TuneResult
from estune.run.targets import open_target
from estune.run.trial_file import TrialFile
from estune.trial import Outcome, Rig, RigDescription, TrialRecord, TrialRequest
from estune.trial.profiles import AnyProfile
from estune.trial.scoring import cost_of
from estune.tuners import DEFAULT_TUNER, Tuner
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.experiments.designs import (
    Experiment,
    candidate_experiments,
    initial_experiments,
)
from plants.diagnosis.explain import explain
from plants.diagnosis.improvement import Costs, Improvement, ImprovementRound
from plants.effects import Effect
from plants.models.reel import reference_reel
from plants.simulation.batch import batch_costs

ROUNDS_MAX = 6
"""Most diagnoses."""
NEW_EXPERIMENTS = 2
"""Experiments run after an effect was added; they had no part in finding it."""
COST_TRIALS = 16
"""Noisy simulated trials whose mean is a predicted cost."""
RESULT = "improvement.json"

Say = Callable[[str], None]


class TuneOptions(NamedTuple):
    """How gains are tuned, on the model and then on the rig.

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


def improve(
    target: Any,
    model: Any = None,
    *,
    folder: str | Path | None = None,
    effects: Sequence[type[Effect] | str] | None = None,
    rounds: int = ROUNDS_MAX,
    tuning: TuneOptions | None = None,
    rig: str | None = None,
    say: Say = lambda _: None,
) -> Improvement:
    """Identifies the effects that a rig's model lacks, adds them, and tunes the rig.

    The initial experiments are run and explained. Effects that are named are added; an ambiguous
    or unexplained verdict is followed by the experiment that would decide. New experiments then
    validate the model, until nothing is left to explain or the answer does not change. Effects
    that a validation does not confirm are removed, and all records explained anew. Then gains are
    tuned on the improved model, the rig is tuned from those, and predicted costs are compared with
    measured ones.

    Args:
        target: An endpoint, a model file, "module:attribute", a plant or a rig.
        model: The model to begin from; None is the reference reel at the rig's cable length, or
            the linear model in the rig's description.
        folder: Where records, trial files and the tuning's run go; must be new or empty.
        effects: Effects to choose from; None is all that are declared.
        rounds: Most diagnoses.
        tuning: How gains are tuned.
        rig: Name of the rig, where several answer at the endpoint.
        say: Callback for progress in words.

    Raises:
        InvalidInput: a value is not usable, or the folder holds something.
        RigError: the rig cannot be reached or refuses.
        Stopped: interrupted (a KeyboardInterrupt); the rig is back at its live gains.
    """
    if rounds < 1:
        raise InvalidInput(f"{rounds} rounds: give 1 or more")
    where = _new_folder(folder)
    with open_target(target, rig) as the_rig:
        about = the_rig.describe()
        given = at_rig(default_model(about) if model is None else model, about)
        lab = ExperimentRunner(the_rig, about, where, say)
        try:
            done = _diagnose_rounds(lab, given, effects, rounds)
            improved = _selected_model(done[-1])
            compared = _Compared((), None, ())
            if about.step.loop == "closed":
                compared = _tuned(lab, given, improved, tuning or TuneOptions())
        except KeyboardInterrupt:
            raise Stopped(the_rig.abort(), where) from None
    result = Improvement(
        rig=about,
        given=given,
        model=improved,
        rounds=tuple(done),
        costs=compared.costs,
        tuning=compared.tuning,
        remarks=(*lab.remarks, *compared.remarks),
        folder=where,
    )
    replace_file(where / RESULT, json.dumps(result.to_json(), indent=2).encode())
    return result


def default_model(about: RigDescription) -> Any:
    """The reference reel, or the linear model in the rig's description.

    Raises:
        InvalidInput: the rig has no cable, and its description no model.
    """
    if about.cable_length_m is not None:
        return reference_reel(about.cable_length_m)
    own = about.linear_model
    if own is None:
        raise InvalidInput(
            f"rig {about.name} has no cable and describes no model; give one with --model"
        )
    import control  # noqa: PLC0415  slow to import

    from plants.models.linear_plant import linear_plant  # noqa: PLC0415  not needed for a reel

    n = len(own.B)
    system = control.ss(
        np.reshape(own.A, (n, n)), np.reshape(own.B, (n, 1)), np.reshape(own.C, (1, n)), own.E
    )
    settings = about.controller
    return linear_plant(
        system,
        own.dead_time_s,
        settings.sampling_Hz,
        output_min_N=settings.output_min_N,
        output_max_N=settings.output_max_N,
        derivative_filter_s=settings.derivative_filter_s,
        settling_time_s=about.settling_time_s,
        profile=about.step,
        limits=about.limits,
        gains=about.gains,
    )


def at_rig(model: Any, about: RigDescription) -> Any:
    """The model at the rig's cable length, preload and sampling rate, where it has these."""
    if not is_dataclass(model) or isinstance(model, type):
        return model
    wanted = {
        "cable_length_m": about.cable_length_m,
        "tension_N": about.step.preload_N,
        "sampling_Hz": about.controller.sampling_Hz,
    }
    has = {field.name for field in fields(model)}
    return replace(
        model, **{name: v for name, v in wanted.items() if name in has and v is not None}
    )


class ExperimentRunner:
    """Runs experiments on the rig and keeps their records."""

    def __init__(self, rig: Rig, about: RigDescription, folder: Path, say: Say) -> None:
        self.rig, self.about, self.folder, self.say = rig, about, folder, say
        self.records: list[MeasuredRecord] = []
        self.remarks: list[str] = []
        self.done: set[AnyProfile] = set()
        # A rig's ledger holds the trial ids of other days: they must differ from these.
        self.stamp = f"{datetime.now().astimezone():%Y%m%d-%H%M%S-%f}"
        self._number = 0

    def run(self, experiments: Sequence[Experiment]) -> tuple[str, ...]:
        """Runs experiments one after the other; each record is on disk before the next begins."""
        for one in experiments:
            self.done.add(one.profile)
            self.say(f"running {one.title} ({one.profile.duration_s:.3g} s)")
            file = TrialFile(f"{self._number:02d}-{one.name}", one.profile, why=one.title)
            file.write(self.folder / "trials")
            record = self._ask(one.name, self.about.gains, one.profile)
            write_record(record, self.folder / "data")
            if record.outcome is Outcome.DONE:
                self.records.append(MeasuredRecord.of(record))
            else:
                why = record.reason or record.outcome.sentence
                self.remarks.append(f"{one.name} was left out: {why}")
        return tuple(one.name for one in experiments)

    def new_experiments(self, count: int) -> list[Experiment]:
        """Candidate experiments that have not been run yet, spread over the list."""
        left = [one for one in candidate_experiments(self.about) if one.profile not in self.done]
        return left[:: max(1, len(left) // count)][:count] if left else []

    def measured(self, gains: Gains, cost: StepCost, repeats: int) -> tuple[float, float]:
        """Mean cost of some gains on the rig's own step, and its standard error."""
        step, per_ampere = self.about.step, self.about.newtons_per_ampere
        costs = np.array(
            [
                cost_of(self._ask("start", gains, step), step, cost, per_ampere)
                for _ in range(repeats)
            ]
        )
        error = float(costs.std(ddof=1)) / math.sqrt(repeats) if repeats > 1 else 0.0
        return float(costs.mean()), error

    def _ask(self, name: str, gains: Gains, profile: AnyProfile) -> TrialRecord:
        request = TrialRequest(f"{name}-{self.stamp}", self._number, gains, profile)
        self._number += 1
        return self.rig.run(request)


def _diagnose_rounds(
    lab: ExperimentRunner, given: Any, effects: Sequence[type[Effect] | str] | None, rounds: int
) -> list[ImprovementRound]:
    """Rounds of measuring and explaining, until nothing is left or the answer is final."""
    names = lab.run(initial_experiments(lab.about))
    if not lab.records:
        raise RigError(f"no trial ended well on {lab.about.name}: {'; '.join(lab.remarks)}")
    model, done = given, list[ImprovementRound]()
    named: set[tuple[str, ...]] = set()
    while True:
        lab.say(f"explaining {len(lab.records)} records")
        found = explain(model, lab.records, effects=effects, rig=lab.about)
        done.append(ImprovementRound(names, found))
        lab.say(found.heading())
        if found.verdict == "none" or len(done) == rounds:
            return done
        if found.verdict in ("named", "incomplete"):
            effects_now = tuple(one.name for one in found.effects)
            if model is given and effects_now in named:
                return done  # more records have not changed the answer
            named.add(effects_now)
            model = found.augmented
            names = lab.run(lab.new_experiments(NEW_EXPERIMENTS))
            continue
        proposed = found.next_experiment
        new = proposed is not None and proposed.trial.profile not in lab.done
        if model is given and not new:
            return done
        names = ()
        if proposed is not None and new:
            trial = proposed.trial
            names = lab.run([Experiment(trial.name, proposed.sentence, trial.profile)])
        # What was added has not been confirmed: all records are explained anew.
        model = given


def _selected_model(last: ImprovementRound) -> Any:
    """The model to be used after the last round."""
    found = last.diagnosis
    return found.base_model if found.verdict in ("none", "unknown") else found.augmented


class _Compared(NamedTuple):
    """The costs compared, the rig's tuning, and remarks."""

    costs: tuple[Costs, ...]
    tuning: TuneResult | None
    remarks: tuple[str, ...]


def _tuned(lab: ExperimentRunner, given: Any, improved: Any, how: TuneOptions) -> _Compared:
    """Tunes on the improved model, then on the rig from there, and compares the costs."""
    about = lab.about
    cost = StepCost(about.settling_time_s, move_weight=MOVE_WEIGHT)
    own, own_error = lab.measured(about.gains, cost, how.repeats)
    remarks: list[str] = []

    def compared(label: str, gains: Gains, measured: float, error: float) -> Costs:
        before, after = (_predicted_cost(plant, gains, about, cost) for plant in (given, improved))
        return Costs(label, gains, before, after, measured, error)

    rows = [compared("the rig's own", about.gains, own, own_error)]
    lab.say("tuning on the improved model")
    try:
        on_model = api.tune(
            improved.rig(gains=about.gains),
            tuner=how.tuner,
            trials=how.model_trials,
            repeats=how.repeats,
            step=about.step,
            cost=cost,
            journal=False,
            watch=None,
        )
        start = on_model.gains
    except UnsafeStart as error:
        remarks.append(f"the improved model cannot be tuned from the rig's own gains: {error}")
        start = about.gains
    lab.say(f"tuning the rig from {start}")
    on_rig = _on_rig(lab, start, cost, how, remarks)
    if on_rig.start_gains != about.gains:
        first = on_rig.start
        rows.append(compared("tuned on the model", first.gains, first.cost, first.cost_error))
    if on_rig.tuned is not None:
        last = on_rig.tuned
        rows.append(compared("tuned on the rig", last.gains, last.cost, last.cost_error))
    else:
        remarks.append(
            f"no gains better than the initial ones were found on the rig: {on_rig.message}"
        )
    return _Compared(tuple(rows), on_rig, tuple(remarks))


def _on_rig(
    lab: ExperimentRunner, start: Gains, cost: StepCost, how: TuneOptions, remarks: list[str]
) -> TuneResult:
    """The rig's own tuning; from its own gains where those of the model are not safe on it."""
    for number, gains in enumerate((start, lab.about.gains)):
        try:
            return api.tune(
                lab.rig,
                tuner=how.tuner,
                trials=how.rig_trials,
                repeats=how.repeats,
                start=gains,
                step=lab.about.step,
                cost=cost,
                run=f"tuning-{lab.stamp}-{number}",
                folder=lab.folder,
                watch=how.watch,
            )
        except UnsafeStart as error:
            remarks.append(f"{gains} are not safe on the rig: {error}")
    raise UnsafeStart(remarks[-1])


def _predicted_cost(plant: Any, gains: Gains, about: RigDescription, cost: StepCost) -> float:
    """Mean cost predicted by a model, with its own measurement noise; nan where it diverges."""
    rows = np.tile(gains.as_tuple(), (COST_TRIALS, 1))
    return float(batch_costs(plant, rows, about.step, cost, seed=0, workers=1).mean())


def _new_folder(folder: str | Path | None) -> Path:
    """The folder for a new improvement; made.

    Raises:
        InvalidInput: it holds something, or cannot be made.
    """
    now = datetime.now().astimezone()
    path = Path(folder) if folder is not None else Path(api.RUNS) / f"improve-{now:%Y%m%d-%H%M%S}"
    try:
        path.mkdir(parents=True, exist_ok=True)
        if any(path.iterdir()):
            raise InvalidInput(f"{path} holds something already; give a new folder")
    except OSError as error:
        raise InvalidInput(f"{path}: {error.strerror or error}; give another folder") from error
    return path
