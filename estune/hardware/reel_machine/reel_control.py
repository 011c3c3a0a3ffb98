"""The controllers of a reel: live gains, gains of a trial, position control, compensations."""

import math

from estune.core.pidf import Coefficients
from estune.hardware.compensation.plan import (
    NO_COMPENSATION,
    CompensationPlan,
    CompensationTerms,
    KnownMotion,
)
from estune.hardware.compensation.runtime import Compensation, make_compensation
from estune.hardware.controller import Controller
from estune.hardware.hybrid_control import HybridControl
from estune.hardware.live_gains import LiveGains
from estune.hardware.loop_messages import BeginTrial, LoopPlan
from estune.hardware.reel_machine.held_setpoint import HeldSetpoint
from estune.reel.hybrid import HybridSignals


class ReelControl:
    """Effort of a closed loop, whose gains change without a jump of it.

    Attributes:
        limited: Whether a limit acted at this sample.
    """

    def __init__(
        self,
        plan: LoopPlan,
        controller: Controller,
        compensation: Compensation,
        hybrid: HybridControl | None,
    ) -> None:
        self.limited = False
        self._controller, self._compensation, self._hybrid = controller, compensation, hybrid
        self._live = LiveGains(plan.live, plan.length_source)
        self._low_N, self._high_N = plan.effort_min_N, plan.effort_max_N
        self._own = plan.compensation, plan.compensation_source
        self._borrowed: tuple[CompensationPlan | None, str] | None = None  # of a trial
        self._filtered_N = math.nan
        self._pending = False  # whether the gains or the setpoint were exchanged
        controller.use(plan.live)

    @property
    def in_position(self) -> bool:
        """Whether the position is controlled, not the tension."""
        return self._hybrid is not None and not self._hybrid.in_tension

    @property
    def operating_point(self) -> tuple[float, float]:
        """Cable length in m and tension in N that the live gains are for; NaN if fixed."""
        return self._live.operating_point

    def select_compensation(self, trial: BeginTrial | None) -> None:
        """Compensates as the requested trial asks for, without a jump of the effort."""
        wanted = None if trial is None else trial.compensation
        if wanted is not self._borrowed:
            self._borrowed = wanted
            self._compensation = make_compensation(*(wanted or self._own))
            self._pending = True

    def set_compensation(self, plan: CompensationPlan | None, source: str) -> None:
        """Exchanges the rig's own compensations, without a jump of the effort."""
        self._own = plan, source
        if self._borrowed is None:
            self._compensation = make_compensation(plan, source)
            self._pending = True

    def compensate(
        self,
        time_s: float,
        gauge_N: float,
        angle_rad: float,
        far_end_m_s: float,
        *,
        is_open: bool,
    ) -> CompensationTerms:
        """The compensations at this sample; in an open loop they would alter what is asked for."""
        known = KnownMotion(math.nan if is_open else self._filtered_N, far_end_m_s)
        terms = self._compensation.sample(time_s, gauge_N, angle_rad, known)
        if is_open:
            terms = NO_COMPENSATION._replace(velocity_rad_s=terms.velocity_rad_s)
        self._controller.beside(terms.feed_forward_N, terms.limit_N)
        return terms

    def note_setpoint(self, *, closed: bool) -> None:
        """Notes the filtered setpoint, along which friction is fed forward in a closed loop."""
        known = closed and not self.in_position
        self._filtered_N = self._controller.filtered_setpoint_N if known else math.nan

    def fix_live(self, live: Coefficients) -> None:
        """Makes gains the live ones, at any length."""
        self._live.fix(live)

    def use_live(self) -> None:
        """Exchanges the gains for the live ones, without a jump of the effort."""
        self._controller.use(self._live.coefficients)
        self._pending = True

    def use_trial(self, trial: BeginTrial) -> None:
        """Exchanges the gains for those of a trial, likewise."""
        if not trial.open_loop:
            self._controller.use(trial.coefficients)
            self._pending = True

    def close(self, tension_N: float, effort_N: float) -> None:
        """Closes the loop by the live gains, as if the reel had rested here."""
        if self._hybrid is not None:
            self._hybrid.pause()
        self._controller.use(self._live.coefficients)
        self._controller.rest(tension_N, effort_N)
        self._pending = True

    def rest(self, tension_N: float, setpoint_N: float) -> None:
        """Starts the live gains as if the reel had settled here.

        Not bumpless: the last effort is that of gains which have just failed.
        """
        self._controller.rest(tension_N, setpoint_N)
        self._pending = False

    def hold(
        self,
        setpoint: HeldSetpoint,
        tension_N: float,
        angle_rad: float,
        effort_N: float,
        *,
        tension_only: bool,
    ) -> float:
        """Effort at a sample between trials, N."""
        changed = self._live.update(angle_rad, setpoint.tension_N)
        if self._pending:
            self._controller.use(self._live.coefficients)
            self._take_over(setpoint.tension_N, tension_N, effort_N)
        elif changed:
            self._controller.exchange(self._live.coefficients, setpoint.tension_N, tension_N)
        solved = tension_only or not setpoint.follows or math.isnan(setpoint.target_rad)
        hybrid = self._hybrid
        if hybrid is None or (solved and hybrid.in_tension):
            if hybrid is not None:
                hybrid.pause()
            return self._track(setpoint.tension_N, tension_N)
        in_tension, setpoint.tension_N = hybrid.select(
            tension_N, setpoint.tension_N, setpoint.within_limits(tension_N), solved=solved
        )
        radius = hybrid.plan.drum_radius_m
        target = angle_rad if math.isnan(setpoint.target_rad) else setpoint.target_rad
        signals = HybridSignals(radius * target, radius * angle_rad, setpoint.tension_N, tension_N)
        effort = hybrid.step(signals, in_tension=in_tension)
        self.limited = hybrid.limited
        return effort

    def run(
        self, trial: BeginTrial, setpoint_N: float, tension_N: float, effort_N: float
    ) -> float:
        """Effort at a sample of a trial, N."""
        if self._pending:
            self._take_over(setpoint_N, tension_N, effort_N)
        effort = self._track(setpoint_N, tension_N)
        if trial.open_loop:  # the controller runs along for its filters only
            effort = min(max(setpoint_N, self._low_N), self._high_N)
            self.limited = effort != setpoint_N
        return effort

    def _take_over(self, setpoint_N: float, tension_N: float, effort_N: float) -> None:
        self._controller.take_over(setpoint_N, tension_N, effort_N)
        self._pending = False

    def _track(self, setpoint_N: float, tension_N: float) -> float:
        effort = self._controller.step(setpoint_N, tension_N)
        self.limited = self._controller.limited
        return effort
