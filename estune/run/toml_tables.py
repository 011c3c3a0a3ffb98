"""Tables of settings files on a tuning: the step trial, its cost and the search."""

import math
from dataclasses import replace
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from estune.core.cost import StepCost, default_cost
from estune.core.gains import GAIN_NAMES
from estune.loop_model.optimum import RobustnessLimits
from estune.run.session import REPEATS, TOLERANCE, TRIALS
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
    """

    preload_N: float | None = None
    step_N: float | None = None
    step_at_s: NotNegative | None = None
    duration_s: Positive | None = None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        at, end = self.step_at_s, self.duration_s
        if at is not None and end is not None and not at < end:
            raise ValueError(
                f"step_at_s: {at:g} is not before the trial's end, duration_s {end:g}"
            )
        return self

    def of(self, rig: RigDescription) -> StepProfile:
        """The step for a rig."""
        return replace(rig.step, **given_values(self))


class CostTable(TomlTable):
    """The cost of a trial, (35).

    Attributes:
        settling_time_s: Desired settling time; the rig's suggestion by default.
        weight: Weight over the transient: as printed, or rising as in the paper's text.
        time_unit: Unit of the time weight.
        move_weight: Control-move penalty.
    """

    settling_time_s: Positive | None = None
    weight: Literal["printed", "rising"] | None = None
    time_unit: Literal["second", "settling_time"] | None = None
    move_weight: NotNegative | None = None

    def too_long(self, step: StepTable) -> list[str]:
        """The fault of the settling time for such a trial, if any, as a list."""
        after_s = (step.duration_s or math.inf) - (step.step_at_s or 0.0)
        if self.settling_time_s is None or self.settling_time_s <= after_s:
            return []
        limit = f"is longer than the {after_s:g} s after the step"
        return [f"cost.settling_time_s: {self.settling_time_s:g} {limit}"]

    def of(self, rig: RigDescription) -> StepCost:
        """The cost for a rig."""
        return replace(default_cost(rig.settling_time_s), **given_values(self))


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
