"""The guard around the loop: which limits are in force at a sample, and what it has seen."""

import math
from dataclasses import replace

from estune.hardware.loop_messages import BeginTrial, LoopPlan
from estune.hardware.shared_memory import Memory, MotionPhase
from estune.reel import guard
from estune.reel.guard import GuardState, GuardTrip, Limits, Reason, Sample


class GuardWatch:
    """The guard of one reel, with its state between samples."""

    def __init__(self, plan: LoopPlan, memory: Memory) -> None:
        self._motion, self._memory = plan.motion, memory
        self._usual = self._limits = plan.guard
        self._taking_up, self._recovering = _relaxed(plan)
        self._recover_until_s = -math.inf
        self._state: GuardState | None = None
        self._cost = 0.0

    def restart(self) -> None:
        """Forgets what was seen: the reel has been at rest."""
        self._state, self._recover_until_s = None, -math.inf

    def begin_trial(self, trial: BeginTrial) -> None:
        """Adds the limits of a trial."""
        self._cost = 0.0
        # Else its gains would run within the wide limits of the recovery from those before.
        self._recover_until_s = -math.inf
        self._limits = replace(self._usual, cost_max=trial.cost_max, duration_s=trial.duration_s)

    def end_trial(self) -> None:
        """Removes the limits of the trial."""
        self._limits = self._usual

    def relax_until(self, time_s: float) -> None:
        """Lets the live gains bring the reel back within its limits until a time, s."""
        self._recover_until_s = time_s

    def check(self, phase: MotionPhase, sample: Sample, k: int) -> GuardTrip | None:
        """Reason to stop at this sample, if any; in a trial its sample k."""
        state = self._state or guard.begin(sample)
        if phase is MotionPhase.TRIAL:
            error_N = self._memory.setpoint_N[k] - sample.tension_N
            self._cost += self._memory.weights[k] * error_N**2
            sample = sample._replace(cost=self._cost)
            # Travel and time of the hold before it would be counted against the trial.
            if k == 0:
                state = state._replace(start_s=sample.time_s, start_rad=sample.angle_rad)
        limits = self._limits
        if phase is MotionPhase.TAKE_UP:
            limits = self._taking_up
        elif sample.time_s < self._recover_until_s:
            limits = self._recovering
        self._state, stop = guard.check_sample(limits, state, sample)
        if stop is None or phase is not MotionPhase.TAKE_UP or stop.reason is not Reason.DEADLINE:
            return stop
        return GuardTrip(
            Reason.DEADLINE,
            f"no tension above {self._motion.taut_N:g} N within {self._motion.take_up_s:g} s of "
            "taking the cable up; is it attached, the gauge connected, the direction right?",
        )


def _relaxed(plan: LoopPlan) -> tuple[Limits, Limits]:
    """Limits while a slack cable is taken up, and while the live gains recover the reel."""
    unlimited = Limits()
    # A slack cable has no tension, and jerks as it becomes taut; all else stays guarded, and it
    # must become taut in time, or an unattached drum would wind for ever.
    take_up = replace(
        plan.guard,
        slack_N=unlimited.slack_N,
        rate_max_N_s=unlimited.rate_max_N_s,
        duration_s=plan.motion.take_up_s,
    )
    # The limits that the trial's gains have just crossed; angle, travel and sensors stay guarded.
    recovering = replace(
        plan.guard,
        tension_max_N=unlimited.tension_max_N,
        slack_N=unlimited.slack_N,
        rate_max_N_s=unlimited.rate_max_N_s,
        current_max_A=unlimited.current_max_A,
    )
    return take_up, recovering
