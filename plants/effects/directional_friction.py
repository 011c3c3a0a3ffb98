"""Viscous friction that differs by direction."""

import math
from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import Share, parameter
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import limit, workshop


@dataclass(frozen=True)
class DirectionalFriction(Effect):
    """More viscous friction one way than the other: `tau = -d/2 |omega|`.

    The model's own friction is the mean of both directions. Dry friction that differs by
    direction is no effect of its own: a friction of F_1 forward and F_2 backward is, moving and at
    rest, one of (F_1 + F_2)/2 and a constant torque of (F_2 - F_1)/2, which no record tells
    from an offset. Half the difference counts no further than the model's own friction, for
    friction never pushes. The torque is that of one linearly implicit step.

    Attributes:
        difference_Nms: Coefficient d: friction forward less friction backward, N m s/rad.
    """

    name = "directional_friction"
    title = "viscous friction that differs by direction"
    appearance = (
        "motion takes an effort in proportion to its velocity, and more for each unit of it "
        "in one direction than in the other"
    )
    excitation = "motion at several speeds in both directions"
    port = Port.DRUM
    plain_remedies = (
        limit("the loop is tuned with the mean of both directions"),
        workshop("look for a seal or a bearing that drags in one direction"),
    )

    difference_Nms: float = parameter(
        0.01,
        low=-math.inf,
        unit="N m s/rad",
        neutral=0.0,
        between=(Share(-1e3, "damping_Nms"), Share(1e3, "damping_Nms")),
    )

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        way, other = ("forward", "backward") if p.difference_Nms > 0.0 else ("backward", "forward")
        return (
            f"has {plant.damping(abs(p.difference_Nms))} more viscous friction when it moves "
            f"{way} than {other}"
        )

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:  # noqa: ARG004  nothing of its own
        """The mean of both, which half the difference does not exceed: friction never pushes."""
        own = vars(reel)
        per_length_Ns = own.get("viscous_friction_per_length_Ns", 0.0)
        of_cable = per_length_Ns * own.get("cable_length_m", 0.0)
        return {"linear_Nms": reel.viscous_friction_Nms + of_cable}

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, site: Site) -> Response:
        """The torque of one linearly implicit step."""
        del signal
        omega = site.start_velocity_rad_s  # that after would make a step where the sign changes
        slope = ca.fmax(0.5 * p.difference_Nms * ca.sign(omega), -p.linear_Nms)
        stopped = 1.0 + ca.fmax(slope, 0.0) / site.torque_per_velocity
        return state, -slope * omega / stopped
