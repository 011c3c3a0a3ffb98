"""The trial that a rig has requested, before and while it runs."""

import math

from estune.hardware.loop_messages import BeginTrial, LoopPlan, Refused
from estune.hardware.shared_memory import Memory, Word


class RequestedTrial:
    """The requested trial, if any.

    Attributes:
        request: What the rig has requested; None without a trial.
    """

    def __init__(self, plan: LoopPlan, memory: Memory) -> None:
        self.request: BeginTrial | None = None
        self.k = 0
        self.first_s = math.nan
        self._motion, self._rate, self._memory = plan.motion, plan.sampling_Hz, memory
        self._words = plan.guard.words
        self._settled = self._at_preload = 0

    def note(self, request: BeginTrial) -> None:
        """Notes a request."""
        self.request = request
        self._memory.words[Word.PROGRESS] = 0
        self._settled = self._at_preload = 0

    @property
    def preload_N(self) -> float | None:
        """Tension from which it starts, N; None without a trial."""
        return None if self.request is None else self._memory.setpoint_N[0]

    @property
    def under_way(self) -> BeginTrial:
        """The running trial."""
        assert self.request is not None  # noqa: S101  the phase says so
        return self.request

    def is_settled(self, setpoint_N: float, tension_N: float) -> bool | Refused:
        """Whether the tension has stayed at the preload for long enough, or why it will not."""
        motion, preload = self._motion, self._memory.setpoint_N[0]
        if setpoint_N != preload:
            return False
        self._at_preload += 1
        near = abs(tension_N - preload) <= motion.settle_N
        self._settled = self._settled + 1 if near else 0
        if self._settled > motion.settle_s * self._rate:
            return True
        if self._at_preload <= motion.settle_within_s * self._rate:
            return False
        measured, unit = self._words.measured, self._words.measured_unit
        return Refused(
            f"the live gains have not kept the {measured} within {motion.settle_N:g} {unit} of "
            f"the preload {preload:g} {unit} for {motion.settle_s:g} s, after "
            f"{motion.settle_within_s:g} s: it is {tension_N:.4g} {unit}"
        )

    def next_setpoint(self, time_s: float) -> float:
        """The setpoint of the next sample, N."""
        if self.k == 0:
            self.first_s = time_s
        self.k += 1
        setpoint_N: float = self._memory.setpoint_N[self.k - 1]
        return setpoint_N
