"""Improvement of a rig's model by experiment: measure, explain, add, measure again; then tune.

The rig keeps its live gains throughout. A trial that is interrupted is aborted, and the live gains
are restored before the call ends; the same call with the same folder then continues.
"""

import json
from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from estune.errors import InvalidInput, RigError
from estune.recordings.column_map import AS_NAMED, ColumnMap
from estune.run.loop import Stopped
from estune.run.targets import open_target
from estune.support.whole_file import replace_file
from estune.trial import RigDescription
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.records import drum_of, read_measurements
from plants.diagnosis.experiments.designs import Experiment, initial_experiments
from plants.diagnosis.explain import explain
from plants.diagnosis.progress import Progress, silent
from plants.diagnosis.report.diagnosis import Diagnosis
from plants.effects import Effect
from plants.improvement.experiment_runner import (
    RESULT,
    ExperimentRunner,
    Say,
    begin,
    default_folder,
)
from plants.improvement.result import Improvement, ImprovementRound
from plants.improvement.tuning import ImprovementOptions, Tuned, tune_with_model
from plants.models.model_file import to_toml
from plants.models.mounting import MountedModel
from plants.models.reel import Reel, reference_reel
from plants.models.unloaded_reel import UnloadedReel


def improve(
    target: Any,
    model: Any = None,
    *,
    folder: str | Path | None = None,
    data: str | Path | None = None,
    columns: ColumnMap = AS_NAMED,
    effects: Sequence[type[Effect] | str] | None = None,
    rounds: int = 6,
    tuning: ImprovementOptions | None = None,
    rig: str | None = None,
    say: Say = lambda _: None,
    progress: Progress = silent,
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
        folder: Where records, trial files and the tuning's run go: new, empty, or that of an
            improvement that was interrupted, which is then continued.
        data: Records of the rig that are there already, in any format of `explain`; explained
            together with the experiments.
        columns: Where their columns come from.
        effects: Effects to choose from; None is all that are declared.
        rounds: Most diagnoses.
        tuning: How gains are tuned.
        rig: Name of the rig, where several answer at the endpoint.
        say: Callback for progress in words.
        progress: Callback for the phases of each diagnosis, as `explain` takes it.

    Raises:
        InvalidInput: a value is not usable, or the folder holds something.
        RigError: the rig cannot be reached or refuses.
        Stopped: interrupted (a KeyboardInterrupt); the rig is back at its live gains.
    """
    if rounds < 1:
        raise InvalidInput(f"{rounds} rounds: give 1 or more")
    where = Path(folder) if folder is not None else default_folder()
    with open_target(target, rig) as the_rig:
        about = the_rig.describe()
        given = at_rig(default_model(about) if model is None else model, about)
        lab = begin(the_rig, where, _as_text(given, effects), say)
        if data is not None:
            lab.records += read_measurements(data, columns, drum_of(given)).measurements
        try:
            done = _diagnose_rounds(lab, given, effects, rounds, progress)
            tuned = Tuned(_selected_model(done[-1]))
            if about.step.loop == "closed":
                tuned = tune_with_model(lab, given, tuned.model, tuning or ImprovementOptions())
        except KeyboardInterrupt:
            again = f"the same call with folder={str(where)!r}"
            raise Stopped(the_rig.abort(), where, again) from None
    result = Improvement(
        rig=lab.about,
        given=given,
        model=tuned.model,
        rounds=tuple(done),
        costs=tuned.costs,
        tuning=tuned.result,
        remarks=tuple(lab.remarks),
        folder=where,
    )
    replace_file(where / RESULT, json.dumps(result.to_json(), indent=2).encode())
    return result


def _as_text(model: Any, effects: Sequence[type[Effect] | str] | None) -> str:
    try:
        text = to_toml(model)
    except InvalidInput:  # a function cannot be written
        text = repr(model)
    names = sorted(e if isinstance(e, str) else e.name for e in effects or ())
    return "\n".join([text, *names])


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
    from control import ss  # noqa: PLC0415  slow to import

    from plants.models.linear_plant import linear_plant  # noqa: PLC0415  not needed for a reel

    system = ss(own.A, np.reshape(own.B, (-1, 1)), np.reshape(own.C, (1, -1)), own.E)
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
        newtons_per_ampere=about.newtons_per_ampere,
    )


def at_rig(model: Any, about: RigDescription) -> Any:
    """The model at the rig's cable length, preload, sampling rate and effort per ampere.

    Where it has these. The rig turns effort into current by its own factor; what torque the motor
    gives for it is identified.
    """
    if not is_dataclass(model) or isinstance(model, type):
        return model
    if isinstance(model, MountedModel):
        mounting = replace(model.mounting, newtons_per_ampere=about.newtons_per_ampere)
        return replace(model, mounting=mounting)
    wanted = {
        "cable_length_m": about.cable_length_m,
        "tension_N": about.step.preload_N,
        "sampling_Hz": about.controller.sampling_Hz,
    }
    if isinstance(model, Reel | UnloadedReel):
        factor = about.newtons_per_ampere / model.newtons_per_ampere
        wanted["torque_constant_Nm_A"] = model.torque_constant_Nm_A * factor
        wanted["current_limit_A"] = model.current_limit_A / factor
    has = {field.name for field in fields(model)}
    return replace(model, **{n: v for n, v in wanted.items() if n in has and v is not None})


def _diagnose_rounds(
    lab: ExperimentRunner,
    given: Any,
    effects: Sequence[type[Effect] | str] | None,
    rounds: int,
    progress: Progress,
) -> list[ImprovementRound]:
    """Rounds of measuring and explaining, until nothing is left or the answer is final."""
    names = lab.run(initial_experiments(lab.about))
    if not lab.records:
        raise RigError(f"no trial ended well on {lab.about.name}: {'; '.join(lab.remarks)}")
    model, done = given, list[ImprovementRound]()
    named: set[tuple[str, ...]] = set()
    while True:
        lab.say(f"explaining {len(lab.records)} records")
        diagnosis = explain(model, lab.records, effects=effects, rig=lab.about, progress=progress)
        done.append(ImprovementRound(names, diagnosis))
        lab.say(diagnosis.heading())
        if diagnosis.verdict == "none" or len(done) == rounds:
            return done
        new = _new_experiments(lab, diagnosis)
        if diagnosis.verdict in ("named", "incomplete"):
            effects_now = tuple(effect.name for effect in diagnosis.effects)
            if model is given and effects_now in named:
                return done  # more records have not changed the answer
            named.add(effects_now)
            model = diagnosis.augmented
        elif model is given and not new:
            return done
        else:
            # What was added has not been confirmed: all records are explained anew.
            model = given
        names = lab.run(new)


def _new_experiments(lab: ExperimentRunner, diagnosis: Diagnosis) -> list[Experiment]:
    """Experiments that validate the effects found, or the one that would decide, if not run."""
    if diagnosis.verdict in ("named", "incomplete"):
        return lab.new_experiments(2)
    if diagnosis.next_experiment is None or diagnosis.next_experiment.trial.profile in lab.done:
        return []
    trial = diagnosis.next_experiment.trial
    return [Experiment(trial.name, diagnosis.next_experiment.sentence, trial.profile)]


def _selected_model(last: ImprovementRound) -> Any:
    """The model to be used after the last round, with the noise that was measured.

    A model whose own numbers leave nothing keeps them: what the records hardly determine, as the
    offsets of drive and gauge beside each other, would else be worse.
    """
    diagnosis = last.diagnosis
    model = diagnosis.augmented
    if diagnosis.verdict in ("none", "unknown"):
        explained = diagnosis.given.ratio**2 <= CONSTANTS.floor
        model = diagnosis.model if explained else diagnosis.base_model
    noise = diagnosis.noise.channels.get("tension_N")
    if noise is None or not is_dataclass(model) or isinstance(model, type):
        return model
    if isinstance(model, MountedModel):
        return replace(model, mounting=replace(model.mounting, noise_rms_N=noise.rms))
    return replace(model, gauge_noise_N=noise.rms) if isinstance(model, Reel) else model
