"""The two-reel procedure: commands and readings, on any bench.

At each setpoint one reel pulls the cable through both eyelets while the other holds its drum,
first X, then Y. With X pulling, Y's gauge is under `B^2 x_1`; with Y pulling to the same reading,
X's gauge is under `x_2 = B^4 x_1`. Only the gauge of X needs a calibration.

At both eyelets the cable must be about to slide towards the pulling reel. A return of the held
drum or noise of the tension takes it off that limit. There are three ways to hold the other reel:

* `position`: the steps of the paper; the ratio is biased towards one.
* `breakout`: at rest by velocity control, then yielding under a slow force ramp until the encoder
  shows that the cable pulls the drum along. The readings are taken there.
* `moving`: paying out at a velocity, for the dynamic ratio at that velocity.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from estune.core.quantities import check_positive
from estune.errors import InvalidInput, RigError
from experiments.paper.two_reels.rig import Bench, BenchRecord, Side, mean_reading, reel_of

Holding = Literal["breakout", "position", "moving"]

SETPOINTS_MIN = 5
"""Three coefficients of the friction curve, and two degrees of freedom."""

SWEEPS_MIN = 3
"""Each sweep is one estimate; their standard deviation gives the interval."""

_CHUNK_s = 0.2
_BREAKOUT_TIMEOUT_s = 20.0
_RETURN_POLL_s = 1.0
"""Time in which a returning drum moves by more than its encoder's counts."""


class SetpointReadings(NamedTuple):
    """Readings at one setpoint in one sweep."""

    setpoint_N: float  # commanded tension of X, N
    sweep: int  # number of the sweep
    x_1_N: float  # tension read at X while X pulled, N
    y_1: float  # reading of Y meanwhile, in its own unit
    x_2_N: float  # tension read at X while Y pulled, N
    y_2: float  # reading of Y meanwhile, in its own unit: y_1 and a control error


class _SlidingReadings(NamedTuple):
    """Readings with the cable about to slide, and the holder's before the approach."""

    puller: float
    holder: float
    holder_before: float


@dataclass(frozen=True, slots=True)
class TwoReelProcedure:
    """The procedure of the paper's section IV-D."""

    setpoints_N: tuple[float, ...]  # tensions of X, N; five or more different ones
    sweeps: int = 8  # number of sweeps, alternately up and down
    holding: Holding = "breakout"  # control mode of the reel that does not pull
    # Tension of the pulling reel before each approach, N; well below B^4 times the lowest
    # setpoint, or the cable does not slide.
    preload_N: float = 1.0
    relief_s: float = 3.0  # settling time at the preload, s
    approach_s: float = 2.0  # duration of the approach, and of the return to the preload, s
    # Settling time after it, s; several integral times of the tension controller.
    settle_s: float = 3.0
    read_s: float = 1.0  # averaging time of the readings, s
    # Slope of the force ramp, N/s. It must be small relative to the tension over the response time
    # of the reels, and keep the sliding velocity low, at which friction is still static.
    breakout_slope_N_s: float = 0.5
    # Displacement of the held drum from which the cable counts as sliding, m; more than the
    # stretch of the cable inside the reel.
    breakout_m: float = 1e-4
    travel_m: float = 3e-4  # further displacement during the readings, m
    velocity_m_s: float = 0.0  # velocity of the cable for `moving`, m/s

    def __post_init__(self) -> None:
        setpoints = np.asarray(self.setpoints_N, dtype=np.float64)
        if setpoints.ndim != 1 or not np.isfinite(setpoints).all():
            raise InvalidInput(f"setpoints {self.setpoints_N} must be finite numbers, N")
        different = np.unique(setpoints).size
        if different < SETPOINTS_MIN or different < setpoints.size:
            raise InvalidInput(
                f"{setpoints.size} setpoints, {different} of them different; give "
                f"{SETPOINTS_MIN} or more different ones, each once"
            )
        if self.sweeps < SWEEPS_MIN:
            raise InvalidInput(
                f"{self.sweeps} sweeps do not show the repeatability; take {SWEEPS_MIN} or more"
            )
        if self.holding not in ("breakout", "position", "moving"):
            raise InvalidInput(f"holding is {self.holding!r}; it is breakout, position or moving")
        for name in (
            *("preload_N", "relief_s", "approach_s", "settle_s", "read_s"),
            *("breakout_slope_N_s", "breakout_m", "travel_m"),
            *(("velocity_m_s",) if self.holding == "moving" else ()),
        ):
            check_positive(name, getattr(self, name))
        if setpoints.min() <= 2.0 * self.preload_N:
            raise InvalidInput(
                f"the least setpoint is {setpoints.min():g} N with a preload of "
                f"{self.preload_N:g} N; more than twice is needed for the cable to slide"
            )

    def run(
        self, bench: Bench, progress: Callable[[SetpointReadings], None] | None = None
    ) -> tuple[SetpointReadings, ...]:
        """Measures all sweeps; both reels hold their position afterwards, also after an error.

        Args:
            bench: The two reels, with some tension in the cable.
            progress: Called after each measurement.

        Raises:
            RigError: a reading is not finite, a reel does not hold its tension or position, or the
                cable does not slide.
        """
        measured = []
        try:
            start = bench.record(self.read_s)
            start_angles = mean_reading(start.x.angle_rad), mean_reading(start.y.angle_rad)
            for sweep, setpoint in self._order():
                measured.append(self._measure(bench, setpoint, sweep, start_angles))
                if progress is not None:
                    progress(measured[-1])
        finally:
            bench.x.hold_position()
            bench.y.hold_position()
        return tuple(measured)

    def _order(self) -> Iterator[tuple[int, float]]:
        """Alternately up and down, so that drift is not confounded with the tension."""
        upward = sorted(self.setpoints_N)
        for sweep in range(self.sweeps):
            for setpoint in upward if sweep % 2 == 0 else reversed(upward):
                yield sweep, setpoint

    def _measure(
        self, bench: Bench, setpoint: float, sweep: int, start_angles: tuple[float, float]
    ) -> SetpointReadings:
        """X pulls to x_1 and Y holds; then Y pulls to its reading and X holds."""
        first = self._pull(bench, "x", setpoint, self.preload_N, start_angles[1])
        if abs(first.puller - setpoint) > 0.2 * setpoint:
            raise RigError(
                f"reel X read {first.puller:.4g} N at a setpoint of {setpoint:g} N; let it settle "
                "longer or tune its tension controller"
            )
        second = self._pull(bench, "y", first.holder, first.holder_before, start_angles[0])
        if not second.holder - second.holder_before > 0.1 * second.holder:
            raise RigError(
                f"reel X read {second.holder:.4g} N after reel Y had pulled and "
                f"{second.holder_before:.4g} N before: the cable did not slide through to it; "
                f"lower the preload of {self.preload_N:g} N or raise setpoint {setpoint:g} N"
            )
        return SetpointReadings(
            setpoint, sweep, first.puller, first.holder, second.holder, second.puller
        )

    def _pull(
        self,
        bench: Bench,
        pulling: Side,
        setpoint: float,
        preload: float,
        start_angle: float,
    ) -> _SlidingReadings:
        """One reel pulls from the preload up to the setpoint; the other holds."""
        holding: Side = "y" if pulling == "x" else "x"
        puller, holder = reel_of(bench, pulling), reel_of(bench, holding)
        # At the higher tension the cable stays taut while the held drum returns.
        puller.hold_tension(setpoint, self.approach_s)
        bench.record(self.approach_s)
        holder.hold_position(start_angle)
        self._wait_for_return(bench, holding, start_angle)
        puller.hold_tension(preload, self.approach_s)
        before = bench.record(self.approach_s + self.relief_s)
        if self.holding != "position":
            holder.hold_velocity(0.0)
        puller.hold_tension(setpoint, self.approach_s)
        bench.record(self.approach_s + self.settle_s)
        if self.holding == "breakout":
            record = self._break_out(bench, holding)
        elif self.holding == "position":
            record = self._read_at_rest(bench, holding)
        else:
            holder.hold_velocity(-self.velocity_m_s / holder.drum_radius_m)
            bench.record(self.settle_s)
            record = bench.record(self.read_s)
        holder.hold_position()
        tail = before.time_s > before.time_s[-1] - self.relief_s / 3.0
        return _SlidingReadings(
            puller=mean_reading(record.of(pulling).gauge),
            holder=mean_reading(record.of(holding).gauge),
            holder_before=mean_reading(before.of(holding).gauge[tail]),
        )

    def _wait_for_return(self, bench: Bench, holding: Side, target: float) -> None:
        """Waits until the held drum has returned to its start angle."""
        radius = reel_of(bench, holding).drum_radius_m
        distance = math.inf
        while distance > self.breakout_m:
            before = distance
            angle = bench.record(_RETURN_POLL_s).of(holding).angle_rad
            distance = abs(mean_reading(angle[-1:]) - target) * radius
            if not distance < before:
                raise RigError(
                    f"reel {holding.upper()} stays {distance * 1e3:.3g} mm from its position; "
                    "check its position controller"
                )

    def _read_at_rest(self, bench: Bench, holding: Side) -> BenchRecord:
        """Reads while the held drum rests."""
        record = bench.record(self.read_s)
        angle = record.of(holding).angle_rad
        moved = float(np.ptp(angle)) * reel_of(bench, holding).drum_radius_m
        if moved > self.breakout_m:
            raise RigError(
                f"reel {holding.upper()} moved by {moved * 1e3:.3g} mm while it held its "
                "position; let it settle longer, or slow the tension controller of the other reel"
            )
        return record

    def _break_out(self, bench: Bench, holding: Side) -> BenchRecord:
        """Lets the held reel yield until the cable slides; returns the readings from there.

        Smaller displacements may be contraction of the cable inside the reel.
        """
        reel = reel_of(bench, holding)
        start = mean_reading(bench.record(_CHUNK_s).of(holding).angle_rad)
        reel.hold_velocity(0.0, -self.breakout_slope_N_s)
        records: list[BenchRecord] = []
        moved = np.zeros(0)
        while not moved.size or moved[-1] < self.breakout_m + self.travel_m:
            if len(records) * _CHUNK_s > _BREAKOUT_TIMEOUT_s:
                raise RigError(
                    f"reel {holding.upper()} did not break out within {_BREAKOUT_TIMEOUT_s:g} s "
                    f"of a ramp of {self.breakout_slope_N_s:g} N/s; use a steeper one"
                )
            records.append(bench.record(_CHUNK_s))
            angles = np.concatenate([r.of(holding).angle_rad for r in records])
            moved = (start - angles) * reel.drum_radius_m
        start = int(np.flatnonzero(moved < self.breakout_m).max(initial=-1)) + 1
        return BenchRecord.joined(records, start)
