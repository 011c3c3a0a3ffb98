"""The setpoint of a reel between trials."""

import math

from estune.hardware.loop_messages import LoopPlan
from estune.hardware.shared_memory import Memory, Word
from estune.trial import SETPOINT_S


class HeldSetpoint:
    """Setpoint between trials: on its way to a tension at a limited rate, or from above."""

    def __init__(self, plan: LoopPlan, memory: Memory) -> None:
        self.tension_N = plan.motion.hold_N
        self.follows = False
        self._memory = memory
        self._low_N, self._high_N = plan.tension_min_N, plan.tension_max_N
        self._hold_N = plan.motion.hold_N
        self._step_N = plan.motion.rate_N_s / plan.sampling_Hz
        self._count = 0  # setpoints from above that were taken
        self._in_force_until_s = -math.inf

    @property
    def target_rad(self) -> float:
        """Angle at which a source above wants the drum; NaN where it wants a tension."""
        target_rad: float = self._memory.target_rad[0]
        return target_rad

    @property
    def far_end_m_s(self) -> float:
        """Velocity of the cable's far end, as far as a source above knows it, m/s."""
        return self._memory.far_end_m_s[0] if self.follows else 0.0

    def take(self, time_s: float) -> bool:
        """Notes a setpoint from above; whether it is the first of a stream."""
        count, begins = self._memory.words[Word.SETPOINTS], False
        if count != self._count:
            begins = time_s > self._in_force_until_s
            self._count, self._in_force_until_s = count, time_s + SETPOINT_S
        self.follows = time_s <= self._in_force_until_s
        return begins

    def move(self, preload_N: float | None) -> None:
        """Moves on for a sample, to the preload of a requested trial if there is one."""
        if preload_N is None and self.follows:
            self.tension_N = self._memory.target_N[0]
            return
        target = self._hold_N if preload_N is None else preload_N
        self.tension_N += min(max(target - self.tension_N, -self._step_N), self._step_N)

    def start_at(self, tension_N: float) -> None:
        """Starts here, within its limits."""
        self.tension_N = self.within_limits(tension_N)

    def within_limits(self, tension_N: float) -> float:
        """A tension within the limits of setpoints, N."""
        return min(max(tension_N, self._low_N), self._high_N)
