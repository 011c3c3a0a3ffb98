"""A rig's file, `rig.toml`: everything the rig knows about its hardware, checked before it moves.

Every key carries its unit. What is wrong is told at once, a line for each, with its path.
"""

import json
import math
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

from pydantic import model_validator

from estune.core import pidf
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.errors import InvalidInput
from estune.hardware.firmware import controller_source
from estune.hardware.live_gains import LengthSource
from estune.hardware.loop_messages import LoopPlan, Motion, RealTime, SafeState
from estune.hardware.scales import CurrentScale, GaugeScale
from estune.hardware.schedule_file import read_schedule
from estune.hardware.tables import (
    ControllerTable,
    CurrentTable,
    DriverTable,
    GainsTable,
    GaugeTable,
    GuardTable,
    LimitsTable,
    MotionTable,
    Positive,
    RealTimeTable,
    ReelTable,
    SafeTable,
    ScheduleTable,
    StepTable,
)
from estune.reel.calibration import CurrentCalibration, GaugeCalibration
from estune.reel.guard import Limits
from estune.support.toml_file import TomlTable, read_toml, validate
from estune.trial import RigDescription, RigLimits
from estune.trial.profiles import StepProfile


class RigConfig(TomlTable):
    """A rig's file."""

    name: str
    sampling_Hz: Positive = 632.0
    settling_time_s: Positive
    driver: DriverTable
    gauge: GaugeTable
    current: CurrentTable
    reel: ReelTable
    limits: LimitsTable
    guard: GuardTable
    safe: SafeTable = SafeTable()
    motion: MotionTable
    controller: ControllerTable = ControllerTable()
    gains: GainsTable | None = None
    schedule: ScheduleTable | None = None
    step: StepTable
    real_time: RealTimeTable = RealTimeTable()

    @property
    def newtons_per_ampere(self) -> float:
        """Tension at rest per motor current, N/A."""
        return self.reel.torque_constant_Nm_A / self.reel.drum_radius_m

    @property
    def hold_N(self) -> float:
        """Tension held between trials, N; the step's preload where nothing else is said."""
        return self.step.preload_N if self.motion.hold_N is None else self.motion.hold_N

    @property
    def capacity(self) -> int:
        """Samples of the longest trial."""
        return math.ceil(self.limits.duration_max_s * self.sampling_Hz) + 1

    def settings(self) -> ControllerSettings:
        """The fixed part of the controller; its limits are those of the current."""
        effort = self.newtons_per_ampere
        return ControllerSettings(
            self.sampling_Hz,
            self.controller.derivative_filter_s,
            self.limits.current_min_A * effort,
            self.limits.current_max_A * effort,
        )

    def describe(self) -> RigDescription:
        """What the rig says of itself when it starts.

        Raises:
            InvalidInput: gains or step are out of their range.
        """
        return RigDescription(
            name=self.name,
            gains=self._gains(),
            controller=self.settings(),
            newtons_per_ampere=self.newtons_per_ampere,
            limits=RigLimits(
                self.limits.tension_min_N, self.limits.tension_max_N, self.limits.duration_max_s
            ),
            step=StepProfile(**self.step.model_dump()),
            settling_time_s=self.settling_time_s,
            cable_length_m=self.reel.cable_length_m,
            software=f"estune {version('estune')}",
        )

    def calibrations(self) -> tuple[GaugeScale, CurrentScale]:
        """C2 and C1.

        Raises:
            InvalidInput: a file cannot be read, or a curve cannot be used.
        """
        gauge, current = self.gauge, self.current
        if gauge.file is not None:
            c2 = GaugeCalibration.from_dict(_json(gauge.file))
        else:
            assert gauge.counts_of_force and gauge.range_N  # noqa: S101, PT018  checked by the table
            c2 = GaugeCalibration.from_polynomial(gauge.counts_of_force, *gauge.range_N)
        if current.file is not None:
            c1 = CurrentCalibration.from_dict(_json(current.file))
        else:
            assert current.amperes_of_command and current.range_counts  # noqa: S101, PT018  as above
            c1 = CurrentCalibration.from_polynomial(
                current.amperes_of_command, *current.range_counts
            )
        return GaugeScale.of(c2), CurrentScale.of(c1)

    def following(self) -> LengthSource | None:
        """How the live gains follow the cable's length; None where they are fixed.

        Raises:
            InvalidInput: the schedule cannot be read or used, or does not hold at the length the
                reel begins with.
        """
        if self.schedule is None:
            return None
        schedule, length = read_schedule(self.schedule.file), self.reel.cable_length_m
        if length is None:
            raise InvalidInput(
                "a gain schedule needs reel.cable_length_m, the length at an encoder count of 0"
            )
        low, high = schedule.length_m
        if not low <= length <= high:
            raise InvalidInput(
                f"reel.cable_length_m {length:g} m is beyond the schedule's {low:g} to {high:g} "
                "m; tune at that length too, or begin within"
            )
        radius = self.reel.drum_radius_m if self.schedule.length == "angle" else 0.0
        return LengthSource(schedule, self.settings(), length, radius)

    def _gains(self) -> Gains:
        """The live gains at the start."""
        following = self.following()
        if following is not None:
            return following.schedule.gains(following.length_m, self.hold_N)
        if self.gains is None:
            raise InvalidInput("give live gains as [gains], or a [schedule] of them")
        return Gains(**self.gains.model_dump())

    def plan(self) -> LoopPlan:
        """What the loop is told.

        Raises:
            InvalidInput: a calibration cannot be used.
        """
        gauge, current = self.calibrations()
        description = self.describe()
        settings, timing = description.controller, self.real_time
        late_s = 0.1 / self.sampling_Hz if timing.late_s is None else timing.late_s
        return LoopPlan(
            driver=self.driver.use,
            driver_settings=self.driver.settings,
            sampling_Hz=self.sampling_Hz,
            capacity=self.capacity,
            gauge=gauge,
            current=current,
            radians_per_count=2.0 * math.pi / self.reel.encoder_counts_per_turn,
            newtons_per_ampere=self.newtons_per_ampere,
            tension_min_N=self.limits.tension_min_N,
            tension_max_N=self.limits.tension_max_N,
            effort_min_N=settings.output_min_N,
            effort_max_N=settings.output_max_N,
            controller=controller_source(settings, description.gains),
            live=pidf.coefficients(settings, description.gains),
            following=self.following(),
            guard=self._guard(),
            motion=Motion(
                hold_N=self.hold_N,
                rate_N_s=self.motion.rate_N_s,
                settle_s=self.motion.settle_s,
                settle_N=self.motion.settle_N,
                settle_within_s=self.motion.settle_within_s,
                take_up_N=self.motion.take_up_A * self.newtons_per_ampere,
                take_up_s=self.motion.take_up_s,
                taut_N=self.motion.taut_N,
            ),
            safe=SafeState(
                hold=self.safe.state == "hold",
                effort_N=self.safe.current_A * self.newtons_per_ampere,
                ramp_s=self.safe.ramp_s,
                recover_s=self.safe.recover_s,
            ),
            timing=RealTime(
                timing.priority, timing.lock_memory, timing.cpu, timing.spin_s, late_s
            ),
        )

    def _guard(self) -> Limits:
        given = self.guard.model_dump(exclude={"eta_max", "deadline_margin_s"})
        return Limits(**{name: value for name, value in given.items() if value is not None})

    @model_validator(mode="after")
    def _fits(self) -> Self:
        """What one table says about another; all that does not fit at once."""
        wrong = [*_tensions(self), *_currents(self), *_times(self)]
        if self.gains is not None and self.schedule is not None:
            wrong.append("give either [gains] or a [schedule] of them, not both")
        for made in (self.describe, self.calibrations):
            try:
                made()
            except InvalidInput as error:
                wrong.append(str(error))
        if wrong:
            raise ValueError("\n".join(wrong))
        return self


def _tensions(rig: RigConfig) -> Iterator[str]:
    low, high = rig.limits.tension_min_N, rig.limits.tension_max_N
    asked = {
        "step.preload_N": rig.step.preload_N,
        "step.preload_N + step.step_N": rig.step.preload_N + rig.step.step_N,
        "motion.hold_N": rig.hold_N,
    }
    for what, tension in asked.items():
        if not low <= tension <= high:
            yield f"{what} {tension:g} N is outside limits.tension_N {low:g} to {high:g} N"
    guard, motion = rig.guard, rig.motion
    if not guard.tension_max_N > high:
        yield (
            f"guard.tension_max_N {guard.tension_max_N:g} N must be above limits.tension_max_N "
            f"{high:g} N, or a good trial trips it"
        )
    if not guard.slack_N < min(low, motion.taut_N):
        yield (
            f"guard.slack_N {guard.slack_N:g} N must be below limits.tension_min_N {low:g} N and "
            f"motion.taut_N {motion.taut_N:g} N"
        )


def _currents(rig: RigConfig) -> Iterator[str]:
    low, high = rig.limits.current_min_A, rig.limits.current_max_A
    asked = {"motion.take_up_A": rig.motion.take_up_A, "safe.current_A": rig.safe.current_A}
    for what, current in asked.items():
        if not low <= current <= high:
            yield f"{what} {current:g} A is outside limits.current_A {low:g} to {high:g} A"
    pulled = rig.motion.take_up_A * rig.newtons_per_ampere
    if not rig.motion.taut_N < pulled:
        yield (
            f"motion.taut_N {rig.motion.taut_N:g} N must be below what motion.take_up_A "
            f"{rig.motion.take_up_A:g} A pulls at rest, {pulled:g} N"
        )
    held = high * rig.newtons_per_ampere
    if not rig.limits.tension_max_N <= held:
        yield (
            f"limits.current_max_A {high:g} A holds {held:g} N, less than limits.tension_max_N "
            f"{rig.limits.tension_max_N:g} N"
        )


def _times(rig: RigConfig) -> Iterator[str]:
    step, limits = rig.step, rig.limits
    if not step.duration_s <= limits.duration_max_s:
        yield (
            f"step.duration_s {step.duration_s:g} s is longer than limits.duration_max_s "
            f"{limits.duration_max_s:g} s"
        )
    recorded = step.duration_s - step.step_at_s
    if not rig.settling_time_s <= recorded:
        yield (
            f"settling_time_s {rig.settling_time_s:g} s is longer than what the step records "
            f"after it, {recorded:g} s"
        )
    if not rig.guard.gap_s > 1.0 / rig.sampling_Hz:
        yield (
            f"guard.gap_s {rig.guard.gap_s:g} s is shorter than a sampling period, "
            f"{1.0 / rig.sampling_Hz:.4g} s"
        )


def read_config(path: str | Path) -> RigConfig:
    """Reads a rig's file. Files it names are looked for beside it.

    Raises:
        InvalidInput: it cannot be read, or something in it is wrong; all of it is in the message,
            a line each.
    """
    path = Path(path)
    data = read_toml(path)
    for table in ("gauge", "current", "schedule"):
        place = data.get(table)
        if isinstance(place, dict) and isinstance(place.get("file"), str):
            place["file"] = str(path.parent / place["file"])
    return config_from(data, str(path))


def config_from(data: dict[str, Any], source: str) -> RigConfig:
    """The configuration in data read from somewhere.

    Raises:
        InvalidInput: something in it is wrong; all of it is in the message, a line each.
    """
    return validate(RigConfig, data, source)


def _json(path: Path) -> dict[str, Any]:
    try:
        stored: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidInput(f"calibration {path}: {error}") from error
    return stored
