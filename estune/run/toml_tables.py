"""Tables of settings files on a tuning: the step trial, its cost and the search."""

import math
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from estune.core.cost import StepCost
from estune.core.gains import GAIN_NAMES
from estune.run.plan import MOVE_WEIGHT
from estune.run.session import TOLERANCE
from estune.support.toml_file import TomlTable
from estune.trial import RigDescription
from estune.trial.profiles import StepProfile
from estune.tuners import tuner_class

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Count = Annotated[int, Field(ge=1)]
Range = Annotated[tuple[float, float], Field(strict=False)]


def _check_tuner(name: str) -> str:
    tuner_class(name)
    return name


TunerName = Annotated[str, AfterValidator(_check_tuner)]


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
        given = {name: value for name, value in self.model_dump().items() if value is not None}
        named = ("preload_N", "step_N", "step_at_s", "duration_s")
        return StepProfile(**{**{name: getattr(rig.step, name) for name in named}, **given})


class CostTable(TomlTable):
    """The cost of a trial, (35).

    Attributes:
        settling_time_s: Desired settling time; the rig's suggestion by default.
        weight: Weight over the transient: as printed, or rising as in the paper's text.
        time_unit: Unit of the time weight.
        move_weight: Control-move penalty.
    """

    settling_time_s: Positive | None = None
    weight: Literal["printed", "rising"] = "printed"
    time_unit: Literal["second", "settling_time"] = "second"
    move_weight: NotNegative = MOVE_WEIGHT

    def too_long(self, step: StepTable) -> list[str]:
        """The fault of the settling time for such a trial, if any, as a list."""
        after_s = (step.duration_s or math.inf) - (step.step_at_s or 0.0)
        if self.settling_time_s is None or self.settling_time_s <= after_s:
            return []
        limit = f"is longer than the {after_s:g} s after the step"
        return [f"cost.settling_time_s: {self.settling_time_s:g} {limit}"]

    def of(self, rig: RigDescription) -> StepCost:
        """The cost for a rig."""
        return StepCost(
            rig.settling_time_s if self.settling_time_s is None else self.settling_time_s,
            weight=self.weight,
            time_unit=self.time_unit,
            move_weight=self.move_weight,
        )


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
    """

    trials: Count = 120
    repeats: Count = 3
    tolerance: Annotated[float, Field(ge=0.0, lt=1.0)] = TOLERANCE
    eta_max: Positive | None = None
    bounds: dict[str, Range] = Field(default={})

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
