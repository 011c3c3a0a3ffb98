"""A cable that stiffens under tension."""

from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import Share, parameter
from plants.effects.plant_scale import PlantScale, digits, share, si
from plants.effects.remedy import Remedy, limit

NEWTON_ROUNDS = 6
"""From the smaller of the two bounds below; they end within rounding of the root."""
TINY = 1e-12


@dataclass(frozen=True)
class CableStiffening(Effect):
    """A cable whose fibres straighten as it is pulled: `T = l + c max(l, 0) l + d l^3`.

    l is the tension of the linear law. The cubic part is odd, so that a spring which also pushes,
    as that of an oscillator, hardens either way.

    Attributes:
        stiffening_per_N: The coefficient c, 1/N.
        cubic_per_N2: The coefficient d, 1/N2.
    """

    name = "cable_stiffening"
    title = "stiffness that grows with the load"
    appearance = (
        "tension against angle is bent upward while tension against current is straight; "
        "the resonance rises with the tension"
    )
    excitation = "slow ramps over the whole range of tension"
    family = "stiffening"
    port = Port.CABLE

    stiffening_per_N: float = parameter(
        5e-3,
        low=0.0,
        unit="1/N",
        neutral=0.0,
        start=Share(0.2, "per_reading_per_N"),
        between=(Share(0.0), Share(4.0, "per_reading_per_N")),
    )
    cubic_per_N2: float = parameter(
        0.0,
        low=0.0,
        unit="1/N2",
        neutral=0.0,
        between=(Share(0.0), Share(100.0, "per_square_per_N2")),
    )

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        square, cubic = p.stiffening_per_N, p.cubic_per_N2
        if plant.is_plant:
            pulled = f"{digits(square)} u² more where it is pulled" if square else ""
            either = f"{digits(cubic)} u³ more either way" if cubic else ""
            more = " and ".join(filter(None, (pulled, either)))
            return (
                f"has a spring that stiffens: it holds {more}, u being what the linear law holds"
            )
        T = plant.usual_tension_N
        bent = square * T + cubic * T * T
        terms = f"coefficient {square:.3g} 1/N" + (f", cubic {cubic:.3g} 1/N²" if cubic else "")
        more = "more" if bent > 0.0 else "less"
        return (
            f"has a cable that stiffens as it is pulled: where the linear law has {si(T, 'N')} it "
            f"pulls {share(abs(bent))} {more} ({terms})"
        )

    @classmethod
    def remedies(cls, _p: Values, plant: PlantScale) -> tuple[Remedy, ...]:
        load = "tension" if plant.has_cable else "measurement"
        return (limit(f"schedule the gains over {load}: the loop's gain grows with it"),)

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        """The tension; a slack cable stays slack."""
        odd = p.cubic_per_N2 * (signal * signal)
        return state, signal * (1.0 + p.stiffening_per_N * ca.fmax(signal, 0.0) + odd)

    @staticmethod
    def rest(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        """The linear law's tension, by Newton's method from above on a convex law."""
        size, d = ca.fabs(signal), p.cubic_per_N2
        c = ca.if_else(signal > 0.0, p.stiffening_per_N, 0.0)
        without_cubic = 2.0 * size / (1.0 + ca.sqrt(1.0 + 4.0 * c * size))
        cubic_alone = ((size + TINY) / (d + TINY)) ** (1.0 / 3.0)
        root = ca.fmin(without_cubic, cubic_alone)
        for _ in range(NEWTON_ROUNDS):
            beyond = root * (1.0 + root * (c + root * d)) - size
            root -= beyond / (1.0 + root * (2.0 * c + 3.0 * root * d))
        return state, ca.sign(signal) * root
