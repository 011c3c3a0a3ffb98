"""A linear plant with the ports of a reel: effects act on its input, its motion and its output.

Command -> actuator -> input u of a linear plant -> output y -> gauge or encoder:

    x' = A x + B (u + tau - (T(l) - l)),    y = C x + E u,    l = y/G(0)

The torque tau of the drum's effects acts where the input does, and their velocity is y'. The
deviation of a cable's law T(l) from the restoring force l of the linear plant is fed back into the
input (the form of Lur'e); such a cable may push. Both need an output whose derivative does not
jump with the input. The numerics are those of `plants.models.reel_equations`.

Effects are declared in the units of a reel. Of a plant in other units, `torque_unit` of the input
is a newton metre and an ampere, `angle_unit` of the output a radian, a hundredth of that a
newton of the reading, and the drum's radius is 0.01 m. An output that is no angle has no turns:
effects that repeat with each turn cannot be added.
"""

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect
from plants.models.effect_stages import EffectStages
from plants.models.linear_signal_path import ARM_m, LinearPath
from plants.models.path_structure import (
    SUBSTEPS,
    EffectNumbers,
    PathStructure,
    column_of_effects,
    prepare_effects,
)
from plants.models.pole_zero_form import LinearBase
from plants.simulation.equations import Expression, held_input


@dataclass(frozen=True)
class LinearEffectStructure(PathStructure):
    """Structure of the equations of a linear plant with effects."""

    base: LinearBase  # the linear plant
    effects: tuple[type[Effect], ...]  # the effects added, in order
    fractional: bool  # whether the dead time is not a whole number of samples
    squarings: int  # doublings in the matrix exponential
    rounded: bool = True  # whether an angle is read in steps of the encoder

    COMMON: ClassVar[tuple[str, ...]] = (
        "current_limit_A",
        "encoder_counts",
        "sampling_Hz",
        "dead_time_s",
        "torque_unit",
        "angle_unit",
    )

    @property
    def own_names(self) -> tuple[str, ...]:
        return (*self.base.own, *self.COMMON)

    @property
    def placed_states(self) -> int:
        """The output and its derivatives."""
        return self.base.order

    def substitutes(self) -> dict[str, float]:
        """Arm and motor of a plant that is no drum; its poles include its own friction."""
        if self.base.is_drum:
            return {}
        return {"drum_radius_m": ARM_m, "torque_constant_Nm_A": 1.0, "viscous_friction_Nms": 0.0}

    def _path(self, c: SimpleNamespace, numbers: EffectNumbers) -> LinearPath:
        stages = EffectStages(self.effects, numbers, self.base.order)
        return LinearPath(self.base, c, stages, self.rounded)

    def _constants(
        self, parameters: Expression, preload: Expression
    ) -> tuple[SimpleNamespace, EffectNumbers]:
        given = self.split_parameters(parameters)
        nominal, p = given.nominal, given.with_effects()
        motion = self.base.motion(p)
        h = 1.0 / (p.sampling_Hz * SUBSTEPS)
        transition, gamma = held_input(motion.A, motion.B, h, self.squarings)
        by_drive = motion.B * p.torque_constant_Nm_A
        change, after = self._drive_change(motion.A, by_drive, p, given.delay)
        restoring = ca.SX(0.0) if motion.restoring is None else motion.restoring
        torque_per_velocity = ca.SX(0.0) if motion.V is None else 1.0 / (motion.V @ gamma)
        numbers = prepare_effects(
            given,
            p,
            preload,
            stiffness_N_m=restoring / p.drum_radius_m**2,
            substep_s=h,
            torque_per_velocity=torque_per_velocity,
        )
        per_ampere = nominal.drum_radius_m / nominal.torque_constant_Nm_A
        constants = SimpleNamespace(
            transition=transition,  # over one substep, as the three below
            by_torque=gamma,
            by_drive=gamma * p.torque_constant_Nm_A,
            by_drive_after=after,  # after the drive's change within a substep
            change=change,  # number of the substep in which the drive changes
            A=motion.A,
            B=motion.B,
            C=motion.C,
            E=motion.E,
            V=ca.SX(1, self.base.order) if motion.V is None else motion.V,
            restoring=restoring,
            torque_constant=p.torque_constant_Nm_A,
            drum_radius_m=p.drum_radius_m,
            torque_per_velocity=torque_per_velocity,
            substep_s=h,
            drive_per_effort=per_ampere if self.base.is_drum else 1.0 / p.torque_unit,
            limit=p.current_limit_A / p.torque_unit,
            encoder_step=2.0 * math.pi / p.encoder_counts,
            angle_unit=p.angle_unit,
            effects=column_of_effects(numbers),
        )
        return constants, numbers
