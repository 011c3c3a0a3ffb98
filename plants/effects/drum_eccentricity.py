"""A drum that is not round about its axis."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects import angle_phase
from plants.effects.effect import Effect, Port, Signal, Site, WINDS_rad, parameter


@dataclass(frozen=True)
class DrumEccentricity(Effect):
    """A drum whose radius varies over a turn: `R(theta) = R (1 + e cos(theta + phi))`.

    The length wound in is the integral of the radius, and the tension's arm is the radius:

        l = k R (theta + e (sin(theta + phi) - sin phi)),    tau = -R e cos(theta + phi) T

    The torque is what the reel's own -R T lacks.

    Attributes:
        eccentricity: Eccentricity e, relative to the radius.
        phase_rad: Angle phi past the largest radius where the cable is just taut, rad.
    """

    name: ClassVar[str] = "drum_eccentricity"
    title: ClassVar[str] = "eccentricity of the drum"
    appearance: ClassVar[str] = (
        "the ratios of current to tension and of tension to angle vary once per turn"
    )
    port: ClassVar[Port] = Port.CABLE
    also: ClassVar[tuple[Port, ...]] = (Port.DRUM,)
    states: ClassVar[int] = angle_phase.STATES

    eccentricity: float = parameter(0.02, low=0.0, high=0.2, unit="", neutral=0.0)
    phase_rad: float = parameter(0.0, low=-WINDS_rad, high=WINDS_rad, unit="rad")

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """What the eccentricity stands for in tension and in arm."""
        arm = p.eccentricity * reel.drum_radius_m
        swing = arm * reel.stiffness_N_m
        return {"arm_m": arm, "swing_N": swing, "taut_N": swing * ca.sin(p.phase_rad)}

    @staticmethod
    def respond(
        p: SimpleNamespace, state: Signal, signal: Signal, site: Site
    ) -> tuple[Signal, Signal]:
        """At the cable the tension for the length wound in, then at the drum the arm's torque."""
        if site.port is Port.DRUM:
            return state, -p.arm_m * state[1] * site.tension_N
        place = angle_phase.advance_angle(state, site.angle_rad + p.phase_rad)
        return place, (signal - p.taut_N) + p.swing_N * place[0]

    @staticmethod
    def rest(
        p: SimpleNamespace,
        state: Signal,  # noqa: ARG004  it is the angle
        signal: Signal,
        site: Site,
    ) -> tuple[Signal, Signal]:
        """The same, traced back at the cable."""
        place = angle_phase.encode_angle(site.angle_rad + p.phase_rad)
        if site.port is Port.DRUM:
            return place, -p.arm_m * place[1] * site.tension_N
        return place, signal - p.swing_N * place[0] + p.taut_N

    @staticmethod
    def put(
        p: SimpleNamespace,
        state: Signal,  # noqa: ARG004  it is the angle
        angle_rad: Signal,
    ) -> Signal:
        """The angle there."""
        return angle_phase.encode_angle(angle_rad + p.phase_rad)
