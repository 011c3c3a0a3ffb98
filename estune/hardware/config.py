"""A rig's file, `rig.toml`: description of the hardware, checked before anything moves.

Every key carries its unit. All mistakes are reported at once, a line for each, with its path.
"""

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
from estune.hardware.compensation.plan import CompensationPlan
from estune.hardware.compensation.source import compensation_source
from estune.hardware.compensation.tables import CompensationTable
from estune.hardware.firmware import controller_source
from estune.hardware.hybrid_control import HybridPlan
from estune.hardware.live_gains import LengthSource
from estune.hardware.loop_messages import BadReadings, LoopPlan, Motion, RealTime, SafeState
from estune.hardware.scales import CurrentScale, GaugeScale
from estune.hardware.schedule_file import read_schedule
from estune.hardware.tables import (
    BlackBoxTable,
    ControllerTable,
    CurrentTable,
    DriverTable,
    GainBoundsTable,
    GainsTable,
    GaugeTable,
    GuardTable,
    HybridTable,
    LimitsTable,
    MotionTable,
    Positive,
    RealTimeTable,
    ReelTable,
    RigStepTable,
    SafeTable,
    ScheduleTable,
)
from estune.reel.calibration import CurrentCalibration, GaugeCalibration
from estune.reel.guard import GuardWords, Limits
from estune.support.file_limits import parse_json
from estune.support.quantity_text import with_unit
from estune.support.toml_file import TomlTable, read_toml, validate
from estune.trial import RigDescription, RigLimits
from estune.trial.signals import EFFORT, TENSION, Signals

FROZEN_s = 0.1
"""Default of guard.frozen_s of a reel."""


class RigConfig(TomlTable):
    """A rig's file."""

    name: str
    measurement: str = TENSION
    command: str = EFFORT
    sampling_Hz: Positive = 632.0
    settling_time_s: Positive
    driver: DriverTable
    gauge: GaugeTable
    current: CurrentTable
    reel: ReelTable = ReelTable()
    limits: LimitsTable
    guard: GuardTable
    safe: SafeTable = SafeTable()
    motion: MotionTable
    controller: ControllerTable = ControllerTable()
    gains: GainsTable | None = None
    gain_bounds: GainBoundsTable = GainBoundsTable()
    schedule: ScheduleTable | None = None
    compensation: CompensationTable | None = None
    hybrid: HybridTable | None = None
    step: RigStepTable
    real_time: RealTimeTable = RealTimeTable()
    black_box: BlackBoxTable = BlackBoxTable()

    @property
    def newtons_per_ampere(self) -> float:
        """Tension at rest per motor current, N/A."""
        return self.reel.torque_constant_Nm_A / self.reel.drum_radius_m

    @property
    def is_reel(self) -> bool:
        """Whether it measures the tension of a cable."""
        return self.measurement == TENSION

    @property
    def hold_N(self) -> float:
        """Tension held between trials, N; by default the step's preload."""
        hold_N = self.motion.hold_N
        return self.step.profile.preload_N if hold_N is None else hold_N

    @property
    def capacity(self) -> int:
        """Samples of the longest trial."""
        return math.ceil(self.limits.duration_max_s * self.sampling_Hz) + 1

    def settings(self) -> ControllerSettings:
        """Fixed part of the controller; its limits are those of the current."""
        effort = self.newtons_per_ampere
        return self.controller.settings(
            sampling_Hz=self.sampling_Hz,
            output_min_N=self.limits.current_min_A * effort,
            output_max_N=self.limits.current_max_A * effort,
        )

    def describe(self) -> RigDescription:
        """Description of the rig at its start.

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
            step=self.step.profile,
            settling_time_s=self.settling_time_s,
            cable_length_m=self.reel.cable_length_m,
            software=f"estune {version('estune')}",
            measurement=self.measurement,
            command=self.command,
            compensation=self.compensation.text if self.compensation else "",
            live_bounds=self.gain_bounds.live.bounds,
            trial_bounds=self.gain_bounds.trial.bounds,
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

    def length_source(self) -> LengthSource | None:
        """Schedule of the live gains; None where they are fixed.

        Raises:
            InvalidInput: the schedule cannot be read or used, or not at the reel's first length.
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
                f"reel.cable_length_m {length:g} m is outside the schedule's {low:g} to {high:g} "
                "m; tune at that length too, or begin within"
            )
        return LengthSource(schedule, self.settings(), length, self.reel.drum_radius_m)

    def compensations(self) -> CompensationPlan | None:
        """Compensations beside the controller; None without any.

        Raises:
            InvalidInput: a table is not complete, or a number is out of its range.
        """
        return None if self.compensation is None else self.compensation_plan(self.compensation)

    def compensation_plan(self, table: CompensationTable) -> CompensationPlan:
        """Compensations of a table on this reel.

        Raises:
            InvalidInput: the table is not complete, or a number is out of its range.
        """
        reel = self.reel
        geometry = reel.encoder_counts_per_turn, reel.drum_radius_m, reel.cable_length_m
        largest, newtons = self.settings().output_max_N, self.newtons_per_ampere
        return table.plan(self.sampling_Hz, *geometry, largest, newtons_per_ampere=newtons)

    def compensation_text(self, plan: CompensationPlan | None) -> str:
        """C text of compensations; empty without any."""
        if plan is None:
            return ""
        _, current = self.calibrations()
        return compensation_source(plan, current, self.newtons_per_ampere)

    def hybrid_control(self) -> HybridPlan | None:
        """Position control beside that of the tension; None where there is none."""
        table = self.hybrid
        if table is None:
            return None
        return HybridPlan(
            table.rules,
            pidf.coefficients(self.settings(), table.position.gains),
            self.reel.drum_radius_m,
        )

    def _gains(self) -> Gains:
        source = self.length_source()
        if source is not None:
            return source.schedule.gains(source.length_m, self.hold_N)
        if self.gains is None:
            raise InvalidInput("give live gains as [gains], or a [schedule] of them")
        return Gains(**self.gains.model_dump())

    def plan(self) -> LoopPlan:
        """Plan of the loop.

        Raises:
            InvalidInput: a calibration cannot be used.
        """
        gauge, current = self.calibrations()
        description = self.describe()
        settings = description.controller
        driver, driver_settings = self.driver.driver
        compensation = self.compensations()
        per_count_rad = 2.0 * math.pi / self.reel.encoder_counts_per_turn
        late_s = self.real_time.late_s or 0.1 / self.sampling_Hz
        return LoopPlan(
            driver=driver,
            driver_settings=driver_settings,
            sampling_Hz=self.sampling_Hz,
            capacity=self.capacity,
            gauge=gauge,
            current=current,
            radians_per_count=per_count_rad,
            newtons_per_ampere=self.newtons_per_ampere,
            tension_min_N=self.limits.tension_min_N,
            tension_max_N=self.limits.tension_max_N,
            effort_min_N=settings.output_min_N,
            effort_max_N=settings.output_max_N,
            controller=controller_source(settings, description.gains),
            live=pidf.coefficients(settings, description.gains),
            length_source=self.length_source(),
            compensation=compensation,
            compensation_source=self.compensation_text(compensation),
            hybrid=self.hybrid_control(),
            guard=self._guard(),
            bad_readings=BadReadings(
                self.guard.bad_in_a_row,
                self.guard.bad_s,
                self.guard.travel_max_rad / abs(per_count_rad),
            ),
            motion=Motion(
                hold_N=self.hold_N,
                take_up_N=(self.motion.take_up_A or 0.0) * self.newtons_per_ampere,
                taut_N=-math.inf if self.motion.taut_N is None else self.motion.taut_N,
                **self.motion.model_dump(exclude={"hold_N", "take_up_A", "taut_N"}),
            ),
            safe=SafeState(
                hold=self.safe.state == "hold",
                effort_N=self.safe.current_A * self.newtons_per_ampere,
                ramp_s=self.safe.ramp_s,
                recover_s=self.safe.recover_s,
            ),
            timing=RealTime(
                **(self.real_time.model_dump(exclude={"server_priority"}) | {"late_s": late_s})
            ),
        )

    def _check_live_gains(self) -> None:
        """Checks that the rig accepts its own live gains, all those of a schedule.

        Raises:
            InvalidInput: it does not, or gains or step are out of their range.
        """
        about, source = self.describe(), self.length_source()
        about.check_gains(about.gains)
        for gains in source.schedule.extremes if source else ():
            about.check_gains(gains)

    def _guard(self) -> Limits:
        others = {"eta_max", "deadline_margin_s", "bad_in_a_row", "bad_s"}
        about = Signals(self.measurement, self.command)
        words = GuardWords(about.measurement_name, about.measurement_unit)
        given = self.guard.model_dump(exclude=others, exclude_none=True)
        if self.is_reel:
            given = {"frozen_s": FROZEN_s} | given
        else:  # its current is the command itself
            words = words._replace(current=about.command_name, current_unit=about.command_unit)
        return Limits(words=words, **given)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        """Checks each table against the others."""
        wrong = [*_reel_keys(self), *_tensions(self), *_currents(self), *_times(self)]
        if self.gains is not None and self.schedule is not None:
            wrong.append("give either [gains] or a [schedule] of them, not both")
        for make in (self._check_live_gains, self.calibrations, self.compensations):
            try:
                make()
            except InvalidInput as error:
                wrong.append(str(error))
        if wrong:
            raise ValueError("\n".join(wrong))
        return self


def _reel_keys(rig: RigConfig) -> Iterator[str]:
    """What a reel must have, and another machine may leave out."""
    motion, reel = rig.motion, rig.reel
    if (motion.taut_N is None) != (motion.take_up_A is None):
        yield "give both motion.taut_N and motion.take_up_A, or neither"
    if not rig.is_reel:
        return
    needed = {
        "reel.drum_radius_m": "drum_radius_m" in reel.model_fields_set,
        "reel.torque_constant_Nm_A": "torque_constant_Nm_A" in reel.model_fields_set,
        "reel.encoder_counts_per_turn": "encoder_counts_per_turn" in reel.model_fields_set,
        "guard.slack_N": rig.guard.slack_N is not None,
        "motion.take_up_A": motion.take_up_A is not None,
        "motion.taut_N": motion.taut_N is not None,
    }
    if missing := ", ".join(name for name, given in needed.items() if not given):
        yield f'give {missing}; or, if it is no reel, what it measures: measurement = "angle, rad"'


def _tensions(rig: RigConfig) -> Iterator[str]:
    low, high, step = rig.limits.tension_min_N, rig.limits.tension_max_N, rig.step.profile
    unit = Signals(rig.measurement).measurement_unit
    values = {
        "step.preload_N": step.preload_N,
        "step.preload_N + step.step_N": step.preload_N + step.step_N,
        "motion.hold_N": rig.hold_N,
    }
    if rig.hybrid is not None:
        least, margin = rig.hybrid.tension_min_N, rig.hybrid.margin_N
        values["hybrid.tension_min_N"] = least
        values["hybrid.tension_min_N + 2 margin_N"] = least + 2.0 * margin
    for name, tension in values.items():
        if not low <= tension <= high:
            yield (
                f"{name} {with_unit(tension, unit, 6)} is outside limits.tension_N {low:g} to "
                f"{with_unit(high, unit, 6)}"
            )
    guard, taut_N = rig.guard, rig.motion.taut_N
    if not guard.tension_max_N > high:
        yield (
            f"guard.tension_max_N {with_unit(guard.tension_max_N, unit, 6)} must be above "
            f"limits.tension_max_N {with_unit(high, unit, 6)}, or a good trial trips it"
        )
    if guard.slack_N is not None and not guard.slack_N < low:
        yield f"guard.slack_N {guard.slack_N:g} must be below limits.tension_min_N {low:g}"
    if guard.slack_N is not None and taut_N is not None and not guard.slack_N < taut_N:
        yield f"guard.slack_N {guard.slack_N:g} must be below motion.taut_N {taut_N:g}"


def _currents(rig: RigConfig) -> Iterator[str]:
    low, high = rig.limits.current_min_A, rig.limits.current_max_A
    take_up_A, taut_N = rig.motion.take_up_A, rig.motion.taut_N
    values = {"safe.current_A": rig.safe.current_A}
    if take_up_A is not None:
        values["motion.take_up_A"] = take_up_A
    for name, current in values.items():
        if not low <= current <= high:
            yield f"{name} {current:g} A is outside limits.current_A {low:g} to {high:g} A"
    if not rig.is_reel:  # what its command holds at rest is not known
        return
    pull_N = (take_up_A or 0.0) * rig.newtons_per_ampere
    if taut_N is not None and take_up_A is not None and not taut_N < pull_N:
        yield (
            f"motion.taut_N {taut_N:g} N must be below what motion.take_up_A "
            f"{take_up_A:g} A pulls at rest, {pull_N:g} N"
        )
    held_N = high * rig.newtons_per_ampere
    if not rig.limits.tension_max_N <= held_N:
        yield (
            f"limits.current_max_A {high:g} A holds {held_N:g} N, less than limits.tension_max_N "
            f"{rig.limits.tension_max_N:g} N"
        )


def _times(rig: RigConfig) -> Iterator[str]:
    step, limits = rig.step.profile, rig.limits
    if not step.duration_s <= limits.duration_max_s:
        yield (
            f"step.duration_s {step.duration_s:g} s is longer than limits.duration_max_s "
            f"{limits.duration_max_s:g} s"
        )
    recorded_s = step.duration_s - step.step_at_s
    if not rig.settling_time_s <= recorded_s:
        yield (
            f"settling_time_s {rig.settling_time_s:g} s is longer than what the step records "
            f"after it, {recorded_s:g} s"
        )
    if not rig.guard.gap_s > 1.0 / rig.sampling_Hz:
        yield (
            f"guard.gap_s {rig.guard.gap_s:g} s is shorter than a sampling period, "
            f"{1.0 / rig.sampling_Hz:.4g} s"
        )


def read_config(path: str | Path) -> RigConfig:
    """Reads a rig's file. Files that it names are relative to its own folder.

    Raises:
        InvalidInput: it cannot be read, or has mistakes; the message has a line for each.
    """
    path = Path(path)
    data = read_toml(path)
    named = [data.get(table) for table in ("gauge", "current", "schedule")]
    compensation = data.get("compensation")
    if isinstance(compensation, dict):
        named.append(compensation.get("friction"))
    for place in named:
        if isinstance(place, dict) and isinstance(place.get("file"), str):
            place["file"] = str(path.parent / place["file"])
    return config_from(data, str(path))


def config_from(data: dict[str, Any], source: str) -> RigConfig:
    """The configuration in data from a source.

    Raises:
        InvalidInput: it has mistakes; the message has a line for each.
    """
    return validate(RigConfig, data, source)


def _json(path: Path) -> Any:
    try:
        return parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidInput(f"calibration {path}: {error}") from error
