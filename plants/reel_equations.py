"""The reel as equations, written once with CasADi along the signal's path.

Current command -> actuator -> torque -> drum -> angle -> cable -> tension -> gauge, and the
encoder beside it:

    i = limited command, after the dead time
    J theta'' + b theta' + R T = Kt i + friction,    b = b_0 + b_L L
    T = max(0, k R theta),    1/k = 1/k_s + L/(EA) + w^2 L^3/(12 T_0^3)
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
from typing import Any, ClassVar, NamedTuple

import casadi as ca

from plants.effects import Effect, Port, Site
from plants.equations import Equations, Expression, column_of, held_input, pack

GRAVITY_m_s2 = 9.80665
SUBSTEPS = 4
THETA, OMEGA, READING, READING_RATE = range(4)
STATES = 4


def cable_stiffness_N_m(p: Any, preload_N: Any) -> Any:
    """Stiffness k of the cable in series with the structure, N/m, tangent at the preload.

    `p` is a `Reel`, or symbols of the same names.
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


class Constants(NamedTuple):
    """What is worked out once per trial; matrices are over one substep."""

    transition: Expression  # Phi, 4 x 4
    by_torque: Expression  # Gamma for a torque on the drum, 4 x 1
    by_current: Expression  # Gamma for a motor current, 4 x 1
    by_current_after: Expression  # share of it after the drive's change in midst of a substep
    change: Expression  # number of the substep in which the drive changes
    by_tension: Expression  # Gamma for tension beyond the linear law, 4 x 1
    torque_per_velocity: Expression  # inverse of by_torque[OMEGA]
    tension_per_angle: Expression  # k R
    tension_per_velocity: Expression  # k R times half a substep: to the angle at midspan
    substep_s: Expression
    amperes_per_newton: Expression
    current_limit_A: Expression
    encoder_step_rad: Expression
    effects: Expression  # parameters of the effects


@dataclass(frozen=True)
class ReelStructure:
    """What the equations depend on besides numbers: one compilation serves all reels of it.

    Attributes:
        effects: The effects added, in order.
        fractional: Whether the dead time is not a whole number of samples.
        squarings: Doublings in the matrix exponential; see `plants.equations.held_input`.
    """

    effects: tuple[type[Effect], ...]
    fractional: bool
    squarings: int

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
        "dead_time_fraction",
    )

    @staticmethod
    def squarings_for(fastest_rad_s: float, sampling_Hz: float) -> int:
        """Doublings that keep the exponential exact for a plant with this fastest rate."""
        return max(0, math.ceil(math.log2(fastest_rad_s / (sampling_Hz * SUBSTEPS))))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The parameters in order; those of the nth effect as `n.name`."""
        added = (f"{n}.{name}" for n, e in enumerate(self.effects) for name in e.parameters())
        return (*self.OWN, *added)

    def equations(self) -> Equations:
        """The reel's equations of one sample."""
        parameters = ca.SX.sym("parameters", len(self.parameter_names))
        p = SimpleNamespace(
            **{name: parameters[n] for n, name in enumerate(self.OWN)},
            effects=parameters[len(self.OWN) :],
        )
        preload, noise, effort = (ca.SX.sym(name) for name in ("preload", "noise", "effort"))
        before, after = ca.SX.sym("before"), ca.SX.sym("after")
        values, c = pack(self._constants(p, preload))
        constants = column_of(c)
        x = ca.SX.sym("x", STATES + sum(effect.states for effect in self.effects))
        stages = _Stages(c, self.effects)
        rest = ca.vertcat(preload / _tension_per_angle(p, preload), 0.0, preload, 0.0)
        rest = ca.vertcat(rest, ca.SX.zeros(x.shape[0] - STATES))
        n = ca.SX.sym("n")
        moved = self._substep(stages, x, self._driven(c, n, before, after))
        return Equations(
            prepare=ca.Function(
                "prepare", [parameters, preload], [values, ca.densify(rest), preload]
            ),
            observe=ca.Function(
                "observe", [constants, x, before, noise], stages.observe(x, noise)
            ),
            drive=ca.Function("drive", [constants, x, effort], stages.drive(x, effort)),
            substep=ca.Function("substep", [constants, x, before, after, n], [ca.densify(moved)]),
            substeps=SUBSTEPS,
        )

    def _constants(self, p: SimpleNamespace, preload: Expression) -> Constants:
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
        change = ca.floor(SUBSTEPS * p.dead_time_fraction)
        rest_of_substep = h * (change + 1 - SUBSTEPS * p.dead_time_fraction)
        by_current = B[:, 0] * p.torque_constant_Nm_A
        _, after = held_input(A, by_current, rest_of_substep, self.squarings)
        if not self.fractional:
            change, after = ca.SX(0, 0), ca.SX(STATES, 0)
        return Constants(
            transition=transition,
            by_torque=gamma[:, 0],
            by_current=gamma[:, 0] * p.torque_constant_Nm_A,
            by_current_after=after,
            change=change,
            by_tension=gamma[:, 1],
            torque_per_velocity=1.0 / gamma[OMEGA, 0],
            tension_per_angle=_tension_per_angle(p, preload),
            tension_per_velocity=_tension_per_angle(p, preload) * 0.5 * h,
            substep_s=h,
            amperes_per_newton=p.drum_radius_m / p.torque_constant_Nm_A,
            current_limit_A=p.current_limit_A,
            encoder_step_rad=2.0 * math.pi / p.encoder_counts,
            effects=p.effects,
        )

    def _driven(
        self, c: Constants, n: Expression, before: Expression, after: Expression
    ) -> Expression:
        """What the motor current adds to the state over the nth substep."""
        if not self.fractional:
            return c.by_current * after
        first = ca.if_else(n > c.change, after, before)
        last = ca.if_else(n < c.change, before, after)
        return (c.by_current - c.by_current_after) * first + c.by_current_after * last

    @staticmethod
    def _substep(stages: "_Stages", x: Expression, driven: Expression) -> Expression:
        """The state one substep later."""
        c = stages.c
        linear = c.tension_per_angle * x[THETA] + c.tension_per_velocity * x[OMEGA]
        x, tension, beyond = stages.cable(x, linear)
        free = c.transition @ x[:STATES] + driven + c.by_tension * beyond
        x, friction = stages.drum(x, free[OMEGA], tension)
        return ca.vertcat(free + c.by_torque * friction, x[STATES:])


def _tension_per_angle(p: SimpleNamespace, preload: Expression) -> Expression:
    return cable_stiffness_N_m(p, preload) * p.drum_radius_m


class _Stages:
    """The stages along the signal's path, with the effects that sit at each."""

    def __init__(self, c: Constants, effects: tuple[type[Effect], ...]) -> None:
        self.c = c
        self.effects = effects

    def drive(self, x: Expression, effort: Expression) -> list[Expression]:
        """Actuator: effort to current within its limit."""
        x, current = self._pass(Port.ACTUATOR, x, effort * self.c.amperes_per_newton)
        limit = self.c.current_limit_A
        return [x, ca.fmin(ca.fmax(current, -limit), limit)]

    def cable(
        self, x: Expression, linear: Expression
    ) -> tuple[Expression, Expression, Expression]:
        """Cable, which never pushes: tension, and how far it is beyond the linear law."""
        # Not as the difference of the two tensions, which each substep would have to wait for.
        slack = ca.fmax(-linear, 0.0)
        x, tension = self._pass(Port.CABLE, x, linear + slack, span=self.c.substep_s)
        return x, tension, slack + (tension - (linear + slack))

    def drum(
        self, x: Expression, free_velocity: Expression, tension: Expression
    ) -> tuple[Expression, Expression]:
        """Drum: the torque that effects add, each seeing the velocity the others leave."""
        torque = ca.SX(0.0)
        for effect, p, own in self._at(Port.DRUM):
            velocity = free_velocity + torque / self.c.torque_per_velocity
            site = Site(self.c.substep_s, x[THETA], velocity, tension, self.c.torque_per_velocity)
            remembered, added = effect.respond(p, x[own], torque, site)
            x = _with(x, own, remembered)
            torque = torque + added
        return x, torque

    def observe(self, x: Expression, noise: Expression) -> list[Expression]:
        """Gauge and encoder: what is read of the tension and the angle."""
        x, tension = self._pass(Port.GAUGE, x, x[READING])
        x, angle = self._pass(Port.ENCODER, x, x[THETA])
        step = self.c.encoder_step_rad
        return [x, tension + noise, ca.floor(angle / step + 0.5) * step]

    def _pass(
        self, port: Port, x: Expression, signal: Expression, span: Expression | None = None
    ) -> tuple[Expression, Expression]:
        """The signal after the effects of one port."""
        for effect, p, own in self._at(port):
            tension = self.c.tension_per_angle * x[THETA]
            span = self.c.substep_s * SUBSTEPS if span is None else span
            site = Site(span, x[THETA], x[OMEGA], tension, self.c.torque_per_velocity)
            remembered, signal = effect.respond(p, x[own], signal, site)
            x = _with(x, own, remembered)
        return x, signal

    def _at(self, port: Port) -> list[tuple[type[Effect], SimpleNamespace, slice]]:
        """The effects of a port, their parameters and their place in the state."""
        found, first_parameter, first_state = [], 0, STATES
        for effect in self.effects:
            names = list(effect.parameters())
            if effect.port is port:
                symbols = (self.c.effects[first_parameter + n] for n in range(len(names)))
                own = slice(first_state, first_state + effect.states)
                found.append(
                    (effect, SimpleNamespace(**dict(zip(names, symbols, strict=True))), own)
                )
            first_parameter += len(names)
            first_state += effect.states
        return found


def _with(x: Expression, own: slice, remembered: Expression) -> Expression:
    """The state with one effect's part renewed."""
    return ca.vertcat(x[: own.start], remembered, x[own.stop :])
