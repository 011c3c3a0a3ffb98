"""The tables of a rig's file. Every key carries its unit."""

import math
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import Field, model_validator

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.errors import InvalidInput
from estune.reel.hybrid import SwitchingRules
from estune.run.settings_table import table_of
from estune.run.toml_tables import CONTROLLER, STEP
from estune.support.toml_file import TomlTable
from estune.trial.gain_bounds import GainBounds
from estune.trial.profiles import StepProfile

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Range = tuple[float, float]
_Any = TypeVar("_Any")


class PartTable(TomlTable):
    """A part: its name among the installed ones, or module:attribute, and its settings."""

    use: str
    settings: dict[str, Any] = Field(default={})


class DriverTable(PartTable):
    """Driver of the whole reel; or the drive, with a gauge beside it."""

    gauge: PartTable | None = None

    @property
    def driver(self) -> tuple[str, dict[str, Any]]:
        """The driver to load and its keyword arguments."""
        if self.gauge is None:
            return self.use, self.settings
        return "estune.hardware.drivers.paired:PairedDriver", {
            "drive": self.use,
            "drive_settings": self.settings,
            "gauge": self.gauge.use,
            "gauge_settings": self.gauge.settings,
        }


class FileOrNumbers(TomlTable):
    """A JSON file, or in its place all of the keys that are None by default."""

    file: Path | None = Field(default=None, strict=False)

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        fields = type(self).model_fields.items()
        names = [name for name, field in fields if name != "file" and field.default is None]
        present = [getattr(self, name) is not None for name in names]
        if any(present) != all(present) or all(present) == (self.file is not None):
            raise ValueError(f"give either file, or {', '.join(names)}")
        return self


class GaugeTable(FileOrNumbers):
    """C2: a JSON file of `GaugeCalibration.as_dict`, or a polynomial."""

    counts_of_force: list[float] | None = None
    range_N: Annotated[Range | None, Field(strict=False)] = None


class CurrentTable(FileOrNumbers):
    """C1: a JSON file of `CurrentCalibration.as_dict`, or a polynomial."""

    amperes_of_command: list[float] | None = None
    range_counts: Annotated[Range | None, Field(strict=False)] = None


class ReelTable(TomlTable):
    """Geometry of the reel. Counts that fall while the cable is wound in have a negative turn.

    The defaults are of another machine: a count of its encoder is a radian, and its controller
    commands what the calibration C1 calls A.
    """

    drum_radius_m: Positive = 1.0
    torque_constant_Nm_A: Positive = 1.0
    encoder_counts_per_turn: float = math.tau
    cable_length_m: Positive | None = None

    @model_validator(mode="after")
    def _turns(self) -> Self:
        if self.encoder_counts_per_turn == 0.0:
            raise ValueError("encoder_counts_per_turn is 0; it must be above or below")
        return self


class LimitsTable(TomlTable):
    """Limits of trials and of current commands."""

    tension_min_N: float
    tension_max_N: float
    current_min_A: float = 0.0
    current_max_A: float
    duration_max_s: Positive = 10.0

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        _check_order(self, "tension_min_N", "tension_max_N")
        return _check_order(self, "current_min_A", "current_max_A")


class GuardTable(TomlTable):
    """Limits at which the guard stops the reel; see `estune.reel.guard.Limits`.

    A gauge has noise: that of a reel is frozen after 0.1 s. An encoder at rest repeats its counts.
    """

    tension_max_N: float
    slack_N: float | None = None
    slack_s: NotNegative = 0.1
    rate_max_N_s: Positive | None = None
    current_max_A: Positive
    current_s: NotNegative = 0.5
    angle_min_rad: float | None = None
    angle_max_rad: float | None = None
    travel_max_rad: Positive
    frozen_s: Positive | None = None
    gap_s: Positive = 0.015
    late_in_a_row: Annotated[int, Field(ge=1)] = 10
    heartbeat_s: Positive = 0.5
    bad_in_a_row: Annotated[int, Field(ge=0)] = 2
    bad_s: NotNegative = 0.01
    eta_max: Positive | None = None
    deadline_margin_s: Positive = 0.2

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.slack_N is not None:
            _check_order(self, "slack_N", "tension_max_N")
        if self.angle_min_rad is not None and self.angle_max_rad is not None:
            _check_order(self, "angle_min_rad", "angle_max_rad")
        return self


class SafeTable(TomlTable):
    """Safe state: `hold` by the live gains where that is possible, else `ramp` the current."""

    state: Literal["hold", "ramp"] = "hold"
    current_A: float = 0.0
    ramp_s: NotNegative = 0.2
    recover_s: Positive = 0.3


class MotionTable(TomlTable):
    """Motion of the reel outside trials. A machine without a cable has nothing to take up."""

    hold_N: float | None = None
    rate_N_s: Positive = 20.0
    settle_s: NotNegative = 0.5
    settle_N: Positive = 0.5
    settle_within_s: Positive = 10.0
    take_up_A: Positive | None = None
    take_up_s: Positive = 3.0
    taut_N: Positive | None = None


@table_of(
    CONTROLLER.kind,
    leave_out=CONTROLLER.leave_out,
    own=True,
    defaults={"derivative_filter_s": 0.002},
)
class ControllerTable(TomlTable):
    """The part of the controller that is not tuned."""

    def settings(self, **rest: Any) -> ControllerSettings:
        """Fixed part of the controller, with the settings that are no keys."""
        return ControllerSettings(**self.model_dump(), **rest)


class GainsTable(TomlTable):
    """Live gains at the start; they must be stable."""

    P: Positive
    I: NotNegative
    D: NotNegative
    setpoint_filter_s: NotNegative


class GainRangesTable(TomlTable):
    """Least and greatest value of each gain; one that is left out is bounded by the effort."""

    P: Annotated[Range | None, Field(strict=False)] = None
    I: Annotated[Range | None, Field(strict=False)] = None
    D: Annotated[Range | None, Field(strict=False)] = None
    setpoint_filter_s: Annotated[Range | None, Field(strict=False)] = None

    @property
    def bounds(self) -> GainBounds | None:
        """The bounds that are given; None where none are."""
        given = self.model_dump(exclude_none=True)
        return GainBounds(**given) if given else None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        try:
            _ = self.bounds
        except InvalidInput as error:
            raise ValueError(str(error)) from None
        return self


class GainBoundsTable(TomlTable):
    """Bounds of the gains that the rig accepts."""

    live: GainRangesTable = GainRangesTable()
    trial: GainRangesTable = GainRangesTable()


class ScheduleTable(TomlTable):
    """Live gains scheduled over the cable length, in place of fixed ones.

    The length is reel.cable_length_m at an encoder count of zero, less what the drum has wound in.
    """

    file: Path = Field(strict=False)
    length: Literal["angle"] = "angle"


class PositionGainsTable(TomlTable):
    """Gains of the position controller, whose input is the cable wound in, m."""

    P_N_m: Positive
    I_N_ms: NotNegative
    D_Ns_m: NotNegative
    setpoint_filter_s: NotNegative

    @property
    def gains(self) -> Gains:
        """The gains, of metres instead of newtons."""
        return Gains(self.P_N_m, self.I_N_ms, self.D_Ns_m, self.setpoint_filter_s)


class HybridTable(TomlTable):
    """Position control where a source of setpoints asks for it; see `estune.reel.hybrid`."""

    tension_min_N: Positive
    margin_N: Positive
    position: PositionGainsTable

    @property
    def rules(self) -> SwitchingRules:
        """Rules that select tension or position control."""
        return SwitchingRules(self.tension_min_N, self.margin_N)


@table_of(
    StepProfile,
    leave_out=STEP.leave_out,
    own=True,
    defaults={"step_at_s": 0.2, "duration_s": 1.0},
)
class RigStepTable(TomlTable):
    """Suggested step trial."""

    @cached_property
    def profile(self) -> StepProfile:
        """The step trial."""
        return StepProfile(**self.model_dump())

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        try:
            _ = self.profile
        except InvalidInput as error:
            raise ValueError(str(error)) from None
        return self


class RealTimeTable(TomlTable):
    """Timing of the loop; late_s is a tenth of the sampling period by default.

    The server's priority is that of the process that takes a stop from the network; it is below
    the loop's.
    """

    priority: Annotated[int, Field(ge=0, le=99)] = 50
    server_priority: Annotated[int, Field(ge=0, le=99)] = 20
    lock_memory: bool = True
    cpu: Annotated[int, Field(ge=0)] | None = None
    spin_s: NotNegative = 100e-6
    late_s: Positive | None = None


class BlackBoxTable(TomlTable):
    """Motion, commands and stops kept on disk beside the rig's file; no minutes for none."""

    minutes: Annotated[float, Field(ge=0.0, le=60.0)] = 5.0
    stops_kept: Annotated[int, Field(ge=1)] = 20


def _check_order(table: _Any, low: str, high: str) -> _Any:
    if not getattr(table, low) < getattr(table, high):
        raise ValueError(
            f"{low} {getattr(table, low):g} and {high} {getattr(table, high):g} are not in order"
        )
    return table
