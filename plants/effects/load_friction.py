"""Dry friction that grows with the load."""

from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import parameter
from plants.effects.plant_scale import PlantScale, share
from plants.effects.remedy import Remedy, friction_feed_forward


@dataclass(frozen=True)
class LoadFriction(Effect):
    """Dry friction of bearings or teeth that carry the load: `tau = -c R |T| sign(omega)`.

    R T is the torque of the tension; of a drive without a cable, the torque of the motor, which
    its gear passes on. At rest |tau| <= c R |T|. A friction that the load does not change is
    Coulomb friction beside it. The torque is chosen as that of Coulomb friction, by the load that
    acts in the substep.

    Attributes:
        load_share: Friction torque relative to the torque R T of the load, c.
    """

    name = "load_friction"
    title = "dry friction that grows with the load"
    appearance = (
        "motion takes a share of the load more, against its direction; tension and angle agree"
    )
    excitation = "slow reversals at several loads"
    port = Port.DRUM
    resists = True
    by_tension = True

    load_share: float = parameter(0.03, low=0.0, high=1.0, neutral=0.0)

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        tension, at = plant.usual_tension_N, ""
        if plant.has_cable:
            at = f": {plant.reading(p.load_share * tension)} at {plant.reading(tension)}"
        return (
            f"has dry friction{plant.at_drum} that grows with the load, {share(p.load_share)} of "
            f"it against the motion{at}"
        )

    @classmethod
    def remedies(cls, p: Values, plant: PlantScale) -> tuple[Remedy, ...]:
        return friction_feed_forward(
            plant,
            "load_share",
            {"load_share": p.load_share},
        )

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:
        """The friction per tension, m."""
        return {"arm_m": p.load_share * reel.drum_radius_m}

    @staticmethod
    def respond(p: Values, state: Signal, _signal: Signal, site: Site) -> Response:
        """The torque that would end the substep at rest, cut at the friction."""
        most = p.arm_m * ca.fabs(site.tension_N)
        stopping = -site.velocity_rad_s * site.torque_per_velocity
        return state, ca.fmin(ca.fmax(stopping, -most), most)
