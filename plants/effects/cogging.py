"""Torque that depends on the drum's angle in several waves."""

from collections.abc import Sequence
from dataclasses import dataclass

from plants.effects import angle_phase
from plants.effects.angle_waves import AngleWaves, Wave
from plants.effects.effect import Values
from plants.effects.parameter import ABOVE_ZERO, PHASE_MAX_rad, Role, parameter, phase
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import Remedy, angle_map, workshop

WAVES = 5


USUAL_ORDER = 24.0


def _amplitude(usual_Nm: float = 0.0) -> float:
    amplitude: float = parameter(usual_Nm, low=0.0, unit="N m", neutral=0.0)
    return amplitude


def _per_turn(start: float | None = None) -> float:
    periods: float = parameter(
        USUAL_ORDER, low=ABOVE_ZERO, role=Role.PERIODS, start=start, between=angle_phase.WAVES
    )
    return periods


def _further_phase() -> float:
    """Phase of a wave that is usually absent: a fit begins at zero."""
    angle: float = parameter(
        0.0, low=-PHASE_MAX_rad, high=PHASE_MAX_rad, unit="rad", role=Role.PHASE, start=0.0
    )
    return angle


@dataclass(frozen=True)
class Cogging(AngleWaves):
    """Cogging of a motor in several waves: `tau = -sum A_k sin(N_k theta + phi_k)`.

    Slots and poles of a motor attract each other as often in a turn as their least common
    multiple says; unequal slots, an eccentric rotor and the iron around it add waves of other
    orders. It is found in the balance of torques over the angle.

    Attributes:
        amplitude_1_Nm: Amplitude A_1 of the greatest wave, N m.
        per_turn_1: Its periods N_1 in a turn.
        phase_1_rad: Its phase phi_1 where the encoder reads zero, rad.
        amplitude_2_Nm: Amplitude of the second wave, N m; usually none.
        per_turn_2: Its periods in a turn.
        phase_2_rad: Its phase, rad.
        amplitude_3_Nm: Amplitude of the third wave, N m; usually none.
        per_turn_3: Its periods in a turn.
        phase_3_rad: Its phase, rad.
        amplitude_4_Nm: Amplitude of the fourth wave, N m; usually none.
        per_turn_4: Its periods in a turn.
        phase_4_rad: Its phase, rad.
        amplitude_5_Nm: Amplitude of the fifth wave, N m; usually none.
        per_turn_5: Its periods in a turn.
        phase_5_rad: Its phase, rad.
    """

    name = "cogging"
    title = "cogging of several orders"
    appearance = "the current over the angle is a curve that is the same at each passage"
    excitation = "slow motion over a turn or more, at a constant velocity"
    in_torque = True
    without_cable = True
    states = WAVES * angle_phase.STATES

    amplitude_1_Nm: float = _amplitude(0.01)
    per_turn_1: float = _per_turn()
    phase_1_rad: float = phase()
    amplitude_2_Nm: float = _amplitude()
    per_turn_2: float = _per_turn(USUAL_ORDER)
    phase_2_rad: float = _further_phase()
    amplitude_3_Nm: float = _amplitude()
    per_turn_3: float = _per_turn(USUAL_ORDER)
    phase_3_rad: float = _further_phase()
    amplitude_4_Nm: float = _amplitude()
    per_turn_4: float = _per_turn(USUAL_ORDER)
    phase_4_rad: float = _further_phase()
    amplitude_5_Nm: float = _amplitude()
    per_turn_5: float = _per_turn(USUAL_ORDER)
    phase_5_rad: float = _further_phase()

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        waves = sorted(cls.waves(p), key=lambda wave: -wave[0])
        listed = ", ".join(
            f"{plant.torque(size)} {plant.periods(order)}"
            for size, order, _ in waves
            if size > 0.0
        )
        return f"has a motor that cogs: its effort varies with the {plant.along} by {listed}"

    @classmethod
    def remedies(cls, p: Values, plant: PlantScale) -> tuple[Remedy, ...]:
        waves = [
            {"orders": order, "torque_Nm": size, "phase_rad": phi}
            for size, order, phi in cls.waves(p)
        ]
        change = workshop("change the motor for one that cogs less")
        return (*angle_map(plant, "amplitude_1_Nm", waves), change)

    @staticmethod
    def waves(p: Values) -> Sequence[Wave]:
        own = vars(p)
        return [
            (own[f"amplitude_{k}_Nm"], own[f"per_turn_{k}"], own[f"phase_{k}_rad"])
            for k in range(1, WAVES + 1)
            if f"amplitude_{k}_Nm" in own
        ]
