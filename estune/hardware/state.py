"""How a rig on hardware stands, and how its loop has kept its time: read from their memory."""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from estune.hardware.reel_state_machine import MotionPhase
from estune.hardware.shared_memory import BIN_s, Memory, SensorLevels, Word


class HardwareStatus(NamedTuple):
    """How a rig stands.

    Attributes:
        phase: What its loop does, as a word: off, take_up, hold, trial, ramp, stopped.
        reason: Why it last stopped; empty where it did not, or was cleared.
        latched: Whether it takes no trial until it is cleared.
        tension_N: Tension read last.
        setpoint_N: Setpoint between trials.
        current_A: Current commanded last.
        angle_rad: Angle read last.
    """

    phase: str
    reason: str
    latched: bool
    tension_N: float
    setpoint_N: float
    current_A: float
    angle_rad: float

    @classmethod
    def of(cls, memory: Memory) -> Self:
        """As the shared memory has it."""
        words, levels = memory.words, memory.levels
        return cls(
            phase=MotionPhase(words[Word.PHASE]).name.lower(),
            reason=memory.reason,
            latched=bool(words[Word.LATCHED] or words[Word.ESTOP]),
            tension_N=levels[SensorLevels.TENSION_N],
            setpoint_N=levels[SensorLevels.SETPOINT_N],
            current_A=levels[SensorLevels.CURRENT_A],
            angle_rad=levels[SensorLevels.ANGLE_rad],
        )


class Timing(NamedTuple):
    """How the loop has kept its time since it started.

    Attributes:
        samples: How many it has run.
        late: How many of them began late.
        missed: Sampling instants passed over altogether.
        bin_s: Width of a bin of the histograms; the last holds all that was longer.
        lateness: Samples by how long after its instant they began.
        turnaround: Samples by how long after its instant the current was commanded.
    """

    samples: int
    late: int
    missed: int
    bin_s: float
    lateness: NDArray[np.int64]
    turnaround: NDArray[np.int64]

    @classmethod
    def of(cls, memory: Memory) -> Self:
        """As the shared memory has it."""
        words = memory.words
        return cls(
            words[Word.SAMPLES],
            words[Word.LATE],
            words[Word.MISSED],
            BIN_s,
            np.array(memory.lateness),
            np.array(memory.turnaround),
        )

    def since(self, earlier: "Timing") -> "Timing":
        """The same from an earlier look on."""
        return Timing(
            self.samples - earlier.samples,
            self.late - earlier.late,
            self.missed - earlier.missed,
            self.bin_s,
            self.lateness - earlier.lateness,
            self.turnaround - earlier.turnaround,
        )
