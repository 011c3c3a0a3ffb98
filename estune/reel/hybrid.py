"""Hybrid control of a reel: a position PIDF, a tension PIDF, and the selection S between them.

Position is the length of cable wound in, m, so that the efforts of both controllers, N, pull the
cable in and have the same limits. The inactive controller tracks the active one: at every sample
its integral is set to the value that gives the same effort. A switch is then bumpless. The
functions take floats, or arrays with one element per reel, where the selection is the diagonal of
the paper's matrix S.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from estune.core.pidf import Coefficients, PidfState, Signal, bumpless
from estune.core.pidf import step as pidf_step
from estune.core.quantities import check_positive

Selection = Any
"""True for tension control, False for position control: a bool, or an array."""


@dataclass(frozen=True, slots=True)
class SwitchingRules:
    """Rules that select tension or position control, and the tension setpoint.

    Attributes:
        tension_min_N: Least tension tau_min; below it the cable sags too much. Above zero.
        margin_N: Hysteresis above the least tension before a reel that tightened a slack cable
            returns to position control; above zero, or noise would switch at every sample.

    Raises:
        InvalidInput: a value is not finite or not above zero.
    """

    tension_min_N: float
    margin_N: float

    def __post_init__(self) -> None:
        check_positive("tension_min_N", self.tension_min_N)
        check_positive("margin_N", self.margin_N)

    def select(self, previous: Selection, tension_N: Signal, solved: Selection) -> Selection:
        """The selection S by the rules of the paper's section V.

        * The tension distribution has a solution: tension control; without one: position control.
        * The tension is below the least one: tension control in any case, until it is a margin
          above, so that the cable does not sag.

        Args:
            previous: The selection at the last sample.
            solved: Whether the tension distribution has a solution.
        """
        release = self.tension_min_N + np.where(previous, self.margin_N, 0.0)
        selected = np.asarray(solved, dtype=np.bool_) | (np.asarray(tension_N) < release)
        return selected if selected.ndim else bool(selected)

    def tension_setpoint_N(self, distributed_N: Signal, solved: Selection) -> Signal:
        """The tension setpoint: the distributed one, or two margins above the least.

        The latter lies above the hysteresis of `select`, so that a slack cable is always wound in.

        Args:
            distributed_N: Tension by the distribution, N; unused if it has no solution.
            solved: Whether it has a solution.
        """
        hold = self.tension_min_N + 2.0 * self.margin_N
        setpoint = np.where(solved, np.maximum(distributed_N, self.tension_min_N), hold)
        return setpoint if setpoint.ndim else float(setpoint)


class HybridCoefficients(NamedTuple):
    """Both difference equations, from `estune.core.pidf.coefficients`, with equal limits."""

    position: Coefficients
    tension: Coefficients


class HybridState(NamedTuple):
    """The state of the hybrid controller between samples."""

    position: PidfState
    tension: PidfState
    in_tension: Selection


class HybridSignals(NamedTuple):
    """Inputs of both controllers at a sample; positions in m wound in, tensions in N."""

    position_setpoint_m: Signal
    position_m: Signal
    tension_setpoint_N: Signal
    tension_N: Signal


def hand_over(
    c: Coefficients, state: PidfState, setpoint: Signal, measurement: Signal, effort_N: Signal
) -> tuple[PidfState, Signal]:
    """One sample of the inactive controller, which tracks the effort of the active one.

    Implements (36) and (37).

    The paper prints two lines, numbered (36) alone,

        int e_t dt = I_t/s_p,    int e_p dt = I_p/s_t,

    cites (36) and (37), and does not define I_t, I_p, s_p and s_t. The derivation here: let s_p be
    the effort of the active position controller. The tension controller gives the same effort if

        P_t e_t + I_t int e_t dt - D_t dy_t/dt = s_p,

    and vice versa with s_t the effort of the tension controller. Hence

        I_t int e_t dt = s_p - P_t e_t + D_t dy_t/dt     (36), position to tension
        I_p int e_p dt = s_t - P_p e_p + D_p dy_p/dt     (37), tension to position

    with e the error after the setpoint filter and dy/dt the filtered derivative. For a controller
    without error and at rest, as at the boundary with the platform held, they become
    int e_t dt = s_p/I_t and int e_p dt = s_t/I_p: the printed pair with each quotient inverted.
    With I the integral gain, as everywhere else in the paper, the printed quotients have the
    inverse unit of an integral.

    The state holds the product I int e dt (`integral`), so that a controller without integral
    action takes over as well; it then keeps the offset.

    Args:
        c: The difference equation of the inactive controller.
        state: Its state.
        setpoint: Its setpoint.
        measurement: Its measurement.
        effort_N: The effort s of the active controller, N, within the limits of both.

    Returns:
        Its next state, and its effort at this sample: `effort_N` to rounding.
    """
    following, effort, _ = pidf_step(
        c, bumpless(c, state, setpoint, measurement, effort_N), setpoint, measurement
    )
    return following, effort


def step(
    c: HybridCoefficients, state: HybridState, signals: HybridSignals, in_tension: Selection
) -> tuple[HybridState, Signal]:
    """One sample of the hybrid controller.

    The controller selected at the last sample computes the effort, and the other tracks it; then
    the selection changes. So the effort at a switch is, to rounding, that without the switch.

    Args:
        c: Both difference equations.
        state: After the last sample.
        signals: Inputs of both controllers.
        in_tension: The selection S, from `SwitchingRules.select`.

    Returns:
        The next state, and the effort of the selected controller, N.
    """
    r_p, y_p, r_t, y_t = signals
    position, s_p, _ = pidf_step(c.position, state.position, r_p, y_p)
    tension, s_t, _ = pidf_step(c.tension, state.tension, r_t, y_t)
    followed_p, follows_p = hand_over(c.position, state.position, r_p, y_p, s_t)  # (37)
    followed_t, follows_t = hand_over(c.tension, state.tension, r_t, y_t, s_p)  # (36)

    was = state.in_tension
    position = PidfState(*(_either(was, a, b) for a, b in zip(followed_p, position, strict=True)))
    tension = PidfState(*(_either(was, a, b) for a, b in zip(tension, followed_t, strict=True)))
    effort = _either(in_tension, _either(was, s_t, follows_t), _either(was, follows_p, s_p))
    return HybridState(position, tension, in_tension), effort


def _either(choice: Selection, yes: Signal, no: Signal) -> Signal:
    """`yes` if chosen, else `no`; for one selection, or one for each reel."""
    if isinstance(choice, bool):
        return yes if choice else no
    return np.where(choice, yes, no)
