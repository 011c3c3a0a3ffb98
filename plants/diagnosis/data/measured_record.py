"""A measured record as the diagnosis takes it, and issues found in one."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.trial import TrialRecord
from plants.diagnosis.constants import CONSTANTS

CHANNELS = ("setpoint_N", "current_A", "tension_N", "angle_rad", "reference_N")
"""Columns of a record besides time and flags."""

OUTPUTS = ("tension_N", "angle_rad", "reference_N")
"""Columns that a model predicts."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MeasuredRecord:
    """One measured record. Columns have shape (samples,); a channel that is missing is None.

    Attributes:
        name: The trial's id.
        loop: `closed`, or `open` where the setpoint went straight to the current loop.
        time_s: Time, evenly spaced.
        cable_length_m: Deployed cable length, or None where there is no cable.
        preload_N: Tension held before the excitation, N.
        gains: The controller's gains, where they are known.
        setpoint_N: The setpoint; in open loop the tension command.
        current_A: The motor current as recorded: in closed loop the command; in open loop, where
            it differs from the command, what was measured.
        speed_rad_s: What was measured where the angle is its integral.
        reference_N: Tension measured outside the reel.
        flags: Bit field; see `estune.trial.records`.
        source: The file it was read from.
    """

    name: str
    rig: str
    sampling_Hz: float
    loop: Literal["open", "closed"]
    time_s: FloatArray
    cable_length_m: float | None = None
    preload_N: float = 0.0
    profile: str = "custom"
    gains: Gains | None = None
    setpoint_N: FloatArray | None = None
    current_A: FloatArray | None = None
    tension_N: FloatArray | None = None
    angle_rad: FloatArray | None = None
    speed_rad_s: FloatArray | None = None
    reference_N: FloatArray | None = None
    flags: NDArray[np.uint8] | None = None
    source: str = ""

    @classmethod
    def of(cls, record: TrialRecord) -> "MeasuredRecord":
        """The record of a trial; a column of zeros is missing.

        A rig without an encoder or a gauge fills the column of its record with zeros.
        """
        names = ("rig", "sampling_Hz", "cable_length_m", "preload_N", "loop", "profile", "gains")
        columns = ("time_s", "setpoint_N", "current_A", "flags")
        same = {name: getattr(record, name) for name in (*names, *columns)}
        read = {name: getattr(record, name) for name in OUTPUTS}
        outputs: dict[str, Any] = {
            n: None if c is None or not c.any() else c for n, c in read.items()
        }
        return cls(name=record.trial_id, source=record.trial_id, **same, **outputs)

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.time_s.size

    @property
    def duration_s(self) -> float:
        """Length of the record, s."""
        return self.samples / self.sampling_Hz

    @property
    def file(self) -> str:
        """The file it was read from, of which it may be a part between gaps."""
        return (self.source or self.name).partition(" part ")[0]

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the measured channels that a model predicts."""
        return tuple(name for name in OUTPUTS if self.channel(name) is not None)

    def channel(self, name: str) -> FloatArray | None:
        """A column of `CHANNELS` by its name, or None where it is missing."""
        column: FloatArray | None = getattr(self, name)
        return column

    @property
    def command_column(self) -> str:
        """Name of the column that commands the motor: the setpoint of an open loop, or current."""
        return "setpoint_N" if self.loop == "open" and self.setpoint_N is not None else "current_A"

    def command_A(self, newtons_per_ampere: float) -> FloatArray:
        """The current commanded, A, shape (samples,).

        In open loop it is setpoint x radius / torque constant, in closed loop the recorded one;
        either stands in for the other where a column is missing in open loop.

        Args:
            newtons_per_ampere: Torque constant over drum radius of the model as given, N/A.

        Raises:
            InvalidInput: neither setpoint nor current gives the command.
        """
        if self.loop == "open" and self.setpoint_N is not None:
            return self.setpoint_N / newtons_per_ampere
        if self.current_A is not None:
            return self.current_A
        raise InvalidInput(
            f"{self.source or self.name}: a {self.loop}-loop record without current_A has no "
            "motor command; record the current"
        )

    def measured_current_A(self, newtons_per_ampere: float) -> FloatArray | None:
        """The current where it is a measurement, not a multiple of the command.

        A multiple is the command of a rig whose torque constant or radius differ from the model's.

        Args:
            newtons_per_ampere: Torque constant over drum radius of the model as given, N/A.
        """
        if self.loop == "closed" or self.current_A is None or self.setpoint_N is None:
            return None
        command = self.command_A(newtons_per_ampere)
        return None if is_multiple(self.current_A, command) else self.current_A


def is_multiple(column: FloatArray, of: FloatArray) -> bool:
    """Whether a column is another times a constant, but for rounding; both shape (samples,)."""
    power = float(of @ of)
    ratio = float(column @ of) / power if power > 0.0 else 0.0
    return bool(np.abs(column - ratio * of).max() <= CONSTANTS.rounding * np.abs(column).max())
