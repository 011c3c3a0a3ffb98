"""Declaration of a parameter of an effect: its range, its role, and the start of a fit."""

import math
from collections.abc import Callable, Sequence
from dataclasses import field
from enum import StrEnum
from typing import Any, NamedTuple

from scipy import constants

PHASE_MAX_rad = 8.0 * math.pi
"""Bound of a phase on either side: while a period is fitted, its phase winds up with it."""

ABOVE_ZERO = 1e-300
"""Least value of what is above zero."""

NEVER = 1e15
"""A limit that nothing reaches, in whatever unit."""


class Role(StrEnum):
    """Meaning of a parameter; the search treats parameters by their role alone."""

    SIZE = "size"  # how much of the effect there is: at the neutral value it does nothing
    LIMIT = "limit"  # level beyond which it acts: at the upper bound, its neutral value, never
    SHAPE = "shape"  # how it acts: cannot be fitted where all sizes are neutral
    FREQUENCY = "frequency"  # shape: frequency in time, Hz
    PERIODS = "periods"  # shape: periods of a wave in a turn of the drum
    PHASE = "phase"  # angle of a wave, from -PHASE_MAX_rad to PHASE_MAX_rad


class RecordScale(NamedTuple):
    """Scales of a machine that its records show, to begin a fit and to judge sizes by.

    Numbers are nan, and lists empty, where the records do not show them.

    Attributes:
        sample_s: Sampling interval.
        record_s: Length of the longest record.
        window_s: Length of a prediction, which shows the machine's own dynamics.
        torque_rms_Nm: Commanded torque about its mean.
        torque_max_Nm: Greatest magnitude of the commanded torque.
        angle_rms_rad: Angle about its mean.
        velocity_rms_rad_s: Velocity.
        velocity_max_rad_s: Greatest speed.
        velocity_min_rad_s: Least speed at which the records dwell, as far as the encoder shows it.
        current_rms_A: Command about its mean.
        current_max_A: Greatest magnitude of the command.
        current_rate_A_s: Greatest rate of change of the command.
        angle_noise_rad: Noise of the encoder, or of the gauge as an angle, rms.
        tension_noise_N: Noise of the gauge, rms.
        reading_max_N: Greatest reading of the gauge.
        stretch_max_m: Greatest stretch of the cable.
        turn_periods: Periods a turn of a wave of which the widest record shows one.
        preload_N: Median preload, of the records that have one.
        cable_length_m: Median cable length.
        resonances_Hz: Frequencies at which the residual of the base model stands out.
        periods_per_turn: Periods a turn that the residual follows.
    """

    sample_s: float = math.nan
    record_s: float = math.nan
    window_s: float = math.nan
    torque_rms_Nm: float = math.nan
    torque_max_Nm: float = math.nan
    angle_rms_rad: float = math.nan
    velocity_rms_rad_s: float = math.nan
    velocity_max_rad_s: float = math.nan
    velocity_min_rad_s: float = math.nan
    current_rms_A: float = math.nan
    current_max_A: float = math.nan
    current_rate_A_s: float = math.nan
    angle_noise_rad: float = math.nan
    tension_noise_N: float = math.nan
    reading_max_N: float = math.nan
    stretch_max_m: float = math.nan
    turn_periods: float = math.nan
    preload_N: float = math.nan
    cable_length_m: float = math.nan
    resonances_Hz: tuple[float, ...] = ()
    periods_per_turn: tuple[float, ...] = ()

    @property
    def window_Hz(self) -> float:
        """Frequency of which a prediction is a period."""
        return 1.0 / self.window_s

    @property
    def fastest_Hz(self) -> float:
        """Highest frequency that samples hold, somewhat below half their rate."""
        return 0.45 / self.sample_s

    @property
    def damping_Nms(self) -> float:
        """Viscous friction that takes the torque at the velocity of the records."""
        return self._torque_by_speed(1)

    @property
    def bend_Nms2(self) -> float:
        """Quadratic friction that does."""
        return self._torque_by_speed(2)

    @property
    def per_reading_per_N(self) -> float:
        """Inverse of the greatest reading."""
        return 1.0 / self.reading_max_N if self.reading_max_N > 0.0 else math.nan

    @property
    def per_square_per_N2(self) -> float:
        """Its square."""
        return self.per_reading_per_N**2

    @property
    def reading_rate_N_s(self) -> float:
        """Rate at which the greatest reading is gone through in a record."""
        return self.reading_max_N / self.record_s

    @property
    def sagging_kg_m(self) -> float:
        """Mass of a cable that weighs as much as the preload pulls."""
        return self.preload_N / (float(constants.g) * self.cable_length_m)

    @property
    def ringing_kg_m(self) -> float:
        """Mass of a cable along which a wave runs once in a window, at the preload."""
        return self.preload_N * (self.window_s / self.cable_length_m) ** 2

    def _torque_by_speed(self, power: int) -> float:
        speed = self.velocity_rms_rad_s
        return self.torque_rms_Nm / speed**power if speed > 0.0 else math.nan


class Share(NamedTuple):
    """A size relative to another: 0.2 of `sample_s` is a fifth of a sample.

    Attributes:
        factor: How many times.
        of: Field of `RecordScale`, another parameter of the effect, or empty for the factor alone.
    """

    factor: float
    of: str = ""

    def size(self, records: RecordScale) -> float:
        """The size in some records; nan where they do not show it."""
        return self.factor * float(getattr(records, self.of)) if self.of else self.factor


class Range(NamedTuple):
    """Where a fit of a parameter begins, and its bounds.

    Attributes:
        start: Where it begins.
    """

    low: float
    start: float
    high: float


Start = float | Share | tuple[float, ...] | Callable[[RecordScale], Sequence[float]] | None


class Parameter(NamedTuple):
    """Declaration of one parameter of an effect.

    Its range is that of nature: a torque is any number, a time not negative, a share of a whole
    no more than one. What a fit tries of it is stated by what scales it, or else machines of
    another size, and the same one in other units, would be told apart by it.

    Attributes:
        low: Least value that there can be.
        high: Greatest value that there can be.
        unit: Its unit; empty for a plain number.
        role: What it stands for.
        neutral: The value at which the effect does nothing, whatever its other parameters; None
            where there is no such value.
        start: Where a fit begins. A number: there, and nowhere else. A `Share`: there, and for a
            shape at values about it. Several numbers, or a function of the records: at each of
            them. None: a frequency begins at the resonances of the residual, periods at those it
            follows, anything else at the usual share of what the records show (`USUAL_RANGES`),
            or else at the usual value.
        between: Bounds of a fit, by what the records show; none where those of its port and unit
            (`USUAL_RANGES`), or of nature, will do.
        least: The effect does not matter in practice where the parameter is less than one of them.
        most: It is not believed where the parameter is more than one of them.
    """

    low: float
    high: float
    unit: str
    role: Role
    neutral: float | None
    start: Start = None
    between: tuple[Share, Share] | None = None
    least: tuple[Share, ...] = ()
    most: tuple[Share, ...] = ()

    @property
    def is_phase(self) -> bool:
        """Whether it is a phase."""
        return self.role is Role.PHASE


def parameter(
    value: float,
    *,
    low: float,
    high: float = math.inf,
    unit: str = "",
    neutral: float | None = None,
    role: Role | None = None,
    start: Start = None,
    between: tuple[Share, Share] | None = None,
    least: tuple[Share, ...] = (),
    most: tuple[Share, ...] = (),
) -> Any:
    """Declares a field of an effect as a parameter: usual value, and the fields of `Parameter`.

    Without a role, one with a neutral value is a size, one in Hz a frequency, any other a shape.
    """
    if role is None:
        role = Role.SHAPE if unit != "Hz" else Role.FREQUENCY
        role = role if neutral is None else Role.SIZE
    declared = Parameter(low, high, unit, role, neutral, start, between, least, most)
    return field(default=value, metadata={"parameter": declared})


def phase() -> Any:
    """Declares a field of an effect as a phase, zero as a rule."""
    return parameter(0.0, low=-PHASE_MAX_rad, high=PHASE_MAX_rad, unit="rad", role=Role.PHASE)
