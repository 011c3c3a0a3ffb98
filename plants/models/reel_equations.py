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
tension a cable is softer. The linear part is propagated exactly over each of four substeps a
sample. What the cable differs from the linear law, above all when slack, is held over the substep
at its value for the angle predicted at midspan (second order); friction is a proximal step (see
`plants.effects.coulomb_friction`).
"""

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port
from plants.models.effect_stages import Stages
from plants.models.parameters import Parametrised
from plants.models.reel_signal_path import (
    OMEGA,
    READING,
    READING_RATE,
    STATES,
    SUBSTEPS,
    THETA,
    Constants,
    ReelPath,
)
from plants.simulation.equations import Equations, Expression, column_of, held_input, pack

GRAVITY_m_s2 = 9.80665
PLACED = 2


def cable_stiffness_N_m(p: Any, preload_N: Any) -> Any:
    """Stiffness k of the cable in series with the structure, N/m, tangent at the preload.

    `p` is a `ReelProgress`, or symbols of the same names.
    """
    weight_N_m = GRAVITY_m_s2 * p.cable_density_kg_m
    sag = weight_N_m**2 * p.cable_length_m**3 / (12.0 * preload_N**3)
    return 1.0 / (1.0 / p.structure_stiffness_N_m + p.cable_length_m / p.cable_EA_N + sag)


def drum_stiffness_Nm_rad(p: Any, preload_N: Any) -> Any:
    """The cable's stiffness as the drum feels it, k R^2, N m/rad."""
    return cable_stiffness_N_m(p, preload_N) * p.drum_radius_m**2


def viscous_friction_Nms(p: Any) -> Any:
    """Friction b at the deployed length, N m s/rad."""
    return p.viscous_friction_Nms + p.viscous_friction_per_length_Ns * p.cable_length_m


@dataclass(frozen=True)
class ReelStructure(Parametrised):
    """What the equations depend on besides numbers: one compilation serves all reels of it.

    Attributes:
        effects: The effects added, in order.
        fractional: Whether the dead time is not a whole number of samples.
        squarings: Doublings in the matrix exponential; see `plants.simulation.equations.held_input`.
        rounded: Whether the angle is read in steps of the encoder.
        watched: Whether there is a gauge outside even where it reads the same as inside.
        by_gauge: Whether the drum is placed by the tension read and its rate, for want of an
            encoder.
    """

    effects: tuple[type[Effect], ...]
    fractional: bool
    squarings: int
    rounded: bool = True
    watched: bool = False
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

    @staticmethod
    def squarings_for(fastest_rad_s: float, sampling_Hz: float) -> int:
        """Doublings that keep the exponential exact for a plant with this fastest rate."""
        return max(0, math.ceil(math.log2(fastest_rad_s / (sampling_Hz * SUBSTEPS))))

    @property
    def own_names(self) -> tuple[str, ...]:
        """The reel's own parameters."""
        return self.OWN

    @property
    def has_outside_gauge(self) -> bool:
        """Whether the tension outside the eyelet is another than inside, or is recorded anyway."""
        return self.watched or any(Port.EYELET in effect.ports() for effect in self.effects)

    def equations(self) -> Equations:
        """The reel's equations of one sample."""
        parameters = ca.SX.sym("parameters", len(self.parameter_names))
        preload, noise, effort = (ca.SX.sym(name) for name in ("preload", "noise", "effort"))
        before, after, n = (ca.SX.sym(name) for name in ("before", "after", "n"))
        values, numbers = self._constants(parameters, preload)
        column, c = pack(values)
        constants = column_of(c)
        at_rest = ReelPath(values, self._stages(numbers), self.has_outside_gauge)
        rest, rest_effort = at_rest.rest(preload)
        symbols = iter(ca.vertsplit(c.effects))
        reel = ReelPath(
            c,
            self._stages([{name: next(symbols) for name in known} for known in numbers]),
            self.has_outside_gauge,
        )
        x = ca.SX.sym("x", reel.stages.states)
        reading, placed = ca.SX.sym("reading"), ca.SX.sym("placed", PLACED)
        settled, settled_effort = reel.rest(reading)
        moved = reel.substep(x, self._driven(c, n, before, after))
        return Equations(
            prepare=ca.Function(
                "prepare", [parameters, preload], [column, ca.densify(rest), rest_effort]
            ),
            observe=ca.Function(
                "observe",
                [constants, x, before, noise],
                reel.observe(x, noise, rounded=self.rounded),
            ),
            drive=ca.Function("drive", [constants, x, effort], reel.drive(x, effort)),
            substep=ca.Function("substep", [constants, x, before, after, n], [ca.densify(moved)]),
            substeps=SUBSTEPS,
            late=ca.Function("late", [parameters], [self.late(parameters)]),
            settle=ca.Function(
                "settle", [constants, reading], [ca.densify(settled), settled_effort]
            ),
            locate=ca.Function("locate", [constants, x], [reel.locate(x, by_gauge=self.by_gauge)]),
            place=ca.Function(
                "place",
                [constants, x, placed],
                [ca.densify(reel.place(x, placed, by_gauge=self.by_gauge))],
            ),
            outside=ca.Function("outside", [constants, x], [reel.outside(x)])
            if self.has_outside_gauge
            else None,
        )

    def _stages(self, numbers: list[dict[str, Expression]]) -> Stages:
        return Stages(self.effects, numbers, STATES + self.has_outside_gauge)

    def _constants(
        self, parameters: Expression, preload: Expression
    ) -> tuple[Constants, list[dict[str, Expression]]]:
        """The constants, and each effect's part of them by name."""
        given = self.named(parameters)
        nominal, delay, effects = given
        p = given.amended()
        kappa = drum_stiffness_Nm_rad(p, preload)
        J, b = p.drum_inertia_kg_m2, viscous_friction_Nms(p)
        w = 2.0 * math.pi * p.gauge_Hz
        h = 1.0 / (p.sampling_Hz * SUBSTEPS)
        A = ca.SX(4, 4)
        A[THETA, OMEGA] = 1.0
        A[OMEGA, THETA], A[OMEGA, OMEGA] = -kappa / J, -b / J
        A[READING, READING_RATE] = 1.0
        A[READING_RATE, THETA] = w**2 * _tension_per_angle(p, preload)
        A[READING_RATE, READING], A[READING_RATE, READING_RATE] = -(w**2), -2 * p.gauge_damping * w
        B = ca.SX(4, 2)  # torque on the drum; tension beyond the linear law
        B[OMEGA, 0] = 1.0 / J
        B[OMEGA, 1], B[READING_RATE, 1] = -p.drum_radius_m / J, w**2
        transition, gamma = held_input(A, B, h, self.squarings)
        fraction = p.dead_time_s * p.sampling_Hz - delay
        change = ca.floor(SUBSTEPS * fraction)
        rest_of_substep = h * (change + 1 - SUBSTEPS * fraction)
        by_current = B[:, 0] * p.torque_constant_Nm_A
        _, after = held_input(A, by_current, rest_of_substep, self.squarings)
        if not self.fractional:
            change, after = ca.SX(0, 0), ca.SX(STATES, 0)
        facts = SimpleNamespace(
            **vars(p),
            preload_N=preload,
            gravity_m_s2=GRAVITY_m_s2,
            stiffness_N_m=cable_stiffness_N_m(p, preload),
            sample_s=1.0 / p.sampling_Hz,
            substep_s=h,
            torque_per_velocity=1.0 / gamma[OMEGA, 0],
        )
        numbers = [vars(known) | effect.prepare(known, facts) for effect, known in effects]
        constants = Constants(
            transition=transition,
            by_torque=gamma[:, 0],
            by_current=gamma[:, 0] * p.torque_constant_Nm_A,
            by_current_after=after,
            change=change,
            by_tension=gamma[:, 1],
            torque_per_velocity=1.0 / gamma[OMEGA, 0],
            drum_radius_m=p.drum_radius_m,
            torque_constant_Nm_A=p.torque_constant_Nm_A,
            tension_per_angle=_tension_per_angle(p, preload),
            tension_per_velocity=_tension_per_angle(p, preload) * 0.5 * h,
            substep_s=h,
            half_substep_s=0.5 * h,
            amperes_per_newton=nominal.drum_radius_m / nominal.torque_constant_Nm_A,
            current_limit_A=p.current_limit_A,
            encoder_step_rad=2.0 * math.pi / p.encoder_counts,
            effects=ca.densify(ca.vertcat(*(v for known in numbers for v in known.values()))),
        )
        return constants, numbers

    def _driven(
        self, c: Constants, n: Expression, before: Expression, after: Expression
    ) -> Expression:
        """What the motor current adds to the state over the nth substep."""
        if not self.fractional:
            return c.by_current * after
        jump = after - before
        return c.by_current * (before + (n > c.change) * jump) + c.by_current_after * (
            (n == c.change) * jump
        )


def _tension_per_angle(p: SimpleNamespace, preload: Expression) -> Expression:
    return cable_stiffness_N_m(p, preload) * p.drum_radius_m
