"""Backlash between motor and drum."""

from dataclasses import dataclass

import casadi as ca

from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import Share, parameter
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import limit


@dataclass(frozen=True)
class Backlash(Effect):
    """Backlash of the gear between the motor, which has the encoder, and the drum.

        m (J theta'' + b theta') = tau - c,    0 <= g = phi - theta <= p
        (1 - m) (J phi'' + b phi') = c - R T - f,    l = k R phi
        c >= 0 where g = 0,    c <= 0 where g = p,    c = 0 between

    theta is the motor's angle and phi the drum's, which winds the cable; tau is the motor's
    torque, c what the teeth pass on, and f the dry friction that other effects bring, which is the
    drum's. Pulled by the cable the gear closes at g = 0, and closed the two turn as one. The teeth
    part where the motor gives way faster than the cable pulls the drum along, which takes a cable
    next to slack, or none: until they meet again, the torque moves the motor alone. They meet
    without rebound: the gap's rate over a substep is that of free masses, cut at what takes the
    gap to an end of the backlash (Moreau 1988).

    Real teeth give way and rebound, and where they meet decides what follows: of eight hidden
    gears the backlash found was off by 2 to 20 %, 14 % rms.

    Attributes:
        play_rad: Backlash p at the drum, rad: that of rigid teeth which predict best.
        motor_share: Share m of the inertia, and of the viscous friction, on the motor's side.
    """

    name = "backlash"
    title = "backlash between motor and load"
    appearance = (
        "where the torque turns round and no load holds the teeth together, the angle leaps "
        "ahead and stops with a jerk"
    )
    excitation = "reversals of the torque near zero load"
    port = Port.DRUM
    also = (Port.CABLE,)
    states = 2
    divides = True
    form_error = 0.1
    plain_remedies = (
        limit("keep the tension above zero (limits.tension_min_N): play costs nothing while taut"),
    )

    play_rad: float = parameter(
        0.003, low=0.0, unit="rad", neutral=0.0, least=(Share(3.0, "angle_noise_rad"),)
    )
    motor_share: float = parameter(0.5, low=0.05, high=0.95)

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        return (
            f"has backlash of {plant.travel(p.play_rad)} between motor and drum; the motor is "
            f"{100.0 * p.motor_share:.0f} % of what turns and moves alone where the teeth part"
        )

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:
        """Arm, m; tension per gap, N/rad; friction, N m s/rad; the gap's rate per torque."""
        friction = reel.viscous_friction_Nms
        if "cable_length_m" in vars(reel):
            friction = friction + reel.viscous_friction_per_length_Ns * reel.cable_length_m
        return {
            "arm_m": reel.drum_radius_m,
            "per_gap": reel.stiffness_N_m * reel.drum_radius_m,
            "friction": friction,
            "slowing": 1.0 - friction / reel.torque_per_velocity,
            "yielding": 1.0 / (p.motor_share * (1.0 - p.motor_share) * reel.torque_per_velocity),
            "drum_share": 1.0 - p.motor_share,
            "drum_yielding": 1.0 / ((1.0 - p.motor_share) * reel.torque_per_velocity),
            "step_s": reel.substep_s,
            "per_s": 1.0 / reel.substep_s,
        }

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, site: Site) -> Response:
        """The tension at the drum's angle; the torque by which the motor moves unlike the whole.

        The whole's momentum does not depend on the teeth: of what the gap's rate changes by, the
        motor takes the drum's share, the other way.
        """
        gap, rate = state[0], state[1]
        if site.port is Port.CABLE:
            return state, signal + p.per_gap * (gap + 0.5 * p.step_s * rate)
        start, mass, dry = site.start_velocity_rad_s, site.torque_per_velocity, site.friction_Nm
        driving = (site.velocity_rad_s - start) * mass - dry
        parting = p.drum_share * (driving + p.friction * start) + p.arm_m * site.tension_N
        free = p.slowing * rate - p.yielding * parting
        # Each by itself, and what dry friction of its size takes of the drum's velocity.
        motor = start + driving / mass - p.drum_share * (free - rate)
        most = p.drum_yielding * ca.fabs(dry)
        held = ca.fmin(ca.fmax(-(motor + free), -most), most)
        low, high = -p.per_s * gap, p.per_s * (p.play_rad - gap)
        after = ca.fmin(ca.fmax(free + held, low), high)
        apart = ca.logic_and(after > low, after < high)
        unlike = mass * (after - rate - apart * held) + p.friction * rate
        return ca.vertcat(gap + p.step_s * after, after), -p.drum_share * unlike - apart * dry
