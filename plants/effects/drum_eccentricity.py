"""A drum that is not round about its axis."""

import math
from dataclasses import dataclass

import casadi as ca

from plants.effects import angle_phase
from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import parameter, phase
from plants.effects.plant_scale import PlantScale, also, share
from plants.effects.remedy import Remedy, angle_map, workshop


@dataclass(frozen=True)
class DrumEccentricity(Effect):
    """A drum whose radius varies over a turn: `R(theta) = R (1 + e cos(theta + phi))`.

    The length wound in is the integral of the radius, and the tension's arm is the radius:

        l = k R (theta + e (sin(theta + phi) - sin phi)),    tau = -R e cos(theta + phi) T

    The torque is what the reel's own -R T lacks.

    A drum is also oval. Over less than a turn that looks like a wave of another size: twelve
    hidden drums whose second harmonic was 5 to 20 % of the first were found with an eccentricity
    off by 0 to 28 %, 14 % rms.

    Attributes:
        eccentricity: Eccentricity e, relative to the radius: that of the one wave that comes
            nearest.
        phase_rad: Angle phi past the largest radius where the cable is just taut, rad.
    """

    name = "drum_eccentricity"
    title = "eccentricity of the drum"
    appearance = "the ratios of current to tension and of tension to angle vary once per turn"
    excitation = "motion over a turn or more"
    port = Port.CABLE
    also = (Port.DRUM,)
    states = angle_phase.STATES
    form_error = 0.1

    eccentricity: float = parameter(0.02, low=0.0, high=0.2, neutral=0.0)
    phase_rad: float = phase()

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        return (
            f"has a drum that is not round: its radius varies by {share(p.eccentricity)}"
            f"{also(p.eccentricity * plant.radius_m, 'm')} either way, once a turn"
        )

    @classmethod
    def remedies(cls, p: Values, plant: PlantScale) -> tuple[Remedy, ...]:
        """What can be done about it: R e cos(theta + phi) r of torque holds the setpoint r."""
        phase = p.phase_rad + 0.5 * math.pi
        wave = {"orders": 1.0, "load_share": p.eccentricity, "phase_rad": phase}
        return (
            *angle_map(plant, "eccentricity", (wave,)),
            workshop("true the drum, or centre it on its shaft", "eccentricity", 1.0),
        )

    @staticmethod
    def prepare(p: Values, reel: Values) -> dict[str, Signal]:
        """Amplitudes of lever arm and tension caused by the eccentricity."""
        arm = p.eccentricity * reel.drum_radius_m
        swing = arm * reel.stiffness_N_m
        return {"arm_m": arm, "swing_N": swing, "taut_N": swing * ca.sin(p.phase_rad)}

    @staticmethod
    def respond(p: Values, state: Signal, signal: Signal, site: Site) -> Response:
        """At the cable the tension for the length wound in, then at the drum the arm's torque."""
        if site.port is Port.DRUM:
            return state, -p.arm_m * state[1] * site.tension_N
        place = angle_phase.advance_angle(state, site.angle_rad + p.phase_rad)
        return place, (signal - p.taut_N) + p.swing_N * place[0]

    @staticmethod
    def rest(p: Values, _state: Signal, signal: Signal, site: Site) -> Response:
        """The same, traced back at the cable."""
        place = angle_phase.encode_angle(site.angle_rad + p.phase_rad)
        if site.port is Port.DRUM:
            return place, -p.arm_m * place[1] * site.tension_N
        return place, signal - p.swing_N * place[0] + p.taut_N

    @staticmethod
    def put(p: Values, _state: Signal, angle_rad: Signal) -> Signal:
        return angle_phase.encode_angle(angle_rad + p.phase_rad)
