"""The signals of one record that the identification uses."""

import math
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.loop_model.converter_step import converter_step


class LoopRecord(NamedTuple):
    """Signals of a record, of a step trial or of ordinary service.

    Attributes:
        effort: Effort that acts on the plant, shape (samples,).
        measurement: Measurement, shape (samples,).
        setpoint: Setpoint before its filter, shape (samples,).
        gains: Gains of the controller; None in open loop, or where they are not known.
        at_rest: Whether the loop was at rest before the first sample.
        limits: Limits at which the effort was held, in its unit.
    """

    effort: FloatArray
    measurement: FloatArray
    setpoint: FloatArray
    gains: Gains | None = None
    at_rest: bool = False
    limits: tuple[float, float] = (-math.inf, math.inf)

    @classmethod
    def of_step(
        cls,
        effort: FloatArray,
        measurement: FloatArray,
        step_size: float,
        step_index: int,
        gains: Gains | None = None,
    ) -> "LoopRecord":
        """The record of a step trial that begins at rest, its setpoint as a deviation.

        Args:
            effort: Shape (samples,).
            measurement: Shape (samples,).
            step_size: Size of the step of the setpoint, or of what the trial changes instead.
            step_index: First sample of the step.
            gains: Gains of the controller, if it acted.
        """
        setpoint = np.zeros(effort.size)
        setpoint[step_index:] = step_size
        return cls(effort, measurement, setpoint, gains, at_rest=True)

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.effort.size

    @property
    def step_index(self) -> int:
        """First sample with another setpoint than the first; zero without one."""
        moved = np.flatnonzero(self.setpoint != self.setpoint[0])
        return int(moved[0]) if moved.size else 0

    @property
    def is_step(self) -> bool:
        """Whether the setpoint moves once at most, as in a step trial."""
        return int(np.count_nonzero(np.diff(self.setpoint))) <= 1

    @property
    def step_size(self) -> float:
        """Setpoint at the end less that of the first sample."""
        return float(self.setpoint[-1] - self.setpoint[0])

    @property
    def span(self) -> float:
        """Range of the setpoint; of the measurement where the setpoint does not move."""
        return float(np.ptp(self.setpoint) or np.ptp(self.measurement))

    @property
    def rest_effort(self) -> float:
        """Mean effort before the step."""
        return float(self.effort[: max(self.step_index, 1)].mean())


def rounding_std(measurement: FloatArray) -> float:
    """Standard deviation of rounding to the steps of a measurement.

    An encoder whose speed has steps of 8.3 rpm is exact at rest and off by 2.4 rpm in motion.
    """
    steps = np.abs(np.diff(measurement))
    if not steps.any():
        return 0.0
    least = float(steps[steps > 0.0].min())
    return max(least, converter_step(measurement)) / math.sqrt(12.0)
