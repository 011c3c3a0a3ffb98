"""Friction that is elastic before it slips."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from plants.effects.bristles import PRESLIDING, both_bent
from plants.effects.coulomb_friction import CoulombFriction
from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import ABOVE_ZERO, Share, parameter
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import Remedy, friction_feed_forward


@dataclass(frozen=True)
class DahlHysteresis(Effect):
    """Friction built up over a small angle, as by bristles that bend before they slip (Dahl 1968).

        tau = -F (z_1 + z_2)/2,    dz_n/dtheta = (sign(omega) - z_n)/d_n,    z_n = 0 at the start
        d_1 = d,    d_2 = d/s

    Bearings and seals give way bit by bit, over lengths that are spread (Al-Bender, Lampaert &
    Swevers 2005); Dahl's own law has one length, s = 1. The torque is that of the mean z over a
    substep.

    The friction of hidden machines is not quite this law: with a form error of 0.001 in place of
    0.005 an inertia and a Stribeck friction that are 0.8 % off are outside their intervals.

    Attributes:
        torque_Nm: Size F of the friction once it slips, N m.
        presliding_rad: Angle d over which it builds up, rad.
        spread: Factor s by which half of it builds up sooner.
    """

    name = "dahl_hysteresis"
    title = "Dahl hysteresis"
    appearance = (
        "after each reversal the effort changes by degrees over a small angle, so that "
        "small loops are narrower than large ones"
    )
    excitation = "slow reversals of several amplitudes"
    family = "dry friction"
    extends = CoulombFriction
    inherits: ClassVar[Mapping[str, str]] = {"torque_Nm": "torque_Nm"}
    port = Port.DRUM
    states = 2
    resists = True
    form_error = 0.005

    torque_Nm: float = parameter(0.02, low=0.0, unit="N m", neutral=0.0)
    # Shorter than this, bristles that bend and a drum that sticks look alike to the encoder.
    presliding_rad: float = parameter(
        2e-3,
        low=ABOVE_ZERO,
        unit="rad",
        between=PRESLIDING,
        least=(Share(12.0, "angle_noise_rad"),),
    )
    # At 1 it acts as the length does: a fit begins beside it.
    spread: float = parameter(1.0, low=1.0, high=100.0, start=4.0)

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        return (
            f"has dry friction that gives before it slips: {plant.torque(p.torque_Nm)}, built up "
            f"over {plant.travel(p.presliding_rad)} after each reversal, so that small motions "
            "meet less"
        )

    @classmethod
    def remedies(cls, p: Values, plant: PlantScale) -> tuple[Remedy, ...]:
        return friction_feed_forward(
            plant,
            "torque_Nm",
            {
                "coulomb_Nm": p.torque_Nm,
                "static_Nm": p.torque_Nm,
                "memory_rad": p.presliding_rad,
                "spread": p.spread,
            },
        )

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:
        """Half the velocity that friction takes off in a substep; lengths per velocity."""
        bend = reel.substep_s / p.presliding_rad
        return {
            "slowing": 0.5 * p.torque_Nm / reel.torque_per_velocity,
            "bend_1": bend,
            "bend_2": bend * p.spread,
        }

    @staticmethod
    def respond(p: Values, state: Signal, _signal: Signal, site: Site) -> Response:
        bent = both_bent(state, site, p.slowing, (p.bend_1, p.bend_2))
        return bent.after, -p.torque_Nm * bent.held
