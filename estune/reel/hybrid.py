"""Hybrid control of a reel: a position PIDF, a tension PIDF, and the selection S between them.

Position is the length of cable wound in, m, so that both controllers give an effort in N that
pulls the cable in, within the same limits. Whichever controls, the other follows it: at every
sample its integral is set so that it too would have given the effort that was given. A switch then
passes the effort on without a jump. The functions take floats, or arrays with one element per
reel, in which case the selection is the diagonal of the paper's matrix S.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from estune.core.pidf import Coefficients, PidfState, Signal, bumpless
from estune.core.pidf import step as pidf_step
from estune.errors import InvalidInput

Selection = Any
"""True where the tension is controlled, False where the position is: a bool, or an array."""


@dataclass(frozen=True, slots=True)
class SwitchingRules:
    """When to control tension and when position, and what tension to hold meanwhile.

    Attributes:
        tension_min_N: Least tension tau_min; below it the cable sags too much. Above zero.
        margin_N: How far the tension must rise above the least one before a reel that pulled a
            slack cable tight goes back to position control; above zero, or the two would
            alternate with every sample of noise.

    Raises:
        InvalidInput: a value is not finite or not above zero.
    """

    tension_min_N: float
    margin_N: float

    def __post_init__(self) -> None:
        for name in ("tension_min_N", "margin_N"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise InvalidInput(f"{name} is {value}; it must be finite and above zero")

    def select(self, previous: Selection, tension_N: Signal, solved: Selection) -> Selection:
        """The selection S by the rules of the paper's section V.

        * The tension distribution has no solution: position control.
        * It has one: tension control.
        * The tension is below the least one: tension control, whatever the distribution says, so
          that the cable does not sag; until it is a margin above.

        That the wrench sensor may move the platform while its position is controlled is
        `led_position`.

        Args:
            previous: The selection at the last sample.
            tension_N: Measured tension, N.
            solved: Whether the tension distribution has a solution.

        Returns:
            True where the tension is to be controlled; a bool for scalars, else an array.
        """
        release = self.tension_min_N + np.where(previous, self.margin_N, 0.0)
        selected = np.asarray(solved, dtype=np.bool_) | (np.asarray(tension_N) < release)
        return selected if selected.ndim else bool(selected)

    def tension_setpoint_N(self, distributed_N: Signal, solved: Selection) -> Signal:
        """The tension to be followed: what was distributed, or two margins above the least.

        The latter ends past the release of `select`, so that a slack cable is always wound in.

        Args:
            distributed_N: Tension the distribution asks for, N; not used where it has no solution.
            solved: Whether it has one.
        """
        hold = self.tension_min_N + 2.0 * self.margin_N
        setpoint = np.where(solved, np.maximum(distributed_N, self.tension_min_N), hold)
        return setpoint if setpoint.ndim else float(setpoint)


def led_position(
    setpoint_m: Signal, pull_N: Signal, mobility_m_Ns: float, sample_s: float
) -> Signal:
    """The position setpoint a sample later, led by the wrench sensor: an admittance.

    It lets the user move the platform while its position is controlled, which else would stick
    at the boundary of its workspace.

    Args:
        setpoint_m: Position setpoint, m of cable wound in.
        pull_N: The sensed wrench along the cable, N, positive toward the reel.
        mobility_m_Ns: Velocity per force, m/(N s); its inverse is the friction the user feels.
        sample_s: Sampling interval, s.
    """
    return setpoint_m + mobility_m_Ns * sample_s * pull_N


class HybridCoefficients(NamedTuple):
    """The two difference equations, from `estune.core.pidf.coefficients`; with equal limits."""

    position: Coefficients
    tension: Coefficients


class HybridState(NamedTuple):
    """What the hybrid controller remembers between samples."""

    position: PidfState
    tension: PidfState
    in_tension: Selection


class HybridSignals(NamedTuple):
    """What both controllers see at a sample; positions in m wound in, tensions in N."""

    position_setpoint_m: Signal
    position_m: Signal
    tension_setpoint_N: Signal
    tension_N: Signal


def hand_over(
    c: Coefficients, state: PidfState, setpoint: Signal, measurement: Signal, effort_N: Signal
) -> tuple[PidfState, Signal]:
    """One sample of the controller that does not control: it takes over the other's effort.

    Implements (36) and (37).

    What is printed is one display of two lines, numbered (36) alone,

        int e_t dt = I_t/s_p,    int e_p dt = I_p/s_t,

    while the text cites (36) and (37); I_t, I_p, s_p and s_t are not defined. What is derived
    here: let s_p be the effort of the position controller while it controls. The tension
    controller would give the same effort if

        P_t e_t + I_t int e_t dt - D_t dy_t/dt = s_p,

    and the other way round with s_t the effort of the tension controller. Hence

        I_t int e_t dt = s_p - P_t e_t + D_t dy_t/dt     (36), position to tension
        I_p int e_p dt = s_t - P_p e_p + D_p dy_p/dt     (37), tension to position

    with e the error after the setpoint filter and dy/dt the filtered derivative. Where the
    incoming controller has no error and is at rest, as at the boundary with the platform held,
    they become int e_t dt = s_p/I_t and int e_p dt = s_t/I_p. That is the printed pair with each
    quotient turned over: read with I as the integral gain, as everywhere else in the paper, the
    print has the units of an integral upside down.

    The state keeps the product I int e dt (`integral_N`), so a controller without integral action
    takes over as well; it then keeps the offset.

    Args:
        c: The difference equation of the controller that does not control.
        state: Its state.
        setpoint: Its setpoint.
        measurement: Its measurement.
        effort_N: The effort s of the one that controls, N, within the limits of both.

    Returns:
        Its next state, its filters run on and its integral handed over, and the effort it gives
        at this sample: `effort_N` to rounding.
    """
    following, effort, _ = pidf_step(
        c, bumpless(c, state, setpoint, measurement, effort_N), setpoint, measurement
    )
    return following, effort


def step(
    c: HybridCoefficients, state: HybridState, signals: HybridSignals, in_tension: Selection
) -> tuple[HybridState, Signal]:
    """One sample of the hybrid controller.

    The controller that was selected at the last sample works out the effort, and the other takes
    it over; then the selection changes. So the effort at a switch is, to rounding, the one that
    would have been given without it, and the incoming controller goes on from there.

    Args:
        c: The two difference equations.
        state: What the last sample left.
        signals: What both controllers see.
        in_tension: The selection S, from `SwitchingRules.select`.

    Returns:
        The next state, and the effort of the controller selected, N.
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


def parallel_step(
    c: HybridCoefficients, state: HybridState, signals: HybridSignals, in_tension: Selection
) -> tuple[HybridState, Signal]:
    """The same without hand-over: two controllers run side by side and S picks one's effort.

    It is what (36) and (37) are measured against, and never what a reel should run: the one that
    does not control winds its integral up, and a switch lets it go.
    """
    r_p, y_p, r_t, y_t = signals
    position, s_p, _ = pidf_step(c.position, state.position, r_p, y_p)
    tension, s_t, _ = pidf_step(c.tension, state.tension, r_t, y_t)
    return HybridState(position, tension, in_tension), _either(in_tension, s_t, s_p)


def _either(choice: Selection, yes: Signal, no: Signal) -> Signal:
    """`yes` where chosen, else `no`; of one selection, or one for each reel."""
    if isinstance(choice, bool):
        return yes if choice else no
    return np.where(choice, yes, no)
