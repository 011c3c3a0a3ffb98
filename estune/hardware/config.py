"""A rig's file, `rig.toml`: description of the hardware, checked before anything moves.

Every key carries its unit. All mistakes are reported at once, a line for each, with its path.
"""

import math
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

from pydantic import model_validator

from estune.core import pidf
from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.hardware.compensation.plan import CompensationPlan
from estune.hardware.compensation.source import compensation_source
from estune.hardware.compensation.tables import CompensationTable
from estune.hardware.firmware import controller_source
from estune.hardware.hybrid_control import HybridPlan
from estune.hardware.live_gains import LengthSource
from estune.hardware.loop_messages import BadReadings, LoopPlan, Motion, RealTime, SafeState
from estune.hardware.rig_tables import RigTables
from estune.hardware.scales import CurrentScale, GaugeScale
from estune.hardware.schedule_file import read_schedule
from estune.hardware.table_faults import table_faults
from estune.reel.calibration import CurrentCalibration, GaugeCalibration
from estune.reel.guard import GuardWords, Limits
from estune.support.file_limits import parse_json
from estune.support.toml_file import read_toml, validate
from estune.trial import RigDescription, RigLimits
from estune.trial.signals import Signals

FROZEN_s = 0.1
"""Default of guard.frozen_s of a reel."""


class RigConfig(RigTables):
    """A rig's file, checked, and what it makes."""

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
        wrong = [*table_faults(self)]
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
