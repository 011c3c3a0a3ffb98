"""Tables of settings files on a tuning: the step trial, its cost and the search."""

import math
from dataclasses import replace
from typing import Annotated, Any, NamedTuple, Self

from pydantic import AfterValidator, Field, model_validator

from estune.core.cost import StepCost, cost_from
from estune.core.gains import GAIN_NAMES
from estune.core.pidf import ControllerSettings
from estune.core.setting import Declared, Setting, declared
from estune.loop_model.optimum import RobustnessLimits
from estune.run.plan import Search
from estune.run.planning import with_load
from estune.run.settings_table import given_settings, table_of
from estune.support.toml_file import TomlTable
from estune.trial import RigDescription
from estune.trial.profiles import LoadStepProfile, StepProfile
from estune.tuners import tuner_class

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Count = Annotated[int, Field(ge=1)]
Range = Annotated[tuple[float, float], Field(strict=False)]


def _check_tuner(name: str) -> str:
    tuner_class(name)
    return name


TunerName = Annotated[str, AfterValidator(_check_tuner)]


class SettingsGroup(NamedTuple):
    """Settings that stand in one table of a file, under one heading.

    Attributes:
        leave_out: Fields of it that users do not set.
        more: Settings that stand beside its fields.
    """

    title: str
    kind: type
    leave_out: tuple[str, ...] = ()
    more: tuple[Declared, ...] = ()

    @property
    def members(self) -> tuple[Declared, ...]:
        """The settings."""
        own = (member for member in declared(self.kind) if member.name not in self.leave_out)
        return (*self.more, *own)


_PRESET = Setting(
    "Cost by name: paper for (35), itae, ise (with a price on the effort), rejection (of a load "
    "step), tracking_and_rejection, or module:function of a StepResponse",
    otherwise="paper",
)
_BOUNDS = Setting(
    "Lowest and highest value of gains, by name, in their own units",
    otherwise="the initial value over and times 10 000 with `model_based`, 100 with other tuners",
)
STEP = SettingsGroup("The step trial", LoadStepProfile, ("loop", "kind"))
COST = SettingsGroup(
    "The cost of a trial",
    StepCost,
    ("criterion", "function"),
    (Declared("preset", str, None, _PRESET),),
)
SEARCH = SettingsGroup("The search", Search, (), (Declared("bounds", dict, None, _BOUNDS),))
LIMITS = SettingsGroup("Limits of robustness", RobustnessLimits)
CONTROLLER = SettingsGroup(
    "The controller", ControllerSettings, ("sampling_Hz", "output_min_N", "output_max_N", "form")
)
"""The groups; those of a tuning, and the part of the controller that is not tuned."""


@table_of(STEP.kind, leave_out=STEP.leave_out)
class StepTable(TomlTable):
    """The step trial; by default as the rig suggests."""

    @property
    def given(self) -> dict[str, Any]:
        """The settings that are not left to the rig."""
        return given_settings(self, LoadStepProfile)

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        given = self.given
        at, end = given.get("step_at_s"), given.get("duration_s")
        if at is not None and end is not None and not at < end:
            raise ValueError(
                f"step_at_s: {at:g} is not before the trial's end, duration_s {end:g}"
            )
        if "load_at_s" in given and "load_N" not in given:
            raise ValueError("load_at_s: there is no load_N; give its size too")
        return self

    def of(self, rig: RigDescription) -> StepProfile:
        """The step for a rig."""
        given = self.given
        load, load_at_s = given.pop("load_N", None), given.pop("load_at_s", None)
        step = replace(rig.step, **given)
        if load is None:
            return step
        loaded = replace(with_load(step, rig), load_N=load)
        if load_at_s is None:
            return loaded
        longest_s = max(step.duration_s, load_at_s + step.duration_s - step.step_at_s)
        within = load_at_s < step.duration_s
        return replace(
            loaded, load_at_s=load_at_s, duration_s=step.duration_s if within else longest_s
        )


@table_of(COST.kind, leave_out=COST.leave_out)
class CostTable(TomlTable):
    """The cost of a trial."""

    preset: str | None = None

    def too_long(self, step: StepTable) -> list[str]:
        """The fault of the settling time for such a trial, if any, as a list."""
        trial, settling_s = step.given, given_settings(self, StepCost).get("settling_time_s", 0.0)
        after_s = trial.get("duration_s", math.inf) - trial.get("step_at_s", 0.0)
        if settling_s <= after_s:
            return []
        limit = f"is longer than the {after_s:g} s after the step"
        return [f"cost.settling_time_s: {settling_s:g} {limit}"]

    def of(self, rig: RigDescription) -> StepCost:
        """The cost for a rig."""
        chosen = cost_from(self.preset or "paper", rig.settling_time_s)
        return replace(chosen, **given_settings(self, StepCost)).scaled(rig.effort_scale)


@table_of(Search, own=True)
@table_of(RobustnessLimits)
class SearchTable(TomlTable):
    """The search, and the limits that its gains keep."""

    bounds: dict[str, Range] = Field(default={})

    @property
    def limits(self) -> RobustnessLimits | None:
        """The limits of robustness; None where all are the usual ones."""
        given = given_settings(self, RobustnessLimits)
        return RobustnessLimits(**given) if given else None

    @property
    def search(self) -> dict[str, Any]:
        """Arguments of `estune.run.planning.make_plan`."""
        search = {m.name: getattr(self, m.name) for m in declared(Search)}
        return {**search, "bounds": dict(self.bounds) or None, "limits": self.limits}

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
