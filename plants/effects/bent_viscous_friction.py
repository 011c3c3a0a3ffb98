"""Viscous friction that is not in proportion to velocity."""

import math
from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import Share, parameter
from plants.effects.plant_scale import PlantScale, digits
from plants.effects.remedy import limit


@dataclass(frozen=True)
class BentViscousFriction(Effect):
    """Viscous friction that bends with speed: `tau = -b_2 |omega| omega`, beside the linear part.

    Grease that thins as it is sheared bends down, b_2 < 0, but friction never pushes: b_2 |omega|
    is no less than -b, the linear part. Air, and oil that is stirred, bend up. The torque is that
    of one linearly implicit step, so that a strong drag does not overshoot:
    `tau = -s omega_1/(1 + s/m)`, s = b_2 |omega_0|, with the velocities before the substep and
    after it, were there no drag, and the torque m that adds a unit of velocity in it.

    Attributes:
        bend_Nms2: The coefficient b_2, N m s2/rad2.
    """

    name = "bent_viscous_friction"
    title = "viscous friction that bends with speed"
    appearance = (
        "motion takes an effort that is a smooth odd function of its velocity and no straight line"
    )
    excitation = "motion at several speeds in both directions"
    port = Port.DRUM
    plain_remedies = (limit("tune at the speed that matters: the damping differs with it"),)

    bend_Nms2: float = parameter(
        1e-3,
        low=-math.inf,
        unit="N m s2/rad2",
        neutral=0.0,
        start=Share(0.1, "bend_Nms2"),
        between=(Share(-1e3, "bend_Nms2"), Share(1e3, "bend_Nms2")),
    )

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        way = "more" if p.bend_Nms2 > 0.0 else "less"
        size = abs(p.bend_Nms2)
        unit = "the input's unit per square of the output's rate"
        unit = unit if plant.is_plant else plant.unit("N m s2/rad2")
        return (
            f"has viscous friction that grows {way} than in proportion to the speed: the torque "
            f"against the motion has a quadratic part of {digits(size)} {unit}"
        )

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:  # noqa: ARG004  nothing of its own
        """The linear part, below which it does not fall."""
        return {"linear_Nms": reel.viscous_friction_Nms}

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, site: Site) -> Response:
        """The torque of one linearly implicit step."""
        del signal
        slope = ca.fmax(p.bend_Nms2 * ca.fabs(site.start_velocity_rad_s), -p.linear_Nms)
        stopped = 1.0 + ca.fmax(slope, 0.0) / site.torque_per_velocity
        return state, -slope * site.velocity_rad_s / stopped
