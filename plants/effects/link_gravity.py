"""Gravity of a link that the drive turns."""

from dataclasses import dataclass

from plants.effects import angle_phase
from plants.effects.effect import Effect, Port, Response, Signal, Site, Values
from plants.effects.parameter import parameter, phase
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import Remedy, workshop


@dataclass(frozen=True)
class LinkGravity(Effect):
    """Weight of a link, or of any load off the axis: `tau = -m g l sin(theta + phi)`.

    Attributes:
        torque_Nm: Greatest torque m g l, N m.
        phase_rad: Angle phi of the link from hanging down where the encoder reads zero, rad.
    """

    name = "link_gravity"
    title = "gravity of a link"
    appearance = (
        "the torque that holds the load at rest is a sine of the angle with one period a turn"
    )
    excitation = "slow motion over half a turn or more"
    port = Port.DRUM
    without_cable = True
    states = angle_phase.STATES

    torque_Nm: float = parameter(0.05, low=0.0, unit="N m", neutral=0.0)
    phase_rad: float = phase()

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        """Sentence with the fitted values."""
        return (
            f"has a load off its axis: gravity turns it with {plant.torque(p.torque_Nm)} at most, "
            "in proportion to the sine of the angle"
        )

    @classmethod
    def remedies(cls, _p: Values, _plant: PlantScale) -> tuple[Remedy, ...]:
        """What can be done about it."""
        return (workshop("balance the link by a counterweight"),)

    @staticmethod
    def respond(p: Values, state: Signal, _signal: Signal, site: Site) -> Response:
        """The torque at this angle."""
        phase = angle_phase.advance_angle(state, site.angle_rad + p.phase_rad)
        return phase, -p.torque_Nm * phase[0]

    @staticmethod
    def rest(p: Values, _state: Signal, _signal: Signal, site: Site) -> Response:
        """The same at the angle of rest."""
        phase = angle_phase.encode_angle(site.angle_rad + p.phase_rad)
        return phase, -p.torque_Nm * phase[0]

    @staticmethod
    def put(p: Values, _state: Signal, angle_rad: Signal) -> Signal:
        """The angle there."""
        return angle_phase.encode_angle(angle_rad + p.phase_rad)
