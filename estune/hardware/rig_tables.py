"""The tables of a rig's file, `rig.toml`, and what a glance at them gives."""

import math

from estune.core.pidf import ControllerSettings
from estune.hardware.compensation.tables import CompensationTable
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
from estune.support.toml_file import TomlTable
from estune.trial.signals import EFFORT, TENSION


class RigTables(TomlTable):
    """The keys of a rig's file."""

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
