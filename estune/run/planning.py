"""Plan of a run, from the user's choices and the rig's suggestions, and its JSON form."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError

from estune.core.cost import StepCost, cost_from
from estune.core.gains import Gains
from estune.core.response import CostFunction
from estune.errors import InvalidInput, JournalError
from estune.loop_model.optimum import RobustnessLimits
from estune.loop_model.prediction import StepTrial
from estune.run.plan import Plan
from estune.run.start import KnownStart, StartRule, check_start, model_start
from estune.run.trial_quality import check_sampling
from estune.trial import RigDescription
from estune.trial.gain_bounds import UNBOUNDED, GainBounds
from estune.trial.profiles import LoadStepProfile, Profile, StepProfile
from estune.tuners import (
    RecordUsingTuner,
    SearchSpace,
    Tuner,
    create_tuner,
    tuner_from_stored,
    tuner_to_stored,
)

MODEL_RANGE = 1e4
"""Range of each gain about its start, as a factor, for a tuner that identifies the loop: its model
tells where a gain ceases to matter, and the reach of a trial keeps it near the best one. A factor
of 100 left an optimum at a 170th of the start unfound, 19 % above it; no search took longer."""


def make_tuner(
    tuner: str | Tuner[Any],
    start: Gains,
    bounds: Mapping[str, tuple[float, float]] | None,
    accepted: GainBounds = UNBOUNDED,
) -> Tuner[Any]:
    """A tuner by name, with a search space around the start; a tuner object is returned as is.

    Args:
        tuner: Its name, or the tuner.
        bounds: Of single parameters, in place of the usual ones.
        accepted: Bounds of a trial's gains that the rig accepts.

    Raises:
        InvalidInput: there is no tuner of that name, or the bounds are not usable.
    """
    if not isinstance(tuner, str):
        if bounds is not None:
            raise InvalidInput(
                "a tuner object has its own search space; give the bounds to that one"
            )
        return tuner
    allowed = dict(accepted.items())
    made = create_tuner(tuner, SearchSpace.around(start, bounds=bounds).within(allowed))
    if isinstance(made, RecordUsingTuner):
        space = SearchSpace.around(start, MODEL_RANGE, bounds=bounds).within(allowed)
        made = create_tuner(tuner, space)
    return made


def make_plan(
    description: RigDescription,
    run: str,
    *,
    tuner: str | Tuner[Any],
    start: Gains | KnownStart | StartRule | Literal["model"] | None,
    bounds: Mapping[str, tuple[float, float]] | None,
    step: StepProfile | None,
    cost: StepCost | str | CostFunction | None,
    limits: RobustnessLimits | None = None,
    **rest: Any,
) -> Plan:
    """The plan of a run; omitted values are those that the rig suggests.

    Raises:
        InvalidInput: a value is not usable, or the rig gives no model to start from.
        UnsafeStart: initial gains that were not tried on the rig are not robust there.
    """
    step, cost = step or description.step, cost or "paper"
    if not isinstance(cost, StepCost):
        cost = cost_from(cost, description.settling_time_s).scaled(description.effort_scale)
    step = suited_step(step, cost, description)
    trial = step_trial(description, step, cost)
    if start == "model" or callable(start):
        start = known_start(start, description, step, cost, limits)
    source = ""
    if isinstance(start, KnownStart):
        check_start(start, description)
        source, start = start.source, start.gains
    start = start or description.gains
    if not isinstance(start, Gains):
        raise InvalidInput(
            f"start is {start!r}; give estune.Gains(P, I, D, setpoint_filter_s), or use "
            "estune.start_from"
        )
    made = make_tuner(tuner, start, bounds, description.bounds_of(trial=True))
    if isinstance(made, RecordUsingTuner):
        made = made.for_trial(trial, limits)
        limits = made.limits
    plan = Plan(
        run=run,
        tuner=made,
        start=start,
        step=step,
        cost=cost,
        start_source=source,
        limits=limits or RobustnessLimits(),
        **rest,
    )
    if not plan.forced:
        check_sampling(plan.cost, description.controller.sampling_Hz)
    return plan


def suited_step(step: StepProfile, cost: StepCost, description: RigDescription) -> StepProfile:
    """The step, with a load where the cost weighs its rejection; raises as `with_load`."""
    if cost.rejection and not isinstance(step, LoadStepProfile):
        return with_load(step, description)
    return step


def with_load(step: StepProfile, description: RigDescription) -> LoadStepProfile:
    """The step followed, after as long again, by a load of half its size.

    Raises:
        InvalidInput: the rig makes no load steps.
    """
    most = description.limits.load_max_N
    if not most:
        raise InvalidInput(
            f"rig {description.name} makes no load steps, and the cost weighs their rejection; "
            "choose another cost"
        )
    size = math.copysign(min(most, 0.5 * abs(step.step_N)), -step.step_N)
    after_s = step.duration_s - step.step_at_s
    same = {f.name: getattr(step, f.name) for f in dataclasses.fields(StepProfile)}
    return LoadStepProfile(
        **same
        | {
            "kind": "load_step",
            "duration_s": step.duration_s + after_s,
            "load_N": size,
            "load_at_s": step.duration_s,
        }
    )


def known_start(
    rule: StartRule | Literal["model"],
    description: RigDescription,
    step: StepProfile,
    cost: StepCost,
    limits: RobustnessLimits | None,
) -> KnownStart:
    """The initial gains of a rule for a rig.

    Raises:
        InvalidInput: the rule does not apply to the rig.
        UnsafeStart: the rig's linear model has no stable gains.
    """
    trial, limits = step_trial(description, step, cost), limits or RobustnessLimits()
    if rule != "model":
        return rule(description, trial, limits)
    return model_start(description, trial, limits)


def step_trial(description: RigDescription, step: StepProfile, cost: StepCost) -> StepTrial:
    """The step trial as the identified loop predicts it."""
    rate = description.controller.sampling_Hz
    return StepTrial(
        controller=description.controller,
        cost=cost,
        preload=step.preload_N,
        step=step.shape(rate),
        samples=step.samples(rate),
    )


def plan_to_json(plan: Plan) -> dict[str, Any]:
    """The plan as JSON values; floats survive exactly.

    Raises:
        InvalidInput: the tuner is not a dataclass, so that its settings cannot be stored.
    """
    tuner = tuner_to_stored(plan.tuner)
    shown = {
        f.name: TypeAdapter(type(value)).dump_python(value, mode="json")
        for f in dataclasses.fields(plan)
        if f.name != "tuner" and (value := getattr(plan, f.name)) is not None
    }
    return {"tuner": tuner, **shown}


def plan_from_json(values: dict[str, Any], tuner: Tuner[Any] | None = None) -> Plan:
    """The plan in JSON values, with a given tuner instead of the stored one.

    Raises:
        JournalError: the values are not a plan of this version.
    """
    try:
        if tuner is None:
            tuner = tuner_from_stored(values["tuner"])
        types: dict[str, Any] = {"start": Gains, "step": Profile, "cost": StepCost}
        types["limits"] = RobustnessLimits
        rest = {
            key: TypeAdapter(types[key]).validate_python(value) if key in types else value
            for key, value in values.items()
            if key != "tuner"
        }
        return Plan(tuner=tuner, **rest)
    except (KeyError, ImportError, AttributeError, TypeError, ValidationError) as error:
        raise JournalError(
            f"the stored plan cannot be read ({error}); it is of another version"
        ) from error


def description_to_json(description: RigDescription) -> dict[str, Any]:
    """The rig's description as JSON values."""
    shown: dict[str, Any] = TypeAdapter(RigDescription).dump_python(description, mode="json")
    return shown


def description_from_json(values: dict[str, Any]) -> RigDescription:
    """The description in JSON values.

    Raises:
        JournalError: the values are not a description of this version.
    """
    try:
        return TypeAdapter(RigDescription).validate_python(values)
    except ValidationError as error:
        raise JournalError(
            f"the stored rig cannot be read ({error}); it is of another version"
        ) from error
