"""Torque that depends on the drum's angle."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from plants.effects import angle_phase
from plants.effects.angle_waves import AngleWaves, Wave
from plants.effects.effect import Values
from plants.effects.parameter import ABOVE_ZERO, RecordScale, Role, Share, parameter, phase
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import Remedy, angle_map, workshop


@dataclass(frozen=True)
class TorqueRipple(AngleWaves):
    """Cogging of the motor: `tau = -A sin(N theta + phi)`.

    Attributes:
        amplitude_Nm: Amplitude A, N m.
        per_turn: Periods N in a turn of the drum.
        phase_rad: Phase phi where the cable is just taut, or the encoder reads zero, rad.
    """

    name = "torque_ripple"
    title = "torque ripple of the motor"
    appearance = (
        "motion takes an effort that is a wave over the angle, the same at each passage at "
        "any velocity"
    )
    excitation = "slow motion over many periods"
    states = angle_phase.STATES

    amplitude_Nm: float = parameter(0.01, low=0.0, unit="N m", neutral=0.0)
    # What comes back nowhere is no wave: any curve that is bent once looks so.
    per_turn: float = parameter(
        24.0,
        low=ABOVE_ZERO,
        role=Role.PERIODS,
        start=Share(3.0, "turn_periods"),
        between=angle_phase.WAVES,
        least=(Share(0.8, "turn_periods"),),
    )
    phase_rad: float = phase()

    @classmethod
    def matters(
        cls, values: Mapping[str, float], records: RecordScale, *, distinct: bool = False
    ) -> bool:
        """Also whether the records tell it from a wave of one period a turn, which is gravity's.

        Within half a wave of it in their travel they do not: of gravity at 25 Hz 0.994 periods a
        turn explained more than one.
        """
        alike = abs(values["per_turn"] - 1.0) < 0.5 * records.turn_periods
        return not alike and super().matters(values, records, distinct=distinct)

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        return (
            f"has a motor that cogs: its effort varies by {plant.torque(p.amplitude_Nm)} either "
            f"way, {plant.periods(p.per_turn)}, the same at each passage"
        )

    @classmethod
    def remedies(cls, p: Values, plant: PlantScale) -> tuple[Remedy, ...]:
        wave = {"orders": p.per_turn, "torque_Nm": p.amplitude_Nm, "phase_rad": p.phase_rad}
        return (
            *angle_map(plant, "amplitude_Nm", (wave,)),
            workshop("change the motor for one that cogs less", "amplitude_Nm", 1.0),
        )

    @staticmethod
    def waves(p: Values) -> Sequence[Wave]:
        return ((p.amplitude_Nm, p.per_turn, p.phase_rad),)
