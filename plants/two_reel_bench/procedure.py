"""The two-reel procedure: what to command and what to read, on any bench.

At each setpoint one reel pulls the cable through both eyelets while the other holds its drum, once
X and once Y. With X pulling, Y's gauge is under `B^2 x_1`; with Y then pulling to that same
reading, the gauge of X is under `x_2 = B^4 x_1`. Only the gauge of X needs to be calibrated.

What the ratio needs is that the cable is on the verge of sliding, at both eyelets, towards the
reel that pulls. Approaching from a low tension and stopping there leaves it a little inside,
because any return of the held drum or noise of the controlled tension takes it off the verge.
So there are three ways to hold the other reel:

* `position`: as the paper's steps say; the ratio comes out a little too near to one.
* `breakout`: at rest by velocity control, and then giving way under a slow ramp of force until
  the encoder says that the cable pulls the drum along. The readings are taken there.
* `moving`: paying out at a velocity, for the dynamic ratio at that velocity.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput, RigError
from plants.two_reel_bench.rig import Bench, BenchReading, BenchRecord, BenchReel

Holding = Literal["breakout", "position", "moving"]

LEAST_SETPOINTS = 5
"""Three coefficients of the friction curve, and two setpoints more to carry its errors."""

LEAST_SWEEPS = 3
"""Each sweep is one estimate; their scatter makes the interval."""

_CHUNK_s = 0.2
_PATIENCE_s = 20.0
_NOTICE_s = 1.0
"""Time in which a drum on its way back has come nearer by more than its encoder's counts."""


class SetpointReadings(NamedTuple):
    """What one setpoint gave in one sweep.

    Attributes:
        setpoint_N: Tension commanded to X, N.
        sweep: Number of the sweep.
        x_1_N: Tension read at X while X pulled, N.
        y_1: Reading of Y meanwhile, in its own unit.
        x_2_N: Tension read at X while Y pulled, N.
        y_2: Reading of Y meanwhile, in its own unit: y_1, but for what its controller left.
    """

    setpoint_N: float
    sweep: int
    x_1_N: float
    y_1: float
    x_2_N: float
    y_2: float


class _Held(NamedTuple):
    """Readings with the cable on the verge of sliding, and the holder's before the approach."""

    puller: float
    holder: float
    holder_before: float


@dataclass(frozen=True, slots=True)
class TwoReelProcedure:
    """Section IV-D of the paper, step by step.

    Attributes:
        setpoints_N: Tensions of X, N; five or more different ones.
        sweeps: How often all of them are measured, up and down in turn.
        holding: How the reel that does not pull is held.
        preload_N: Tension to which the pulling reel returns before each approach, N; must be well
            below B^4 times the least setpoint, or the cable does not come to slide.
        relief_s: Time to settle at the preload, s.
        approach_s: Time of the approach, and of the return to the preload, s.
        settle_s: Time to settle after it, s; several integral times of the tension controller.
        read_s: Time over which readings are averaged, s.
        breakout_slope_N_s: Slope of the force ramp, N/s. It must change the tension little within
            the response time of the reels; the text compares it with the inverse of that time,
            which holds for the slope divided by the tension. A steeper one also lets the cable
            slide faster while readings are taken, where friction is no longer the static one.
        breakout_m: How far the held drum has to be pulled along until the cable counts as sliding,
            m; more than the cable inside the reel stretches meanwhile.
        travel_m: How much further it then moves while readings are taken, m.
        velocity_m_s: Velocity of the cable when `moving`, m/s.

    Raises:
        InvalidInput: a value is out of its range; too few setpoints or sweeps.
    """

    setpoints_N: tuple[float, ...]
    sweeps: int = 8
    holding: Holding = "breakout"
    preload_N: float = 1.0
    relief_s: float = 3.0
    approach_s: float = 2.0
    settle_s: float = 3.0
    read_s: float = 1.0
    breakout_slope_N_s: float = 0.5
    breakout_m: float = 1e-4
    travel_m: float = 3e-4
    velocity_m_s: float = 0.0

    def __post_init__(self) -> None:
        setpoints = np.asarray(self.setpoints_N, dtype=np.float64)
        if setpoints.ndim != 1 or not np.isfinite(setpoints).all():
            raise InvalidInput(f"setpoints {self.setpoints_N} must be finite numbers, N")
        different = np.unique(setpoints).size
        if different < LEAST_SETPOINTS or different < setpoints.size:
            raise InvalidInput(
                f"{setpoints.size} setpoints, {different} of them different; give "
                f"{LEAST_SETPOINTS} or more different ones, each once"
            )
        if self.sweeps < LEAST_SWEEPS:
            raise InvalidInput(
                f"{self.sweeps} sweeps cannot tell scatter from friction; take {LEAST_SWEEPS} or "
                "more"
            )
        if self.holding not in ("breakout", "position", "moving"):
            raise InvalidInput(f"holding is {self.holding!r}; it is breakout, position or moving")
        for name in (
            *("preload_N", "relief_s", "approach_s", "settle_s", "read_s"),
            *("breakout_slope_N_s", "breakout_m", "travel_m"),
            *(("velocity_m_s",) if self.holding == "moving" else ()),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise InvalidInput(f"{name} is {value}; it must be above zero")
        if setpoints.min() <= 2.0 * self.preload_N:
            raise InvalidInput(
                f"the least setpoint is {setpoints.min():g} N with a preload of "
                f"{self.preload_N:g} N; more than twice is needed for the cable to slide"
            )

    def run(
        self, bench: Bench, progress: Callable[[SetpointReadings], None] | None = None
    ) -> tuple[SetpointReadings, ...]:
        """Measures all sweeps; both reels hold their position at the end, also after an error.

        Args:
            bench: The two reels, with some tension in the cable.
            progress: Called after each measurement.

        Raises:
            RigError: a reading is not finite; a reel does not hold its tension or its drum at
                rest; the cable does not come to slide.
        """
        found = []
        try:
            start = bench.record(self.read_s)
            homes = mean_reading(start.x.angle_rad), mean_reading(start.y.angle_rad)
            for sweep, setpoint in self._order():
                found.append(self._measure(bench, setpoint, sweep, homes))
                if progress is not None:
                    progress(found[-1])
        finally:
            bench.x.hold_position()
            bench.y.hold_position()
        return tuple(found)

    def _order(self) -> Iterator[tuple[int, float]]:
        """Up and down in turn, so that a drift does not pass for an effect of the tension."""
        upward = sorted(self.setpoints_N)
        for sweep in range(self.sweeps):
            for setpoint in upward if sweep % 2 == 0 else reversed(upward):
                yield sweep, setpoint

    def _measure(
        self, bench: Bench, setpoint: float, sweep: int, homes: tuple[float, float]
    ) -> SetpointReadings:
        """X pulls to x_1 and Y holds; then Y pulls to what it read and X holds."""
        first = self._pull(bench, "x", setpoint, self.preload_N, homes[1])
        if abs(first.puller - setpoint) > 0.2 * setpoint:
            raise RigError(
                f"reel X read {first.puller:.4g} N at a setpoint of {setpoint:g} N; let it settle "
                "longer or tune its tension controller"
            )
        second = self._pull(bench, "y", first.holder, first.holder_before, homes[0])
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
        pulling: Literal["x", "y"],
        setpoint: float,
        preload: float,
        home: float,
    ) -> _Held:
        """One reel pulls from the preload up to the setpoint and the other holds."""
        holding: Literal["x", "y"] = "y" if pulling == "x" else "x"
        puller, holder = _reel(bench, pulling), _reel(bench, holding)
        # At the higher tension the cable stays taut while the held drum returns.
        puller.hold_tension(setpoint, self.approach_s)
        bench.record(self.approach_s)
        holder.hold_position(home)
        self._wait_for_home(bench, holding, home)
        puller.hold_tension(preload, self.approach_s)
        before = bench.record(self.approach_s + self.relief_s)
        if self.holding != "position":
            holder.hold_velocity(0.0)
        puller.hold_tension(setpoint, self.approach_s)
        bench.record(self.approach_s + self.settle_s)
        if self.holding == "breakout":
            taken = self._break_out(bench, holding)
        elif self.holding == "position":
            taken = self._read_at_rest(bench, holding)
        else:
            holder.hold_velocity(-self.velocity_m_s / holder.drum_radius_m)
            bench.record(self.settle_s)
            taken = bench.record(self.read_s)
        holder.hold_position()
        tail = before.time_s > before.time_s[-1] - self.relief_s / 3.0
        return _Held(
            puller=mean_reading(_side(taken, pulling).gauge),
            holder=mean_reading(_side(taken, holding).gauge),
            holder_before=mean_reading(_side(before, holding).gauge[tail]),
        )

    def _wait_for_home(self, bench: Bench, holding: Literal["x", "y"], home: float) -> None:
        """Waits until the held drum is back at its position, as each measurement needs."""
        radius = _reel(bench, holding).drum_radius_m
        away = math.inf
        while away > self.breakout_m:
            before = away
            angle = _side(bench.record(_NOTICE_s), holding).angle_rad
            away = abs(mean_reading(angle[-1:]) - home) * radius
            if not away < before:
                raise RigError(
                    f"reel {holding.upper()} stays {away * 1e3:.3g} mm from its position; check "
                    "its position controller"
                )

    def _read_at_rest(self, bench: Bench, holding: Literal["x", "y"]) -> BenchRecord:
        """Reads while the held drum rests."""
        record = bench.record(self.read_s)
        angle = _side(record, holding).angle_rad
        moved = float(np.ptp(angle)) * _reel(bench, holding).drum_radius_m
        if moved > self.breakout_m:
            raise RigError(
                f"reel {holding.upper()} moved by {moved * 1e3:.3g} mm while it held its "
                "position; let it settle longer, or slow the tension controller of the other reel"
            )
        return record

    def _break_out(self, bench: Bench, holding: Literal["x", "y"]) -> BenchRecord:
        """Lets the held reel give way until the cable slides, and returns the readings from there.

        The first counts of the encoder may be the cable inside the reel that shortens.
        """
        reel = _reel(bench, holding)
        start = mean_reading(_side(bench.record(_CHUNK_s), holding).angle_rad)
        reel.hold_velocity(0.0, -self.breakout_slope_N_s)
        records: list[BenchRecord] = []
        moved = np.zeros(0)
        while not moved.size or moved[-1] < self.breakout_m + self.travel_m:
            if len(records) * _CHUNK_s > _PATIENCE_s:
                raise RigError(
                    f"reel {holding.upper()} did not break out within {_PATIENCE_s:g} s of a ramp "
                    f"of {self.breakout_slope_N_s:g} N/s; use a steeper one"
                )
            records.append(bench.record(_CHUNK_s))
            angles = np.concatenate([_side(r, holding).angle_rad for r in records])
            moved = (start - angles) * reel.drum_radius_m
        return _cut(
            _joined(records), int(np.flatnonzero(moved < self.breakout_m).max(initial=-1)) + 1
        )


def _reel(bench: Bench, which: Literal["x", "y"]) -> BenchReel:
    return bench.x if which == "x" else bench.y


def _side(record: BenchRecord, which: Literal["x", "y"]) -> BenchReading:
    return record.x if which == "x" else record.y


def _joined(records: list[BenchRecord]) -> BenchRecord:
    return BenchRecord(
        np.concatenate([r.time_s for r in records]),
        *(
            BenchReading(
                np.concatenate([_side(r, which).gauge for r in records]),
                np.concatenate([_side(r, which).angle_rad for r in records]),
            )
            for which in ("x", "y")
        ),
    )


def _cut(record: BenchRecord, start: int) -> BenchRecord:
    return BenchRecord(
        record.time_s[start:],
        *(BenchReading(*(column[start:] for column in side)) for side in (record.x, record.y)),
    )


def mean_reading(column: FloatArray) -> float:
    """The mean of a column.

    Raises:
        RigError: there is nothing in it, or a value is not finite.
    """
    if column.size == 0 or not np.isfinite(column).all():
        raise RigError(
            "a reel gave no reading, or one that is not finite; check gauge and encoder"
        )
    return float(column.mean())
