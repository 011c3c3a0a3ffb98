"""Laws without a name that a named one of cable or gauge is held against.

Each is a way in which tension and angle may part that is no declared effect, but may be taken for
one: a loop of the same height at any tension for friction at the eyelet, whose loop grows with
it; a gain that changes with time for a zero that does. Where such a law does better, what is
there is not what the name says.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar, NamedTuple

import casadi as ca
import numpy as np

from plants.diagnosis.search import thresholds
from plants.diagnosis.search.cable_block import block_of
from plants.diagnosis.search.candidate_fits import fit_added_effect
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.diagnosis.search.score_context import ScoreContext
from plants.diagnosis.search.score_test import screen
from plants.effects import Effect, Port, Role, Signal, Site, parameter
from plants.effects.bristles import bent


@dataclass(frozen=True)
class CableLoop(Effect):
    """A strand that slips beside the cable: `T = l + F z`, `dz/dl = (sign(dl) - z)/d`.

    l is the tension of the linear law, z is 0 at the start.

    Attributes:
        height_N: Force F once it slips, N.
        reach_N: Change d of the linear law's tension over which it builds up, N.
    """

    name: ClassVar[str] = "cable_loop"
    title: ClassVar[str] = "a loop of the cable that does not grow with the tension"
    appearance: ClassVar[str] = "tension against angle is a loop of the same height at any tension"
    port: ClassVar[Port] = Port.CABLE
    states: ClassVar[int] = 2

    height_N: float = parameter(0.5, low=0.0, high=100.0, unit="N", neutral=0.0)
    reach_N: float = parameter(4.0, low=0.1, high=100.0, unit="N")

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  only the tension counts
    ) -> tuple[Signal, Signal]:
        """The tension of both."""
        z = state[0] + bent(state[0], (signal - state[1]) / p.reach_N)
        return ca.vertcat(z, signal), signal + p.height_N * z

    @staticmethod
    def rest(
        p: SimpleNamespace,  # noqa: ARG004  nothing is bent
        state: Signal,  # noqa: ARG004  it is zero
        signal: Signal,
        site: Site,  # noqa: ARG004  the same anywhere
    ) -> tuple[Signal, Signal]:
        """The strand has given way to what is steady."""
        return ca.vertcat(0.0, signal), signal


@dataclass(frozen=True)
class GaugeLoop(CableLoop):
    """The same of what the gauge reads: `y = T + F z`, `dz/dT = (sign(dT) - z)/d`."""

    name: ClassVar[str] = "gauge_loop"
    title: ClassVar[str] = "a loop of the gauge that does not grow with the tension"
    port: ClassVar[Port] = Port.GAUGE


@dataclass(frozen=True)
class GaugeWarming(Effect):
    """A gauge whose gain changes from the start on: `y = (1 + s) T`, `ds/dt = (g - s)/tau`.

    Attributes:
        gain: Share g by which it reads more in the end.
        time_s: Time constant tau, s.
    """

    name: ClassVar[str] = "gauge_warming"
    title: ClassVar[str] = "a gain of the gauge that changes with time"
    appearance: ClassVar[str] = "tension read and current move apart the more, the more it pulls"
    port: ClassVar[Port] = Port.GAUGE
    states: ClassVar[int] = 1

    gain: float = parameter(0.03, low=-0.5, high=0.5, unit="", neutral=0.0)
    time_s: float = parameter(2.0, low=0.2, high=50.0, unit="s")

    @staticmethod
    def respond(
        p: SimpleNamespace, state: Signal, signal: Signal, site: Site
    ) -> tuple[Signal, Signal]:
        """The tension read; what is remembered is the gain's change."""
        after = p.gain + (state - p.gain) * ca.exp(-site.span_s / p.time_s)
        return after, signal * (1.0 + state)


@dataclass(frozen=True)
class CableBend(Effect):
    """A cable whose tension is some curve of its stretch: `T = l + b l |l| + c l^3`.

    Attributes:
        bend_per_N: The coefficient b, 1/N.
        bend_per_N2: The coefficient c, 1/N2.
    """

    name: ClassVar[str] = "cable_bend"
    title: ClassVar[str] = "a plain curve of tension against angle, bent at no certain tension"
    appearance: ClassVar[str] = "tension against angle is bent, most where it pulls the most"
    port: ClassVar[Port] = Port.CABLE

    bend_per_N: float = parameter(3e-3, low=-5e-3, high=0.1, unit="1/N", neutral=0.0)
    bend_per_N2: float = parameter(1e-5, low=-5e-5, high=0.01, unit="1/N2", neutral=0.0)

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the law is the same at all times
    ) -> tuple[Signal, Signal]:
        """The tension."""
        return state, signal * _stiffer(p, ca.fabs(signal))

    @staticmethod
    def rest(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  the law is the same at all times
    ) -> tuple[Signal, Signal]:
        """The linear law's tension, by a secant to the origin, again and again."""
        linear = signal
        for _ in range(SECANTS):
            linear = 0.5 * (linear + signal / _stiffer(p, ca.fabs(linear)))
        return state, linear


def _stiffer(p: SimpleNamespace, size: Signal) -> Signal:
    """Tension per that of the linear law; a curve that bends down is straight before it falls."""
    return ca.fmax(1.0 + size * (p.bend_per_N + size * p.bend_per_N2), 0.5)


SECANTS = 20
"""They halve the error each; what is left is far below a floor."""
AIMED = 0.5
"""A rival is fitted whose direction explains at least this part of what the effect's does."""


class AlternativeLaw(NamedTuple):
    """A law that an effect is held against.

    Attributes:
        law: The law.
        least: Ratio of powers left, its own to the effect's, below which the effect is beaten.
        ever: Whether it is asked for where the effect leaves nothing, too.
    """

    law: type[Effect]
    least: float
    ever: bool


RIVALS = tuple(
    AlternativeLaw(law, thresholds.BEATEN, ever=False)
    for law in (CableLoop, GaugeLoop, GaugeWarming)
)
PLAIN = AlternativeLaw(CableBend, 1.0, ever=True)
"""A toe is there where it does better than a plain curve. Of one that lies below or above all
tensions of the records they show the curvature alone, and that tells nothing."""
STILL = AlternativeLaw(CableBend, thresholds.SIMPLER, ever=True)
"""A mode is there where it rings. A frame that hardens and rings faster than the records show
is a curve, whatever bends."""


def better_alternative(
    bench: ModelFitter,
    before: CandidateFit,
    one: CandidateFit,
    seen: Sequence[ScoreContext],
    share: float,
) -> str | None:
    """Title of a rival that does about as well as the effect an attempt adds, or None.

    Args:
        bench: Model and records.
        before: The model without the effect.
        one: The attempt.
        seen: From where directions are looked for.
        share: Share of the residual that the effect's direction explains.
    """
    effect, closed = one.effects[-1], is_closed(one)
    if block_of(effect) != "cable":
        return None
    for law, least, ever in _held_against(effect):
        if bench.model.unavailable(law) is not None or (closed and not ever):
            continue
        screened = screen(law, bench.predictor((law,)), seen)
        if screened.screening_R2 < AIMED * share:
            continue
        other = bench.refine(fit_added_effect(bench, before, screened, ()))
        if max(np.divide(_left(other), _left(one))) < least:
            return law.title
    return None


def _held_against(effect: type[Effect]) -> tuple[AlternativeLaw, ...]:
    """The rivals of an effect of cable or gauge."""
    if effect.by_tension:
        return (*RIVALS, PLAIN)
    return (*RIVALS, STILL) if effect.family and effect.named(Role.FREQUENCY) else RIVALS


def is_closed(attempt: CandidateFit) -> bool:
    """Whether a model leaves nothing where an effect of cable and gauge is seen."""
    return max(_left(attempt)) <= thresholds.CLOSED**2


def _left(attempt: CandidateFit) -> tuple[float, float]:
    """Power left on the fit and the rank split: in the cable and gauge block, where it is seen."""
    cable = attempt.fit_blocks.cable, attempt.rank_blocks.cable
    return (attempt.fit_J, attempt.rank_J) if math.isnan(sum(cable)) else cable
