"""A reel between two samples: its phase, its parts, and what its transitions have in common."""

import math

from estune.hardware.compensation.runtime import Compensation
from estune.hardware.controller import Controller
from estune.hardware.guard_watch import GuardWatch
from estune.hardware.hybrid_control import HybridControl
from estune.hardware.loop_messages import Ended, LoopPlan, Refused
from estune.hardware.reel_machine.held_setpoint import HeldSetpoint
from estune.hardware.reel_machine.reel_control import ReelControl
from estune.hardware.reel_machine.requested_trial import RequestedTrial
from estune.hardware.shared_memory import Memory, MotionPhase, SensorLevels
from estune.trial import Outcome


class ReelState:
    """State of a reel between samples.

    Attributes:
        answer: Result of the requested trial; the loop takes and resets it.
        latched: Whether it takes no trial until it is cleared.
        ramp_step_N: Change of the effort at each sample on its way to the safe state.
    """

    def __init__(
        self,
        plan: LoopPlan,
        memory: Memory,
        controller: Controller,
        compensation: Compensation,
        hybrid: HybridControl | None,
    ) -> None:
        self.plan, self.memory = plan, memory
        self.phase = MotionPhase.OFF
        self.answer: Ended | Refused | None = None
        self.latched = False
        self.effort_N = self.angle_rad = self.ramp_step_N = 0.0
        self.guard = GuardWatch(plan, memory)
        self.setpoint = HeldSetpoint(plan, memory)
        self.trial = RequestedTrial(plan, memory)
        self.control = ReelControl(plan, controller, compensation, hybrid)

    def end_trial(self, outcome: Outcome, sentence: str, kept: int) -> None:
        """Ends the running trial after so many samples, and restores the live gains."""
        trial, memory = self.trial.under_way, self.memory
        self.answer = Ended(trial.number, kept, outcome, sentence, self.trial.first_s)
        self.trial.request = None
        self.phase = MotionPhase.HOLD
        self.guard.end_trial()
        self.control.use_live()
        last_N = memory.setpoint_N[kept - 1]
        now_N = memory.levels[SensorLevels.TENSION_N]
        self.setpoint.start_at(now_N if trial.open_loop else last_N)

    def refuse_trial(self, outcome: Outcome, sentence: str) -> None:
        """Ends a requested trial that has not begun, if there is one."""
        trial, self.trial.request = self.trial.request, None
        if trial is None:
            return
        if outcome is Outcome.CANCELLED:
            self.answer = Ended(trial.number, 0, outcome, sentence, math.nan)
        else:
            self.answer = Refused(f"it stopped before the trial began: {sentence}")

    def begin_take_up(self) -> None:
        """Winds slack cable from the next sample on; the guard forgets what it saw before."""
        self.phase = MotionPhase.TAKE_UP
        self.guard.restart()

    def begin_ramp(self) -> None:
        """Begins to bring the effort to that of the safe state."""
        samples = max(1, round(self.plan.safe.ramp_s * self.plan.sampling_Hz))
        self.ramp_step_N = (self.plan.safe.effort_N - self.effort_N) / samples
        self.phase = MotionPhase.RAMP

    def latch(self, sentence: str) -> None:
        """Takes no trial until it is cleared."""
        self.memory.reason = sentence
        self.latched = True
