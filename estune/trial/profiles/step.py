"""A step in the setpoint."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from estune.core.quantities import FloatArray
from estune.core.response import StepShape
from estune.core.setting import Setting, check_settings, documented
from estune.errors import InvalidInput
from estune.trial.profiles.sampled import Loop, Sampled, ordered

_RIG = "as the rig suggests"


@documented
@dataclass(frozen=True, slots=True)
class StepProfile(Sampled):
    """A step or a ramp in the setpoint: hold the preload, from `step_at_s` on move by the step.

    With k_0 = round(step_at_s f_s) and n = max(1, round(ramp_s f_s)),

        setpoint = preload_N for k < k_0, preload_N + step_N min(1, (k - k_0 + 1)/n) after that.

    Raises:
        InvalidInput: a value is out of its range.
    """

    preload_N: Annotated[float, Setting("Tension held before the step", "N", otherwise=_RIG)]
    step_N: Annotated[
        float,
        Setting("Size of the step; negative steps down", "N", otherwise=_RIG, not_zero=True),
    ]
    step_at_s: Annotated[
        float,
        Setting("Time of the step from the start of the trial", "s", otherwise=_RIG, least=0.0),
    ]
    duration_s: Annotated[
        float,
        Setting("Length of the whole trial, after the step", "s", otherwise=_RIG, above=0.0),
    ]
    loop: Annotated[
        Loop,
        Setting("Whether the controller follows the setpoint (closed) or it is the effort (open)"),
    ] = "closed"
    kind: Annotated[Literal["step"], Setting("Kind of profile in messages")] = "step"
    ramp_s: Annotated[
        float,
        Field(exclude_if=lambda ramp_s: ramp_s == 0.0),
        Setting(
            "Time over which the setpoint moves to its new value; 0 is a step",
            "s",
            least=0.0,
            younger=True,
        ),
    ] = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        check_settings(self)
        if not self.reached_at_s < self.duration_s:
            raise InvalidInput(
                f"the step at {self.step_at_s} s, with its ramp of {self.ramp_s:g} s, must lie "
                f"inside the trial of {self.duration_s} s"
            )

    @property
    def reached_at_s(self) -> float:
        """Time from the start of the trial at which the setpoint is at its new value, s."""
        return self.step_at_s + self.ramp_s

    @property
    def extremes(self) -> tuple[float, float]:
        """Lowest and highest setpoint."""
        return ordered(self.preload_N, self.preload_N + self.step_N)

    def step_index(self, sampling_Hz: float) -> int:
        """Index of the first sample whose setpoint is the stepped one."""
        return round(self.step_at_s * sampling_Hz)

    def shape(self, sampling_Hz: float) -> StepShape:
        """The step in samples."""
        ramp = max(1, round(self.ramp_s * sampling_Hz))
        return StepShape(self.step_index(sampling_Hz), self.step_N, ramp=ramp)

    def setpoint(self, sampling_Hz: float) -> FloatArray:
        """The setpoint at each sample, shape (samples,)."""
        return self.preload_N + self.shape(sampling_Hz).setpoint(self.samples(sampling_Hz))
