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
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar, NamedTuple

import casadi as ca

from plants.effects.effect import Effect, Port, Site
from plants.equations import Equations, Expression, column_of, held_input, pack
from plants.stages import Stages, amended

GRAVITY_m_s2 = 9.80665
SUBSTEPS = 4
THETA, OMEGA, READING, READING_RATE = range(4)
STATES = 4
PLACED = 2
REST_ROUNDS = 12
"""Rounds of the fixed point at rest, where a cable effect depends on the angle it leads to."""


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
    drum_radius_m: Expression
    torque_constant_Nm_A: Expression
    tension_per_angle: Expression  # k R
    tension_per_velocity: Expression  # k R times half a substep: to the angle at midspan
    substep_s: Expression
    half_substep_s: Expression
    amperes_per_newton: Expression
    current_limit_A: Expression
    encoder_step_rad: Expression
    effects: Expression  # parameters of the effects, and what they prepared


@dataclass(frozen=True)
class ReelStructure:
    """What the equations depend on besides numbers: one compilation serves all reels of it.

    Attributes:
        effects: The effects added, in order.
        fractional: Whether the dead time is not a whole number of samples.
        squarings: Doublings in the matrix exponential; see `plants.equations.held_input`.
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
    def parameter_names(self) -> tuple[str, ...]:
        """The parameters in order; those of the nth effect as `n.name`."""
        added = (f"{n}.{name}" for n, e in enumerate(self.effects) for name in e.parameters())
        return (*self.OWN, "delay_samples", *added)

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
        at_rest = _Reel(values, self._stages(numbers), self.has_outside_gauge)
        rest, rest_effort = at_rest.rest(preload)
        symbols = iter(ca.vertsplit(c.effects))
        reel = _Reel(
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
            late=ca.Function("late", [parameters], [self._late(parameters)]),
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

    def _effects(self, parameters: Expression) -> Iterator[tuple[type[Effect], SimpleNamespace]]:
        """The effects with their parameters."""
        symbols = iter(ca.vertsplit(parameters))
        for effect in self.effects:
            yield effect, SimpleNamespace(**{name: next(symbols) for name in effect.parameters()})

    def _split(
        self, parameters: Expression
    ) -> tuple[SimpleNamespace, Expression, list[tuple[type[Effect], SimpleNamespace]]]:
        """The reel's own numbers, the whole samples of dead time, and the effects."""
        own, delay = parameters[: len(self.OWN)], parameters[len(self.OWN)]
        nominal = SimpleNamespace(**dict(zip(self.OWN, ca.vertsplit(own), strict=True)))
        return nominal, delay, list(self._effects(parameters[len(self.OWN) + 1 :]))

    def _late(self, parameters: Expression) -> Expression:
        """The dead time in samples."""
        nominal, _, effects = self._split(parameters)
        p = amended(nominal, effects)
        return p.dead_time_s * p.sampling_Hz

    def _constants(
        self, parameters: Expression, preload: Expression
    ) -> tuple[Constants, list[dict[str, Expression]]]:
        """The constants, and each effect's part of them by name."""
        nominal, delay, effects = self._split(parameters)
        p = amended(nominal, effects)
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


class _Reel(NamedTuple):
    """The stages of the signal's path: constants, effects, and whether there is a gauge outside.

    With a gauge outside the eyelet the state holds, after the reel's own four numbers, how far
    the tension there is beyond the linear law.
    """

    c: Constants
    stages: Stages
    has_outside_gauge: bool

    def drive(self, x: Expression, effort: Expression) -> list[Expression]:
        """Actuator: effort to current within its limit."""
        site = self._now(Port.ACTUATOR, x)
        x, current = self.stages.forward(x, effort * self.c.amperes_per_newton, site)
        limit = self.c.current_limit_A
        return [x, ca.fmin(ca.fmax(current, -limit), limit)]

    def substep(self, x: Expression, driven: Expression) -> Expression:
        """The state one substep later; `driven` is what the motor current adds to it."""
        c = self.c
        linear = c.tension_per_angle * x[THETA] + c.tension_per_velocity * x[OMEGA]
        site = Site(
            port=Port.CABLE,
            span_s=c.substep_s,
            angle_rad=x[THETA] + c.half_substep_s * x[OMEGA],
            start_velocity_rad_s=x[OMEGA],
            velocity_rad_s=x[OMEGA],
            tension_N=linear,
            torque_per_velocity=c.torque_per_velocity,
        )
        x, stretched = self.stages.forward(x, linear, site)
        outside = ca.fmax(stretched, 0.0)  # a cable never pushes
        x, tension = self.stages.forward(x, outside, site._replace(port=Port.EYELET))
        beyond = tension - linear
        if ca.is_equal(stretched, linear) and ca.is_equal(tension, outside):
            # Not as a difference, which each substep would have to wait for.
            beyond = ca.fmax(-linear, 0.0)
        if self.has_outside_gauge:
            x = ca.vertcat(x[:STATES], outside - linear, x[STATES + 1 :])
        free = c.transition @ x[:STATES] + driven + c.by_tension * beyond
        at_drum = site._replace(port=Port.DRUM, velocity_rad_s=free[OMEGA], tension_N=tension)
        x, torque = self.stages.torque(x, at_drum, c.by_torque[OMEGA])
        return ca.vertcat(free + c.by_torque * torque, x[STATES:])

    def observe(self, x: Expression, noise: Expression, *, rounded: bool) -> list[Expression]:
        """Gauge and encoder: what is read of the tension and the angle."""
        x, tension = self.stages.forward(x, x[READING], self._now(Port.GAUGE, x))
        x, angle = self.stages.forward(x, x[THETA], self._now(Port.ENCODER, x))
        step = self.c.encoder_step_rad
        read = ca.floor(angle / step + 0.5) * step if rounded else angle
        return [x, tension + noise, read]

    def outside(self, x: Expression) -> Expression:
        """Tension outside the eyelet, beyond the linear law by as much as over the substep."""
        return ca.fmax(self.c.tension_per_angle * x[THETA] + x[STATES], 0.0)

    def rest(self, preload: Expression) -> tuple[Expression, Expression]:
        """State and effort of the reel settled where the gauge reads the preload."""
        c, stages = self.c, self.stages
        x = ca.SX.zeros(stages.states)
        x, tension = stages.back(x, preload, self._now(Port.GAUGE, x))
        x, outside = stages.back(x, tension, self._now(Port.EYELET, x))
        linear = outside
        for _ in range(REST_ROUNDS):
            x[THETA] = linear / c.tension_per_angle
            x, linear = stages.back(x, outside, self._now(Port.CABLE, x))
        x[THETA], x[READING] = linear / c.tension_per_angle, tension
        if self.has_outside_gauge:
            x[STATES] = outside - linear
        at_drum = self._now(Port.DRUM, x)._replace(tension_N=tension)
        x, torque = stages.rest_torque(x, at_drum)
        current = (c.drum_radius_m * tension - torque) / c.torque_constant_Nm_A
        x, command = stages.back(x, current, self._now(Port.ACTUATOR, x))
        x, _ = stages.back(x, x[THETA], self._now(Port.ENCODER, x))
        return x, command / c.amperes_per_newton

    def locate(self, x: Expression, *, by_gauge: bool) -> Expression:
        """Where the drum is: angle and velocity, or the tension read and its rate."""
        if not by_gauge:
            return x[:READING]
        linear = self.c.tension_per_angle * x[:READING]
        reading = linear[0]
        for port in (Port.CABLE, Port.EYELET, Port.GAUGE):
            _, reading = self.stages.forward(x, reading, self._now(port, x))
        return ca.vertcat(reading, linear[1])

    def place(self, x: Expression, to: Expression, *, by_gauge: bool) -> Expression:
        """The drum put elsewhere; the gauge goes with it, and goes on ringing as it did.

        Args:
            x: The state.
            to: Angle and velocity, or the tension read and its rate.
            by_gauge: Whether it is the latter.
        """
        c = self.c
        if by_gauge:
            linear = to[0]
            for port in (Port.GAUGE, Port.EYELET, Port.CABLE):
                _, linear = self.stages.back(x, linear, self._now(port, x))
            to = ca.vertcat(linear, to[1]) / c.tension_per_angle
        # By the cable's own law: a slack one is softer than the linear law by far.
        before, after = (self._pull(x, at) for at in (x[THETA], to[0]))
        angle = ca.SX.sym("angle")
        slope = ca.substitute(ca.jacobian(self._pull(x, angle), angle), angle, to[0])
        gauge = x[READING:STATES] + ca.vertcat(after - before, slope * (to[1] - x[OMEGA]))
        return ca.vertcat(to, gauge, x[STATES:])

    def _pull(self, x: Expression, angle: Expression) -> Expression:
        """Tension at the drum at an angle, as the effects remember it in a state."""
        tension = self.c.tension_per_angle * angle
        site = self._now(Port.CABLE, x)._replace(
            angle_rad=angle,
            start_velocity_rad_s=ca.SX(0),
            velocity_rad_s=ca.SX(0),
            tension_N=tension,
        )
        _, tension = self.stages.forward(x, tension, site)
        tension = ca.fmax(tension, 0.0)
        _, tension = self.stages.forward(x, tension, site._replace(port=Port.EYELET))
        return tension

    def _now(self, port: Port, x: Expression) -> Site:
        """A port that is visited once a sample, or the reel at rest."""
        return Site(
            port=port,
            span_s=self.c.substep_s * SUBSTEPS,
            angle_rad=x[THETA],
            start_velocity_rad_s=x[OMEGA],
            velocity_rad_s=x[OMEGA],
            tension_N=self.c.tension_per_angle * x[THETA],
            torque_per_velocity=self.c.torque_per_velocity,
        )
