"""The signals of one record that the identification uses."""

from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray


class LoopRecord(NamedTuple):
    """Signals of a record, of a step trial or of ordinary service.

    Attributes:
        effort_N: Effort that acts on the plant, shape (samples,).
        measurement_N: Measurement, shape (samples,).
        setpoint_N: Setpoint before its filter, shape (samples,).
        gains: Gains of the controller; None in open loop, or where they are not known.
        at_rest: Whether the loop was at rest before the first sample.
    """

    effort_N: FloatArray
    measurement_N: FloatArray
    setpoint_N: FloatArray
    gains: Gains | None = None
    at_rest: bool = False

    @classmethod
    def of_step(
        cls,
        effort_N: FloatArray,
        measurement_N: FloatArray,
        step_N: float,
        step_index: int,
        gains: Gains | None = None,
    ) -> "LoopRecord":
        """The record of a step trial that begins at rest, its setpoint as a deviation.

        Args:
            effort_N: Shape (samples,).
            measurement_N: Shape (samples,).
            step_N: Size of the step of the setpoint, or of what the trial changes instead.
            step_index: First sample of the step.
            gains: Gains of the controller, if it acted.
        """
        setpoint = np.zeros(effort_N.size)
        setpoint[step_index:] = step_N
        return cls(effort_N, measurement_N, setpoint, gains, at_rest=True)

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.effort_N.size

    @property
    def step_index(self) -> int:
        """First sample with another setpoint than the first; zero without one."""
        moved = np.flatnonzero(self.setpoint_N != self.setpoint_N[0])
        return int(moved[0]) if moved.size else 0

    @property
    def step_N(self) -> float:
        """Setpoint at the end less that of the first sample."""
        return float(self.setpoint_N[-1] - self.setpoint_N[0])

    @property
    def span_N(self) -> float:
        """Range of the setpoint; of the measurement where the setpoint does not move."""
        return float(np.ptp(self.setpoint_N) or np.ptp(self.measurement_N))

    @property
    def rest_effort_N(self) -> float:
        """Mean effort before the step."""
        return float(self.effort_N[: max(self.step_index, 1)].mean())
