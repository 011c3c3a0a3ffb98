"""Laws without a name that a named one is held against, for what they would be taken for.

Hysteresis of a cable or of a gauge makes a loop between angle and tension, as friction at the
eyelet does. But its height is the same at any tension: where such a loop does better, what is
there is not friction at the eyelet.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.discrepancy.search import thresholds
from plants.discrepancy.search.attempts import with_one_more
from plants.discrepancy.search.bench import Attempt, Bench
from plants.discrepancy.search.screen import Background, screen
from plants.effects import Effect, Port, Signal, Site, parameter
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


RIVALS: dict[str, tuple[type[Effect], ...]] = {"eyelet_friction": (CableLoop, GaugeLoop)}
"""By the slug of the law that they are held against."""


def beaten_by(
    bench: Bench, before: Attempt, one: Attempt, seen: Sequence[Background]
) -> str | None:
    """Title of a rival that leaves less than the effect an attempt adds, or None.

    Args:
        bench: Model and records.
        before: The model without the effect.
        one: The attempt.
        seen: From where directions are looked for.
    """
    for rival in RIVALS.get(one.effects[-1].name, ()):
        screened = screen(rival, bench.predictor((rival,)), seen)
        other = bench.further(with_one_more(bench, before, screened, ()))
        if max(other.fit_J / one.fit_J, other.rank_J / one.rank_J) < thresholds.BEATEN:
            return rival.title
    return None
