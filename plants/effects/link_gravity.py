"""Gravity of a link that the drive turns."""

from collections.abc import Sequence
from dataclasses import dataclass

from plants.effects import angle_phase
from plants.effects.angle_waves import AngleWaves, Wave
from plants.effects.effect import Values
from plants.effects.parameter import parameter, phase
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import workshop


@dataclass(frozen=True)
class LinkGravity(AngleWaves):
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
    without_cable = True
    states = angle_phase.STATES
    plain_remedies = (workshop("balance the link by a counterweight"),)

    torque_Nm: float = parameter(0.05, low=0.0, unit="N m", neutral=0.0)
    phase_rad: float = phase()

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        return (
            f"has a load off its axis: gravity turns it with {plant.torque(p.torque_Nm)} at most, "
            "in proportion to the sine of the angle"
        )

    @staticmethod
    def waves(p: Values) -> Sequence[Wave]:
        return ((p.torque_Nm, 1.0, p.phase_rad),)
