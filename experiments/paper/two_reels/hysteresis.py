"""Tension hysteresis between two reels (Fig. 15): one is cycled, the other is read."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray, check_positive
from estune.errors import InvalidInput
from estune.reel.calibration import GaugeCalibration
from experiments.paper.two_reels.rig import Bench, mean_reading


class HysteresisLoop(NamedTuple):
    """Readings of both reels while X is cycled; columns have shape (points,)."""

    x_N: FloatArray  # tension at X, N
    y: FloatArray  # reading of Y in its own unit, or in N if calibrated
    cycle: FloatArray  # number of the cycle
    rising: FloatArray  # whether X was rising

    def attenuation(self) -> float:
        """Attenuation ratio B from the edges of the loop.

        The tension at Y is `B^2 x` on the rising edge and `x/B^2` on the falling edge. The ratio
        of the slopes is `B^4`, for any unit and zero of Y. The last quarter of each edge is used,
        where the cable must slide.

        Raises:
            InvalidInput: the loop is so narrow that the cable sticks over most of it.
        """
        low, high = float(self.x_N.min()), float(self.x_N.max())
        quarter = 0.25 * (high - low)
        up = (self.rising > 0.0) & (self.x_N >= high - quarter)
        down = (self.rising == 0.0) & (self.x_N <= low + quarter)
        slopes = [
            float(np.polyfit(self.x_N[edge], self.y[edge], 1)[0]) if edge.sum() > 2 else 0.0
            for edge in (up, down)
        ]
        fourth = slopes[0] / slopes[1] if slopes[1] else math.nan
        # The cable slides below B^4 high when falling, and above low/B^4 when rising.
        if not max((low + quarter) / high, low / (high - quarter)) < fourth:
            raise InvalidInput(
                f"the loop from {low:.3g} to {high:.3g} N is too narrow: the cable sticks over "
                "most of it; widen it, or bend the cable less"
            )
        return float(min(fourth, 1.0) ** 0.25)


@dataclass(frozen=True, slots=True)
class HysteresisTest:
    """Test in which one reel cycles its tension in steps and the other holds its position."""

    low_N: float  # minimum tension of X, N
    high_N: float  # maximum tension, N
    steps: int = 16  # steps between them
    cycles: int = 2  # number of cycles, without the approach to the first
    step_s: float = 0.5  # duration of a step, s
    settle_s: float = 2.0  # settling time after it, s
    read_s: float = 0.5  # averaging time of the readings, s

    def __post_init__(self) -> None:
        if not (math.isfinite(self.high_N) and 0.0 < self.low_N < self.high_N):
            raise InvalidInput(
                f"tensions from {self.low_N} to {self.high_N} N make no loop; they must rise from "
                "above zero"
            )
        if self.steps < 8 or self.cycles < 1:
            raise InvalidInput(
                f"{self.steps} steps and {self.cycles} cycles make no loop; take 8 or more steps "
                "and one or more cycles"
            )
        for name in ("step_s", "settle_s", "read_s"):
            check_positive(name, getattr(self, name))

    def run(self, bench: Bench, calibration_y: GaugeCalibration | None = None) -> HysteresisLoop:
        """Measures the loop; both reels hold their position afterwards, also after an error.

        Args:
            bench: The two reels.
            calibration_y: Calibration of Y's readings, `TwoReelResult.calibration_y`.

        Raises:
            RigError: a reading is not finite.
            InvalidInput: a reading lies outside the calibration.
        """
        levels = np.linspace(self.low_N, self.high_N, self.steps + 1)
        rows = []
        try:
            bench.y.hold_position()
            self._read(bench, self.high_N)
            self._read(bench, self.low_N)
            for cycle in range(self.cycles):
                for rising, edge in ((1.0, levels[1:]), (0.0, levels[-2::-1])):
                    rows += [(*self._read(bench, n), float(cycle), rising) for n in edge.tolist()]
        finally:
            bench.x.hold_position()
            bench.y.hold_position()
        x, y, cycles, risings = np.array(rows).T
        if calibration_y is not None:
            y = np.asarray(calibration_y.force_N(y))
        return HysteresisLoop(x, y, cycles, risings)

    def _read(self, bench: Bench, level_N: float) -> tuple[float, float]:
        bench.x.hold_tension(level_N, self.step_s)
        bench.record(self.step_s + self.settle_s)
        record = bench.record(self.read_s)
        return mean_reading(record.x.gauge), mean_reading(record.y.gauge)
