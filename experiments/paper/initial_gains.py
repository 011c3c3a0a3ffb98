"""Initial gains by rules from the second-order model of the plant.

The paper takes its initial gains from the identified second-order model by the rules of Shen &
Chiang ("PID tuning rules for second order systems", 5th Asian Control Conference, 2004), without
printing them. `sensitivity_limited` gives the PID gains of a second-order plant with dead time
from first principles; it is not their rule. The common rules stand beside it. Every proposal
carries the margins of the sampled loop with hold and derivative filter.

All rules set the setpoint filter's time constant to P/I, which cancels the zero of the setpoint
path `C_r = P + I/s`, (33).
"""

import math
from collections.abc import Callable
from typing import Literal, NamedTuple, Self, get_args

import numpy as np

from estune.core.gains import Gains
from estune.core.margins import Margins, SampledPlant, loop_margins, sample_plant
from estune.core.pidf import ControllerSettings
from estune.core.quantities import check_positive
from estune.errors import InvalidInput, UnsafeStart
from experiments.paper.second_order import SecondOrder
from experiments.paper.sensitivity import largest_integral_gain

Rule = Literal["sensitivity_limited", "imc", "pole_placement", "ziegler_nichols"]
RULES: tuple[Rule, ...] = get_args(Rule)

LEAST_GAIN_MARGIN = 1.5
LEAST_PHASE_MARGIN_deg = 25.0
"""Initial gains with smaller margins are refused: dithered trials would reach instability."""


class Proposal(NamedTuple):
    """Gains by a rule, and the margins of the sampled loop with the model."""

    rule: Rule
    gains: Gains
    margins: Margins

    @property
    def safe(self) -> bool:
        """Whether the loop is stable with sufficient margins."""
        return (
            self.margins.stable
            and self.margins.phase_margin_deg >= LEAST_PHASE_MARGIN_deg
            and max(self.margins.gain_margin, 1.0 / self.margins.gain_margin) >= LEAST_GAIN_MARGIN
        )

    def checked(self) -> Self:
        """The proposal itself; raises UnsafeStart unless it is safe."""
        if self.safe:
            return self
        m = self.margins
        how = (
            f"gain margin {m.gain_margin:.2f} and phase margin {m.phase_margin_deg:.0f} degrees, "
            f"where {LEAST_GAIN_MARGIN} and {LEAST_PHASE_MARGIN_deg:.0f} are the least"
            if m.stable
            else "the loop is unstable"
        )
        raise UnsafeStart(
            f"the gains by {self.rule} are no safe start: {how}; use sensitivity_limited, or "
            "check the model"
        )


def propose(model: SecondOrder, settings: ControllerSettings, rule: Rule) -> Proposal:
    """The proposal of one rule, safe or not.

    Args:
        model: The plant with the effort as its input: gain in N/N.
        settings: Sampling rate and derivative filter of the controller.
        rule: The rule.

    Raises:
        InvalidInput: there is no such rule, or it does not apply to the model.
    """
    if rule not in RULES:
        raise InvalidInput(f"there is no rule {rule!r}; choose one of {', '.join(RULES)}")
    rules: dict[Rule, Callable[[SecondOrder, ControllerSettings], Gains]] = {
        "sensitivity_limited": sensitivity_limited,
        "imc": imc,
        "pole_placement": pole_placement,
        "ziegler_nichols": ziegler_nichols,
    }
    gains = rules[rule](model, settings)
    return Proposal(rule, gains, loop_margins(_sampled(model, settings), gains, settings))


def ziegler_nichols(model: SecondOrder, settings: ControllerSettings) -> Gains:
    """`K = 0.6 K_u, Ti = T_u/2, Td = T_u/8` (Ziegler & Nichols 1942), K_u of the sampled loop.

    Made for overdamped plants; on a resonant reel it is often unstable.

    Raises:
        InvalidInput: no proportional gain makes the loop oscillate.
    """
    # Low enough to be stable at the peak of the resonance.
    small = Gains(0.02 * model.damping / model.gain, 0.0, 0.0, 0.0)
    edge = loop_margins(_sampled(model, settings), small, settings)
    if not math.isfinite(edge.gain_margin) or not edge.phase_crossover_Hz > 0.0:
        raise InvalidInput(
            "no proportional gain brings the loop to oscillate, so Ziegler-Nichols has no "
            "ultimate gain; use another rule"
        )
    period_s = 1.0 / edge.phase_crossover_Hz
    return _with_filter(0.6 * small.P * edge.gain_margin, period_s / 2.0, period_s / 8.0)


def imc(
    model: SecondOrder, settings: ControllerSettings, closed_loop_s: float | None = None
) -> Gains:
    """Internal model control (Rivera, Morari & Skogestad 1986): zeros on the plant's poles.

    `K = 2 zeta/(w k (lambda + theta)), Ti = 2 zeta/w, Td = 1/(2 zeta w)`, so that the loop is
    `1/((lambda + theta) s)` with the dead time theta. Disturbances and, as the derivative acts on
    the measurement alone, setpoints still oscillate at the plant's own damping, so that the rule
    suits a reel little.

    Args:
        model: The plant.
        settings: Half a sample and the derivative filter count as dead time.
        closed_loop_s: Time constant lambda of the closed loop, s; None is a quarter of
            `2 pi/w`, the longest settling time the paper allows in (35), or theta if longer.

    Raises:
        InvalidInput: lambda is not above zero.
    """
    w, zeta = model.natural_frequency_rad_s, model.damping
    theta = _effective_dead_time_s(model, settings)
    time_s = max(math.pi / (2.0 * w), theta) if closed_loop_s is None else closed_loop_s
    check_positive("closed-loop time constant", time_s, "s")
    K = 2.0 * zeta / (w * model.gain * (time_s + theta))
    return _with_filter(K, 2.0 * zeta / w, 1.0 / (2.0 * zeta * w))


def pole_placement(
    model: SecondOrder,
    settings: ControllerSettings,
    frequency_rad_s: float | None = None,
    damping: float = 0.8,
) -> Gains:
    """Dominant pole placement (Persson & Astrom 1992), exact with the dead time.

    Puts three closed-loop poles, a pair of the given frequency and damping and a real one at the
    same distance from the origin, by solving `1 + C_y(s) G(s) = 0` at them: three linear equations
    in P, I and D.

    Args:
        model: The plant.
        settings: Half a sample and the derivative filter count as dead time.
        frequency_rad_s: Distance of the poles from the origin, rad/s; None is 1.5 times the
            plant's natural frequency, at most half a radian per dead time.
        damping: Damping ratio of the pair.

    Raises:
        InvalidInput: the poles need a gain that is not above zero.
    """
    theta = _effective_dead_time_s(model, settings)
    w = model.natural_frequency_rad_s
    radius = min(1.5 * w, 0.5 / theta) if frequency_rad_s is None else frequency_rad_s
    if not (math.isfinite(radius) and radius > 0.0 and 0.0 < damping < 1.0):
        raise InvalidInput(
            f"poles of {radius} rad/s with damping {damping}: give a frequency above zero and a "
            "damping between 0 and 1"
        )
    pair = radius * complex(-damping, math.sqrt(1.0 - damping**2))
    rows, right = [], []
    for s in (complex(-radius), pair):
        inverse = -(s**2 + 2.0 * model.damping * w * s + w**2) / (model.gain * w**2)
        target = inverse * np.exp(s * theta)
        rows += [[1.0, (1.0 / s).real, s.real], [0.0, (1.0 / s).imag, s.imag]]
        right += [target.real, target.imag]
    kept = [0, 2, 3]  # the real pole's imaginary equation is empty
    P, I, D = np.linalg.solve(np.array(rows)[kept], np.array(right)[kept])
    if not (P > 0.0 and I > 0.0 and D >= 0.0):
        raise InvalidInput(
            f"poles at {radius:.4g} rad/s need P {P:.3g}, I {I:.3g}, D {D:.3g}, which are not "
            "all positive; place them elsewhere, or use another rule"
        )
    return Gains(float(P), float(I), float(D), float(P / I))


def sensitivity_limited(model: SecondOrder, settings: ControllerSettings) -> Gains:
    """The largest integral gain within limits of sensitivity, setpoint response and noise.

    See `experiments.paper.sensitivity`, which is for any linear plant.

    Raises:
        InvalidInput: no gains keep the limits, as for a model near instability.
    """
    return largest_integral_gain(_sampled(model, settings), settings)


def _with_filter(K: float, Ti: float, Td: float) -> Gains:
    return Gains.from_standard(K, Ti, Td, setpoint_filter_s=Ti)


def _effective_dead_time_s(model: SecondOrder, settings: ControllerSettings) -> float:
    """Dead time, hold and lags that a continuous rule ignores, s."""
    _check_sign(model)
    lag = settings.derivative_filter_s + 0.5 / settings.sampling_Hz
    if model.gauge is not None:
        lag += 2.0 * model.gauge.damping / model.gauge.natural_frequency_rad_s
    return model.dead_time_s + lag


def _check_sign(model: SecondOrder) -> None:
    if model.gain < 0.0:
        raise InvalidInput(
            f"model gain is {model.gain:.4g}: more effort lowers the output; the controller's "
            "gains are positive, so turn the sign of the input"
        )


def _sampled(model: SecondOrder, settings: ControllerSettings) -> SampledPlant:
    _check_sign(model)
    A, B, C, E = model.state_space()
    return sample_plant(
        A, B, C, E, dead_time_s=model.dead_time_s, sample_s=1.0 / settings.sampling_Hz
    )
