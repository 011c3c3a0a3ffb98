"""An unloaded reel, or any servo or stage, compared with records."""

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise import step_of
from plants.diagnosis.models.diagnosed_model import DiagnosedModel, Local, free_drum
from plants.diagnosis.models.free_parameters import (
    Slot,
    either_way,
    from_zero,
    of_calibration,
    positive,
)
from plants.effects import Effect, Role
from plants.models.effect_applicability import MOVED_BY_TORQUE, unavailable
from plants.models.linear_structures import DrumStructure
from plants.models.linear_with_effects import LinearEffectStructure
from plants.models.unloaded_reel import UnloadedReel


class DiagnosedDrum(DiagnosedModel):
    """An `UnloadedReel`."""

    model: UnloadedReel
    output = "rad"
    placed_by = "angle_rad"

    def __init__(self, model: UnloadedReel, measurements: Sequence[MeasuredRecord]) -> None:
        self.newtons_per_ampere = model.newtons_per_ampere
        self.torque_per_drive = model.torque_constant_Nm_A
        super().__init__(model, measurements)

    @property
    def outputs(self) -> tuple[str, ...]:
        """The encoder."""
        return ("angle_rad",)

    def preload(self, measurement: MeasuredRecord) -> float:  # noqa: ARG002  there is none
        """None."""
        return 0.0

    def unavailable(self, effect: type[Effect]) -> str | None:
        """Effects of cable, eyelet and gauge have no place, nor one of an actuator's position."""
        if effect.of_process:
            return MOVED_BY_TORQUE
        return unavailable(DrumStructure(), effect)

    def structure(self, effects: tuple[type[Effect], ...]) -> LinearEffectStructure:
        """The drum with these effects."""
        p = self.model
        # Friction over inertia may grow a hundredfold in a fit.
        n = self.squarings(100.0 * max(p.viscous_friction_Nms, 1e-300) / p.drum_inertia_kg_m2)
        return LinearEffectStructure(
            DrumStructure(), effects, fractional=True, squarings=n, rounded=False
        )

    def turned(self, measurement: MeasuredRecord) -> FloatArray:
        """The angle read."""
        return np.empty(0) if measurement.angle_rad is None else measurement.angle_rad

    def _calibrations(self) -> list[Slot]:
        p, c = self.model, self.calibration
        # Friction that would take all of the torque at the recorded velocities.
        speed = self.sizes.velocity_rms_rad_s
        most = self.sizes.torque_max_Nm / speed if speed > 0.0 else 0.0
        most = max(most, 20.0 * p.viscous_friction_Nms)
        inertia = positive("drum_inertia_kg_m2", "kg m2", p.drum_inertia_kg_m2)
        friction = from_zero("viscous_friction_Nms", "N m s/rad", p.viscous_friction_Nms, most)
        reach = max(self.sizes.torque_max_Nm, 1e-300)
        offset = either_way("torque_offset_Nm", "N m", c.torque_offset_Nm, reach)
        return [
            Slot(inertia, inertia.name),
            Slot(friction, friction.name),
            of_calibration(offset),
        ]

    def slots(self, added: Sequence[type[Effect]]) -> list[Slot]:
        """The free parameters; with a wave over the angle, each record's zero of the encoder.

        An incremental encoder starts at any angle: the wave has another phase in each record.
        """
        slots = super().slots(added)
        declared = (type(effect) for effect in self.effects)
        angles = [(n, m.angle_rad) for n, m in enumerate(self.measurements)]
        turning = [(n, angle) for n, angle in angles if angle is not None]
        if len(turning) < 2 or not any(effect.named(Role.PHASE) for effect in (*declared, *added)):
            return slots
        for n, angle in turning:
            middle, name = float(angle.mean()), f"encoder_zero_rad[{n}]"
            free = either_way(name, "rad", middle, 2.0 * math.pi, f"record {n}")
            slots.append(Slot(free, "angle_zero", record=n))
        return slots

    def local(self, measurement: MeasuredRecord) -> Local:
        """Angle and velocity under a constant torque."""
        del measurement
        return free_drum()

    @cached_property
    def suggested_horizon_s(self) -> float:
        """Time in which a tenth of the torque's rms moves the drum well past the encoder's step.

        A torque tau moves it by tau t^2/(2 J), of which the initial state explains all but 1/12.
        """
        steps = [step_of(m.angle_rad) for m in self.measurements if m.angle_rad is not None]
        step = max(steps, default=0.0) or 2.0 * math.pi / self.model.encoder_counts
        step /= math.sqrt(12.0)
        torque = 0.1 * max(self.sizes.torque_rms_Nm, 1e-300)
        wanted = math.sqrt(
            12.0 * 2.0 * self.model.drum_inertia_kg_m2 * CONSTANTS.travel * step / torque
        )
        # Longer windows weigh slow errors more: with 24 samples at least Coulomb friction of a
        # measured drive at 100 Hz comes out 7 % off, with 10 or 8 3 %.
        return self.window_s(wanted, 10)
