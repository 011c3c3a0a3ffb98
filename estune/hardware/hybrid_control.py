"""Position control beside the tension control of the loop, with the hand-over (36) and (37).

The equations are those of `estune.reel.hybrid`, on the controllers of the loop.
"""

from dataclasses import dataclass

from estune.core.pidf import Coefficients
from estune.hardware.controller import Controller, make_controller
from estune.reel.hybrid import HybridSignals, SwitchingRules


@dataclass(frozen=True, slots=True)
class HybridPlan:
    """Position control of a loop.

    Attributes:
        position: Difference equation of the position controller; its input is the cable wound in,
            m, its output the effort, N.
        drum_radius_m: Cable wound in per radian, m.
    """

    rules: SwitchingRules
    position: Coefficients
    drum_radius_m: float


class HybridControl:
    """Two controllers; the one that is not selected tracks the effort of the other.

    Attributes:
        in_tension: The selection at the last sample.
    """

    def __init__(self, plan: HybridPlan, tension: Controller, position: Controller) -> None:
        self.plan = plan
        self.in_tension = True
        self.limited = False
        self._tension, self._position = tension, position
        self._tracks = False
        position.use(plan.position)

    def pause(self) -> None:
        """Selects tension control, alone; the position controller begins at rest next time."""
        self.in_tension, self._tracks = True, False

    def select(
        self, tension_N: float, setpoint_N: float, held_N: float, *, solved: bool
    ) -> tuple[bool, float]:
        """Whether tension is to be controlled, and its setpoint, N.

        Args:
            held_N: Setpoint from which tension control begins, N.
            solved: Whether no source asks for position control.
        """
        in_tension = bool(self.plan.rules.select(self.in_tension, tension_N, solved))
        if not in_tension or (solved and not self.in_tension):
            return in_tension, held_N
        if solved:
            return True, setpoint_N
        return True, self.plan.rules.tension_setpoint_N(0.0, solved=False)

    def step(self, signals: HybridSignals, *, in_tension: bool) -> float:
        """One sample; the effort of the selected controller, N.

        At a change of the selection the effort is, to rounding, that without the change.
        """
        if not self._tracks:
            self._position.rest(signals.position_m, 0.0)  # its integral follows the effort below
            self._tracks = True
        self._position.beside(self._tension.forward_N, self._tension.drive_N)
        of_position, of_tension = signals[:2], signals[2:]
        if self.in_tension:
            active, other, own, others = self._tension, self._position, of_tension, of_position
        else:
            active, other, own, others = self._position, self._tension, of_position, of_tension
        effort = active.step(*own)
        other.take_over(*others, effort)
        following = other.step(*others)
        self.limited = active.limited
        if in_tension is not self.in_tension:
            effort, self.in_tension = following, in_tension
        return effort


def make_hybrid(plan: HybridPlan | None, tension: Controller, source: str) -> HybridControl | None:
    """Hybrid control with a position controller of the same C text; None where it is off."""
    return HybridControl(plan, tension, make_controller(source)[0]) if plan else None
