"""An actuator that sticks, as a valve with a tight packing."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import ABOVE_ZERO, RecordScale, Share, parameter
from plants.effects.plant_scale import PlantScale, share
from plants.effects.remedy import limit, workshop


def _bands(records: RecordScale) -> Sequence[float]:
    """Bands that are tried: from a small part of what the command moves to twice its rms swing."""
    return tuple(
        records.current_rms_A * factor
        for factor in (0.1, 0.2, 0.35, 0.5, 0.7, 0.95, 1.2, 1.5, 1.9, 2.4)
    )


@dataclass(frozen=True)
class StickingActuator(Effect):
    """An actuator that rests until its command is far enough ahead, and then slips.

        |u - a| > (b + j)/2:    a = u - sign(u - a) (b - j)/2,    j = s b
        otherwise a rests,    what acts is u + w (a - u)

    After a reversal the command u moves by the band b before the actuator's position a does,
    which then leaps by j (He et al. 2007, doi:10.1021/ie060950z). Without slip, s = 0, it is a
    dead band, as the play of a linkage. It depends on the command alone, where friction of a
    moving mass depends on the velocity of the output. The leaps move with the band, so that no fit
    gets on by a derivative: bands and slips are tried, and w, which is 1 of an actuator that is as
    this law, decides how much of it there is.

    Attributes:
        weight: Share w of the law that acts.
        band_A: Stick band b, A.
        slip: Leap as a share s of the band.
    """

    name = "sticking_actuator"
    title = "sticking actuator"
    appearance = (
        "after each reversal the output rests while the command travels on, and then leaps or "
        "follows by a band less"
    )
    excitation = "slow ramps of the command up and down, each over several times the band"
    port = Port.ACTUATOR
    states = 1
    of_process = True
    smooth = False
    plain_remedies = (
        workshop("free the actuator: packing, linkage, or a positioner", "weight", 1.0),
        limit("no gains end a cycle that the band makes; lower ones make it slower"),
    )

    # A smaller band of more weight loses as much travel: fits went to half of it and 1.9.
    weight: float = parameter(1.0, low=0.0, high=1.2, neutral=0.0)
    band_A: float = parameter(
        0.3,
        low=ABOVE_ZERO,
        unit="A",
        start=_bands,
        between=(Share(0.02, "current_rms_A"), Share(5.0, "current_rms_A")),
        least=(Share(0.02, "current_rms_A"),),
    )
    slip: float = parameter(0.5, low=0.0, high=1.0, start=(0.05, 0.3, 0.5, 0.7, 0.95))

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        return (
            f"has an actuator that sticks: after a reversal the command moves by "
            f"{plant.current(p.band_A)} before it does, which then slips by "
            f"{share(p.slip)} of it, {plant.current(p.slip * p.band_A)}; the "
            f"records show {share(p.weight)} of that"
        )

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, _site: Site) -> Response:
        """Where the actuator stands after the command."""
        ahead = signal - state
        breaks = ca.fabs(ahead) > 0.5 * p.band_A * (1.0 + p.slip)
        slides = 0.5 * p.band_A * (1.0 - p.slip)
        at = ca.if_else(breaks, signal - ca.sign(ahead) * slides, state)
        return at, signal + p.weight * (at - signal)

    @staticmethod
    def rest(_p: Values, _state: Signal, signal: Signal, _site: Site) -> Response:
        """Where it is held: the command may be ahead by anything less than the band holds."""
        return signal, signal
