"""Tension hysteresis between two reels, as in Fig. 15: one rises and falls, one is read."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.reel.calibration import GaugeCalibration
from plants.two_reel_bench.procedure import mean_reading
from plants.two_reel_bench.rig import Bench


class HysteresisLoop(NamedTuple):
    """Readings of both reels while X goes up and down; columns have shape (points,).

    Attributes:
        x_N: Tension at X, N.
        y: Reading of Y, in its own unit, or N where it was given its calibration.
        cycle: Number of the cycle.
        rising: Whether X was rising.
    """

    x_N: FloatArray
    y: FloatArray
    cycle: FloatArray
    rising: FloatArray

    def attenuation(self) -> float:
        """Attenuation ratio B from the edges of the loop.

        On the rising edge the tension at Y is `B^2 x`, on the falling one `x/B^2`, so that the
        ratio of the two slopes is `B^4` in whatever unit Y reads, and whatever its zero is. The
        last quarter of each edge is taken; it must have left the part where the cable sticks.

        Raises:
            InvalidInput: the loop is too narrow: the cable sticks over most of it.
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
        # The cable slides on the way down below B^4 high, and on the way up above low/B^4.
        if not max((low + quarter) / high, low / (high - quarter)) < fourth:
            raise InvalidInput(
                f"the loop from {low:.3g} to {high:.3g} N is too narrow: the cable sticks over "
                "most of it; widen it, or bend the cable less"
            )
        return float(min(fourth, 1.0) ** 0.25)


@dataclass(frozen=True, slots=True)
class HysteresisTest:
    """A reel's tension goes up and down in steps while the other holds its position.

    Attributes:
        low_N: Least tension of X, N.
        high_N: Greatest, N.
        steps: Steps from one to the other.
        cycles: How often it goes up and down; the way up to the first loop is left out.
        step_s: Time for a step, s.
        settle_s: Time to settle after it, s.
        read_s: Time over which readings are averaged, s.

    Raises:
        InvalidInput: a value is out of its range.
    """

    low_N: float
    high_N: float
    steps: int = 16
    cycles: int = 2
    step_s: float = 0.5
    settle_s: float = 2.0
    read_s: float = 0.5

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
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise InvalidInput(f"{name} is {value}; it must be above zero")

    def run(self, bench: Bench, calibration_y: GaugeCalibration | None = None) -> HysteresisLoop:
        """Measures the loop; both reels hold their position at the end, also after an error.

        Args:
            bench: The two reels.
            calibration_y: Turns Y's readings into N, `TwoReelResult.calibration_y`.

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
                for rising, way in ((1.0, levels[1:]), (0.0, levels[-2::-1])):
                    rows += [(*self._read(bench, n), float(cycle), rising) for n in way.tolist()]
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
