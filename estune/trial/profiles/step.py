"""A step in the setpoint."""

from dataclasses import dataclass
from typing import Annotated, Literal

from estune.core.quantities import FloatArray
from estune.core.response import StepShape
from estune.core.setting import Setting, check_settings, documented
from estune.errors import InvalidInput
from estune.trial.profiles.sampled import Loop, Sampled, ordered

_RIG = "as the rig suggests"


@documented
@dataclass(frozen=True, slots=True)
class StepProfile(Sampled):
    """A step in the setpoint: hold the preload, and at `step_at_s` jump by the step.

    setpoint = preload_N for k < round(step_at_s f_s), preload_N + step_N after that.

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

    def __post_init__(self) -> None:
        check_settings(self)
        if not self.step_at_s < self.duration_s:
            raise InvalidInput(
                f"the step at {self.step_at_s} s must lie inside the trial of {self.duration_s} s"
            )

    @property
    def extremes_N(self) -> tuple[float, float]:
        """Lowest and highest setpoint, N."""
        return ordered(self.preload_N, self.preload_N + self.step_N)

    def step_index(self, sampling_Hz: float) -> int:
        """Index of the first sample whose setpoint is the stepped one."""
        return round(self.step_at_s * sampling_Hz)

    def shape(self, sampling_Hz: float) -> StepShape:
        """The step in samples."""
        return StepShape(self.step_index(sampling_Hz), self.step_N)

    def setpoint(self, sampling_Hz: float) -> FloatArray:
        """The setpoint at each sample, N, shape (samples,)."""
        return self.preload_N + self.shape(sampling_Hz).setpoint(self.samples(sampling_Hz))
