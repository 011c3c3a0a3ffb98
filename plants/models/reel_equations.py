"""The reel as equations, written once with CasADi along the signal's path.

Current command -> actuator -> torque -> drum -> angle -> cable -> tension -> gauge, and the
encoder beside it:

    i = limited command, after the dead time
    J theta'' + b theta' + R T = Kt i + friction,    b = b_0 + b_L L
    T_o = max(0, k R theta),    1/k = 1/k_s + L/(EA) + w^2 L^3/(12 T_0^3)
    T = T_o inside the eyelet as outside
    g'' + 2 zeta w_g g' + w_g^2 g = w_g^2 T

theta is zero where the cable is just taut. The last term of 1/k is the sag's share of the
flexibility (Ernst 1965; w is the cable's weight per length), taken at the preload T_0: at low
tension a cable is softer. The deviation from the linear law, large when the cable is slack, is
held over a substep at its value for the angle predicted at midspan (second order). Friction is a
proximal step (see `plants.effects.coulomb_friction`).
"""

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port
from plants.models.effect_stages import EffectStages
from plants.models.path_structure import (
    GRAVITY_M_S2,
    SUBSTEPS,
    EffectNumbers,
    PathStructure,
    column_of_effects,
    prepare_effects,
)
from plants.models.reel_signal_path import (
    OMEGA,
    READING,
    READING_RATE,
    STATES,
    THETA,
    ReelPath,
)
from plants.simulation.equations import Expression, held_input


def cable_stiffness_N_m(p: Any, preload_N: Any) -> Any:
    """Stiffness k of the cable in series with the structure, N/m, tangent at the preload.

    `p` is a `Reel`, or symbols of the same names.
    """
    weight_N_m = GRAVITY_M_S2 * p.cable_density_kg_m
    sag = weight_N_m**2 * p.cable_length_m**3 / (12.0 * preload_N**3)
    return 1.0 / (1.0 / p.structure_stiffness_N_m + p.cable_length_m / p.cable_EA_N + sag)


def drum_stiffness_Nm_rad(p: Any, preload_N: Any) -> Any:
    """Stiffness of the cable in terms of the drum's angle, k R^2, N m/rad."""
    return cable_stiffness_N_m(p, preload_N) * p.drum_radius_m**2


def viscous_friction_Nms(p: Any) -> Any:
    """Viscous friction b at the deployed length, N m s/rad."""
    return p.viscous_friction_Nms + p.viscous_friction_per_length_Ns * p.cable_length_m


@dataclass(frozen=True)
class ReelStructure(PathStructure):
    """Structure of a reel's equations."""

    effects: tuple[type[Effect], ...]  # the effects added, in order
    fractional: bool  # whether the dead time is not a whole number of samples
    squarings: int  # doublings in the matrix exponential
    rounded: bool = True  # whether the angle is read in steps of the encoder
    # Whether an outside gauge is recorded even where it reads the same as inside.
    watched: bool = False
    # Whether the drum is placed by tension and tension rate, for lack of an encoder.
    by_gauge: bool = False

    OWN: ClassVar[tuple[str, ...]] = (
        "cable_length_m",
        "drum_radius_m",
        "drum_inertia_kg_m2",
        "viscous_friction_Nms",
        "viscous_friction_per_length_Ns",
        "structure_stiffness_N_m",
        "cable_EA_N",
        "cable_density_kg_m",
        "torque_constant_Nm_A",
        "current_limit_A",
        "gauge_Hz",
        "gauge_damping",
        "encoder_counts",
        "sampling_Hz",
        "dead_time_s",
    )

    @property
    def own_names(self) -> tuple[str, ...]:
        return self.OWN

    @property
    def placed_states(self) -> int:
        """Angle and velocity of the drum, or tension and its rate."""
        return 2

    def _path(self, c: SimpleNamespace, numbers: EffectNumbers) -> ReelPath:
        outside = self.watched or any(Port.EYELET in effect.ports() for effect in self.effects)
        stages = EffectStages(self.effects, numbers, STATES + outside)
        return ReelPath(c, stages, outside, self.rounded, self.by_gauge)

    def _constants(
        self, parameters: Expression, preload: Expression
    ) -> tuple[SimpleNamespace, EffectNumbers]:
        given = self.split_parameters(parameters)
        nominal, p = given.nominal, given.with_effects()
        h = 1.0 / (p.sampling_Hz * SUBSTEPS)
        A, B = _linear_part(p, preload)
        transition, gamma = held_input(A, B, h, self.squarings)
        by_drive = B[:, 0] * p.torque_constant_Nm_A
        change, after = self._drive_change(A, by_drive, p, given.delay)
        per_angle = cable_stiffness_N_m(p, preload) * p.drum_radius_m
        torque_per_velocity = 1.0 / gamma[OMEGA, 0]
        numbers = prepare_effects(
            given,
            p,
            preload,
            stiffness_N_m=cable_stiffness_N_m(p, preload),
            substep_s=h,
            torque_per_velocity=torque_per_velocity,
        )
        constants = SimpleNamespace(
            transition=transition,  # Phi over one substep, 4 x 4
            by_torque=gamma[:, 0],  # Gamma for a torque on the drum, 4 x 1
            by_drive=gamma[:, 0] * p.torque_constant_Nm_A,
            by_drive_after=after,  # after the drive's change within a substep
            change=change,  # number of the substep in which the drive changes
            by_tension=gamma[:, 1],  # for tension beyond the linear law
            torque_per_velocity=torque_per_velocity,
            drum_radius_m=p.drum_radius_m,
            torque_constant_Nm_A=p.torque_constant_Nm_A,
            tension_per_angle=per_angle,  # k R
            tension_per_velocity=per_angle * 0.5 * h,  # to the angle at midspan
            substep_s=h,
            half_substep_s=0.5 * h,
            amperes_per_newton=nominal.drum_radius_m / nominal.torque_constant_Nm_A,
            current_limit_A=p.current_limit_A,
            encoder_step_rad=2.0 * math.pi / p.encoder_counts,
            effects=column_of_effects(numbers),
        )
        return constants, numbers


def _linear_part(p: SimpleNamespace, preload: Expression) -> tuple[Expression, Expression]:
    """A and B of the linear part; inputs: torque on the drum, tension beyond the linear law."""
    J, b, w = p.drum_inertia_kg_m2, viscous_friction_Nms(p), 2.0 * math.pi * p.gauge_Hz
    A, B = ca.SX(STATES, STATES), ca.SX(STATES, 2)
    A[THETA, OMEGA] = 1.0
    A[OMEGA, THETA], A[OMEGA, OMEGA] = -drum_stiffness_Nm_rad(p, preload) / J, -b / J
    A[READING, READING_RATE] = 1.0
    A[READING_RATE, THETA] = w**2 * (cable_stiffness_N_m(p, preload) * p.drum_radius_m)
    A[READING_RATE, READING], A[READING_RATE, READING_RATE] = -(w**2), -2 * p.gauge_damping * w
    B[OMEGA, 0] = 1.0 / J
    B[OMEGA, 1], B[READING_RATE, 1] = -p.drum_radius_m / J, w**2
    return A, B
