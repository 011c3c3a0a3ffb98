"""Tables of settings files on a tuning: the step trial, its cost and the search."""

import math
from dataclasses import replace
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from estune.core.cost import StepCost, cost_from
from estune.core.gains import GAIN_NAMES
from estune.loop_model.optimum import RobustnessLimits
from estune.run.plan import REPEATS, TOLERANCE, TRIALS
from estune.run.planning import with_load
from estune.support.toml_file import TomlTable
from estune.trial import RigDescription
from estune.trial.profiles import StepProfile
from estune.tuners import tuner_class

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Count = Annotated[int, Field(ge=1)]
Limit = Positive | Literal["none"] | None
Range = Annotated[tuple[float, float], Field(strict=False)]


def _check_tuner(name: str) -> str:
    tuner_class(name)
    return name


TunerName = Annotated[str, AfterValidator(_check_tuner)]


def given_values(table: TomlTable) -> dict[str, Any]:
    """The values of a table that are not left to the rig."""
    return {name: value for name, value in table.model_dump().items() if value is not None}


class StepTable(TomlTable):
    """The step trial; by default as the rig suggests.

    Attributes:
        preload_N: Tension before the step.
        step_N: Size of the step.
        step_at_s: Time of the step.
        duration_s: Length of the trial.
        load_N: Load step after it, added to the effort, where the rig can make one.
        load_at_s: Time of the load; by default the end of the trial, which grows by as much.
    """

    preload_N: float | None = None
    step_N: float | None = None
    step_at_s: NotNegative | None = None
    duration_s: Positive | None = None
    load_N: float | None = None
    load_at_s: Positive | None = None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        at, end = self.step_at_s, self.duration_s
        if at is not None and end is not None and not at < end:
            raise ValueError(
                f"step_at_s: {at:g} is not before the trial's end, duration_s {end:g}"
            )
        if self.load_at_s is not None and self.load_N is None:
            raise ValueError("load_at_s: there is no load_N; give its size too")
        return self

    def of(self, rig: RigDescription) -> StepProfile:
        """The step for a rig."""
        given = given_values(self)
        load_N, load_at_s = given.pop("load_N", None), given.pop("load_at_s", None)
        step = replace(rig.step, **given)
        if load_N is None:
            return step
        loaded = replace(with_load(step, rig), load_N=load_N)
        if load_at_s is None:
            return loaded
        longest_s = max(step.duration_s, load_at_s + step.duration_s - step.step_at_s)
        within = load_at_s < step.duration_s
        return replace(
            loaded, load_at_s=load_at_s, duration_s=step.duration_s if within else longest_s
        )


class CostTable(TomlTable):
    """The cost of a trial.

    Attributes:
        preset: Cost by name, or "module:function" of a `StepResponse`; (35) by default.
        settling_time_s: Desired settling time; the rig's suggestion by default.
        weight: Weight over the transient: as printed, or rising as in the paper's text.
        time_unit: Unit of the time weight.
        move_weight: Control-move penalty.
        effort_weight: Price of the effort.
        rejection: Share of load rejection, from 0 to 1.
    """

    preset: str | None = None
    settling_time_s: Positive | None = None
    weight: Literal["printed", "rising"] | None = None
    time_unit: Literal["second", "settling_time"] | None = None
    move_weight: NotNegative | None = None
    effort_weight: NotNegative | None = None
    rejection: Annotated[float, Field(ge=0.0, le=1.0)] | None = None

    def too_long(self, step: StepTable) -> list[str]:
        """The fault of the settling time for such a trial, if any, as a list."""
        after_s = (step.duration_s or math.inf) - (step.step_at_s or 0.0)
        if self.settling_time_s is None or self.settling_time_s <= after_s:
            return []
        limit = f"is longer than the {after_s:g} s after the step"
        return [f"cost.settling_time_s: {self.settling_time_s:g} {limit}"]

    def of(self, rig: RigDescription) -> StepCost:
        """The cost for a rig."""
        given = given_values(self)
        chosen = cost_from(given.pop("preset", "paper"), rig.settling_time_s)
        return replace(chosen, **given).scaled(rig.effort_scale)


class SearchTable(TomlTable):
    """The search.

    Attributes:
        trials: Maximum number of search trials.
        repeats: Trials of the initial gains before the search; also the minimum of confirmation
            trials of the initial and of the tuned gains.
        tolerance: Remaining improvement, relative to the cost, at which the search ends; zero
            makes it use all its trials.
        eta_max: Cost above which a trial is unsafe; three times the initial cost by default.
        bounds: Lowest and highest value of gains, by name, in their own units.
        max_sensitivity: Largest Ms, or "none"; 1.6 by default.
        max_overshoot: Largest overshoot as a share of the step, or "none"; 0.05 by default.
        min_phase_margin_deg: Smallest phase margin; none by default.
    """

    trials: Count = TRIALS
    repeats: Count = REPEATS
    tolerance: Annotated[float, Field(ge=0.0, lt=1.0)] = TOLERANCE
    eta_max: Positive | None = None
    bounds: dict[str, Range] = Field(default={})
    max_sensitivity: Limit = None
    max_overshoot: Limit = None
    min_phase_margin_deg: Limit = None

    @property
    def limits(self) -> RobustnessLimits | None:
        """The limits of robustness; None where all are the usual ones."""
        names = ("max_sensitivity", "max_overshoot", "min_phase_margin_deg")
        given = {name: value for name in names if (value := getattr(self, name)) is not None}
        if not given:
            return None
        return RobustnessLimits(**{n: None if v == "none" else v for n, v in given.items()})

    @model_validator(mode="after")
    def _limited(self) -> Self:
        _ = self.limits
        return self

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        wrong = []
        for name, (low, high) in self.bounds.items():
            if name not in GAIN_NAMES:
                wrong.append(f"bounds.{name}: no gain; the gains are {', '.join(GAIN_NAMES)}")
            elif not 0.0 < low < high:
                wrong.append(
                    f"bounds.{name}: {low:g} to {high:g} is no range: the first must be above 0 "
                    "and below the second"
                )
        if wrong:
            raise ValueError("\n".join(wrong))
        return self
