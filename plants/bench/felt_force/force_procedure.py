"""The test of the force that a reel exerts while the far end of its cable moves.

The reel under test controls a constant tension. The far end first rests, then moves back and forth
at a constant speed, then in many frequencies at once. At last it moves at the constant speed again
while the command oscillates in many frequencies: in a cable at rest, the friction of the eyelet
keeps such an oscillation from the outside. An outside sensor reads the force at the cable.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple, Protocol

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray, check_positive
from estune.errors import InvalidInput


class BenchPhase(StrEnum):
    """Part of the test."""

    REST = "rest"
    SLOW = "slow"
    FAST = "fast"
    COMMAND = "command"


class ForceSample(NamedTuple):
    """Readings of one period.

    Attributes:
        felt_N: Force at the cable by the outside sensor, N.
        position_m: Position of the far end, m, away from the reel.
    """

    time_s: float
    felt_N: float
    tension_N: float
    position_m: float


class ForceBench(Protocol):
    """A reel under test and what moves the far end of its cable."""

    @property
    def period_s(self) -> float:
        """Time from one exchange to the next, s."""

    def use(self, gains: Gains) -> None:
        """Makes gains the live ones of the reel under test."""

    def exchange(self, command_N: float, position_m: float) -> ForceSample:
        """Commands a tension and a position of the far end for one period."""


@dataclass(frozen=True)
class ForceRecord:
    """Columns of a test at one command; each has shape (samples,)."""

    command_N: float  # the constant force
    phase: list[BenchPhase]
    setpoint_N: FloatArray  # the command with its oscillation, N
    time_s: FloatArray
    felt_N: FloatArray
    tension_N: FloatArray
    position_m: FloatArray

    def of(self, phase: BenchPhase) -> "ForceRecord":
        """One part of the test, without the second in which it settles."""
        rows = np.flatnonzero([each is phase for each in self.phase])
        rows = rows[self.time_s[rows] - self.time_s[rows[0]] >= SETTLE_S]
        columns = (self.setpoint_N, self.time_s, self.felt_N, self.tension_N, self.position_m)
        return ForceRecord(self.command_N, [phase] * rows.size, *(c[rows] for c in columns))


_Command = Callable[[float], tuple[float, float]]
"""Force above the constant one, N, and position of the far end, m, at a time in the part, s."""

SETTLE_S = 1.0
"""Time left out at the beginning of each part, s; ten times the slowest lag of the reels."""


@dataclass(frozen=True)
class ForceTest:
    """Plan of the test at one constant force.

    Attributes:
        stroke_m: Peak-to-peak slow motion of the far end, m.
        speed_m_s: Speed of the slow motion, m/s.
        motion_m: Peak-to-peak fast motion of the far end, m.
        motion_Hz: Lowest and highest frequency of the fast motion.
        oscillation_N: Peak-to-peak oscillation of the command, N; it lies above the command.
        command_Hz: Lowest and highest frequency of the oscillation.
        part_s: Duration of each part but the first, s.
    """

    stroke_m: float = 0.06
    speed_m_s: float = 0.03
    motion_m: float = 0.03
    motion_Hz: tuple[float, float] = (0.5, 4.0)
    oscillation_N: float = 3.0
    command_Hz: tuple[float, float] = (1.0, 40.0)
    lines: int = 16
    part_s: float = 9.0

    def __post_init__(self) -> None:
        for name in ("stroke_m", "speed_m_s", "motion_m", "oscillation_N", "part_s"):
            check_positive(name, getattr(self, name))
        for name in ("motion_Hz", "command_Hz"):
            low, high = getattr(self, name)
            if not 2.0 / (self.part_s - SETTLE_S) <= low < high:
                raise InvalidInput(
                    f"{name} from {low:g} to {high:g} Hz in {self.part_s:g} s: the lowest must "
                    "have two periods after the first second, and be below the highest"
                )

    @property
    def duration_s(self) -> float:
        """Duration of the test at one force, s."""
        return SETTLE_S + 3.0 * self.part_s

    def frequencies_Hz(self, band: tuple[float, float], period_s: float) -> FloatArray:
        """The frequencies of a band, evenly spread over its logarithm, below half the rate."""
        high = min(band[1], 0.4 / period_s)
        return np.asarray(np.geomspace(band[0], high, self.lines))

    def run(self, bench: ForceBench, command_N: float) -> ForceRecord:
        """Runs the test at one constant force.

        Raises:
            EstuneError: the bench fails, or refuses a command.
        """
        rows, phases = [], []
        sample = bench.exchange(command_N, 0.0)
        for phase, duration_s, command in self._parts(bench.period_s):
            start_s = sample.time_s
            # By the time that has passed: a bench in real time may miss a period.
            while (passed_s := sample.time_s + bench.period_s - start_s) <= duration_s:
                above_N, position_m = command(passed_s)
                before_s, sample = sample.time_s, bench.exchange(command_N + above_N, position_m)
                if sample.time_s > before_s:  # else the reply was late
                    rows.append((command_N + above_N, *sample))
                    phases.append(phase)
        return ForceRecord(command_N, phases, *np.array(rows).T)

    def _parts(self, period_s: float) -> Iterator[tuple[BenchPhase, float, _Command]]:
        """Each part with its duration, s, and its command."""
        fast = self._oscillation(self.frequencies_Hz(self.motion_Hz, period_s), power=1.0)
        wave = self._oscillation(self.frequencies_Hz(self.command_Hz, period_s), power=0.0)
        half_N = 0.5 * self.oscillation_N
        yield BenchPhase.REST, SETTLE_S, lambda _: (0.0, 0.0)
        yield BenchPhase.SLOW, self.part_s, lambda t: (0.0, self._slow_m(t))
        yield BenchPhase.FAST, self.part_s, lambda t: (0.0, 0.5 * self.motion_m * fast(t))
        yield (
            BenchPhase.COMMAND,
            self.part_s,
            lambda t: (half_N * (1.0 + wave(t)), self._slow_m(t)),
        )

    def _slow_m(self, time_s: float) -> float:
        """Back and forth at a constant speed."""
        return self.stroke_m * (1.0 - abs(1.0 - self.speed_m_s / self.stroke_m * time_s % 2.0))

    def _oscillation(self, frequencies_Hz: FloatArray, power: float) -> Callable[[float], float]:
        """Sines of low crest factor (Schroeder 1970), faded in; at most 1.

        Their amplitudes fall with the frequency to this power: with 1, speeds are the same.
        """
        number = np.arange(frequencies_Hz.size)
        phases = -math.pi * number * (number + 1) / frequencies_Hz.size
        omega, amplitudes = 2.0 * np.pi * frequencies_Hz, frequencies_Hz**-power
        times_s = np.arange(0.0, self.part_s, 1e-3)
        peak = np.abs(np.sin(np.outer(times_s, omega) + phases) @ amplitudes).max()

        def wave(time_s: float) -> float:
            value = float(np.sin(omega * time_s + phases) @ amplitudes / peak)
            return value * min(2.0 * time_s / SETTLE_S, 1.0)

        return wave
