"""A step in the setpoint, followed by a step of the load at the plant's input."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from estune.core.response import LoadStep, StepShape
from estune.core.setting import Setting, documented
from estune.errors import InvalidInput
from estune.trial.profiles.step import StepProfile


@documented
@dataclass(frozen=True, slots=True)
class LoadStepProfile(StepProfile):
    """A step in the setpoint, and after it a load that the rig adds to the effort.

    setpoint as of `StepProfile`; load = 0 for k < round(load_at_s f_s), load_N after that. The
    recorded current is that of the controller, without the load.

    Raises:
        InvalidInput: a value is out of its range.
    """

    load_N: Annotated[
        float,
        Setting(
            "Load step after the step, added to the effort, where the rig can make one",
            "N",
            otherwise="none, or half the step where the cost weighs its rejection",
            not_zero=True,
        ),
    ] = 0.0
    load_at_s: Annotated[
        float,
        Setting(
            "Time of the load from the start of the trial, after the step",
            "s",
            otherwise="the end of the trial, which grows by as much",
            above=0.0,
        ),
    ] = 0.0
    if not TYPE_CHECKING:  # a narrower literal than its base has
        kind: Annotated[Literal["load_step"], Setting("Kind of profile in messages")] = "load_step"

    def __post_init__(self) -> None:
        StepProfile.__post_init__(self)
        if not self.reached_at_s < self.load_at_s < self.duration_s:
            raise InvalidInput(
                f"the load at {self.load_at_s:g} s must come after the step at "
                f"{self.reached_at_s:g} s and before the end at {self.duration_s:g} s"
            )

    def shape(self, sampling_Hz: float) -> StepShape:
        """The step and the load in samples."""
        load = LoadStep(round(self.load_at_s * sampling_Hz), self.load_N)
        return StepProfile.shape(self, sampling_Hz)._replace(load=load)
