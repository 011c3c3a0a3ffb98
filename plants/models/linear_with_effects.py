"""A linear plant with the ports of a reel: effects act on its input, its motion and its output.

Command -> actuator -> input u of a linear plant -> output y -> gauge or encoder:

    x' = A x + B (u + tau - (T(l) - l)),    y = C x + E u,    l = y/G(0)

The torque tau of the drum's effects goes where the input does, and their velocity is y'. What a
cable's effects make of the restoring force l of the linear plant is fed back into its input (the
form of Lur'e); such a cable may push. Both need an output whose derivative does not jump with the
input. As in `plants.models.reel_equations` the linear part is propagated exactly over each of four
substeps a sample, the cable's law is held at midspan, and friction is a proximal step.

Effects are declared in the units of a reel. Of a plant in other units, `torque_unit` of the input
stand for a newton metre and for an ampere, `angle_unit` of the output for a radian, a hundredth of
the latter for a newton read, and the drum's radius is 0.01 m. Where the output is no angle, it has
no turns either: effects that repeat with each turn have no place there.
"""

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar, NamedTuple

import casadi as ca

from plants.effects.effect import Effect, Port, Site
from plants.models.effect_stages import Stages
from plants.models.linear_structures import Base, Motion
from plants.models.parameters import Parametrised
from plants.models.reel_equations import GRAVITY_m_s2, ReelStructure
from plants.models.reel_signal_path import SUBSTEPS
from plants.simulation.equations import Equations, Expression, column_of, held_input, pack

ARM_m = 0.01
READINGS_PER_ANGLE = 100.0
CABLE_ROUNDS = 8
"""Rounds of Newton's method for the tension at rest of a cable whose law is given backwards."""


class _Constants(NamedTuple):
    """What is worked out once per trial; matrices are over one substep."""

    transition: Expression
    by_torque: Expression
    by_drive: Expression
    by_drive_after: Expression  # share of it after the drive's change in midst of a substep
    change: Expression  # number of the substep in which the drive changes
    A: Expression
    B: Expression
    C: Expression
    E: Expression
    V: Expression
    restoring: Expression
    torque_constant: Expression
    torque_per_velocity: Expression
    substep_s: Expression
    drive_per_effort: Expression
    limit: Expression
    encoder_step: Expression
    angle_unit: Expression
    effects: Expression


@dataclass(frozen=True)
class LinearEffectStructure(Parametrised):
    """What the equations depend on besides numbers: one compilation serves all plants of it.

    Attributes:
        base: The linear plant.
        effects: The effects added, in order.
        fractional: Whether the dead time is not a whole number of samples.
        squarings: Doublings in the matrix exponential; see `plants.simulation.equations.held_input`.
        rounded: Whether an angle is read in steps of the encoder.
    """

    base: Base
    effects: tuple[type[Effect], ...]
    fractional: bool
    squarings: int
    rounded: bool = True

    COMMON: ClassVar[tuple[str, ...]] = (
        "current_limit_A",
        "encoder_counts",
        "sampling_Hz",
        "dead_time_s",
        "torque_unit",
        "angle_unit",
    )
    has_outside_gauge: ClassVar[bool] = False

    @staticmethod
    def squarings_for(fastest_rad_s: float, sampling_Hz: float) -> int:
        """Doublings that keep the exponential exact for a plant with this fastest rate."""
        return ReelStructure.squarings_for(fastest_rad_s, sampling_Hz)

    @property
    def own_names(self) -> tuple[str, ...]:
        """The plant's own parameters."""
        return (*self.base.own, *self.COMMON)

    def plain_numbers(self) -> dict[str, float]:
        """Arm and motor of a plant that is no drum; its own friction is in its poles."""
        if self.base.is_drum:
            return {}
        return {"drum_radius_m": ARM_m, "torque_constant_Nm_A": 1.0, "viscous_friction_Nms": 0.0}

    def equations(self) -> Equations:
        """The plant's equations of one sample.

        Raises:
            AttributeError: an effect asks for what such a plant does not have.
        """
        parameters = ca.SX.sym("parameters", len(self.parameter_names))
        preload, noise, effort = (ca.SX.sym(name) for name in ("preload", "noise", "effort"))
        before, after, n = (ca.SX.sym(name) for name in ("before", "after", "n"))
        values, numbers, motion = self._constants(parameters, preload)
        column, c = pack(values)
        constants = column_of(c)
        moves, stands = motion.V is not None, motion.restoring is not None
        at_rest = _Plant(self.base, values, Stages(self.effects, numbers, self.base.order), stands)
        rest, rest_effort = at_rest.rest(preload)
        symbols = iter(ca.vertsplit(c.effects))
        known = [{name: next(symbols) for name in one} for one in numbers]
        plant = _Plant(self.base, c, Stages(self.effects, known, self.base.order), stands)
        x, reading = ca.SX.sym("x", plant.stages.states), ca.SX.sym("reading")
        placed = ca.SX.sym("placed", self.base.order)
        settled, settled_effort = plant.rest(reading)
        moved = plant.substep(x, self._driven(c, n, before, after), moves=moves)
        observed = plant.observe(x, before, noise, rounded=self.rounded)
        return Equations(
            prepare=ca.Function(
                "prepare", [parameters, preload], [column, ca.densify(rest), rest_effort]
            ),
            observe=ca.Function("observe", [constants, x, before, noise], observed),
            drive=ca.Function("drive", [constants, x, effort], plant.drive(x, effort)),
            substep=ca.Function("substep", [constants, x, before, after, n], [ca.densify(moved)]),
            substeps=SUBSTEPS,
            late=ca.Function("late", [parameters], [self.late(parameters)]),
            settle=ca.Function(
                "settle", [constants, reading], [ca.densify(settled), settled_effort]
            ),
            locate=ca.Function("locate", [constants, x], [ca.densify(plant.locate(x))]),
            place=ca.Function(
                "place", [constants, x, placed], [ca.densify(plant.place(x, placed))]
            ),
        )

    def _constants(
        self, parameters: Expression, preload: Expression
    ) -> tuple[_Constants, list[dict[str, Expression]], Motion]:
        """The constants, each effect's part of them by name, and the plant."""
        given = self.named(parameters)
        nominal, delay, effects = given
        p = given.amended()
        motion = self.base.motion(p)
        n, h = self.base.order, 1.0 / (p.sampling_Hz * SUBSTEPS)
        transition, gamma = held_input(motion.A, motion.B, h, self.squarings)
        fraction = p.dead_time_s * p.sampling_Hz - delay
        change = ca.floor(SUBSTEPS * fraction)
        rest_of_substep = h * (change + 1 - SUBSTEPS * fraction)
        by_drive = motion.B * p.torque_constant_Nm_A
        _, after = held_input(motion.A, by_drive, rest_of_substep, self.squarings)
        if not self.fractional:
            change, after = ca.SX(0, 0), ca.SX(n, 0)
        V = ca.SX(1, n) if motion.V is None else motion.V
        restoring = ca.SX(0.0) if motion.restoring is None else motion.restoring
        facts = SimpleNamespace(
            **vars(p),
            preload_N=preload,
            gravity_m_s2=GRAVITY_m_s2,
            stiffness_N_m=restoring / p.drum_radius_m**2,
            sample_s=1.0 / p.sampling_Hz,
            substep_s=h,
            torque_per_velocity=ca.SX(0.0) if motion.V is None else 1.0 / (V @ gamma),
        )
        numbers = [vars(known) | effect.prepare(known, facts) for effect, known in effects]
        per_ampere = nominal.drum_radius_m / nominal.torque_constant_Nm_A
        constants = _Constants(
            transition=transition,
            by_torque=gamma,
            by_drive=gamma * p.torque_constant_Nm_A,
            by_drive_after=after,
            change=change,
            A=motion.A,
            B=motion.B,
            C=motion.C,
            E=motion.E,
            V=V,
            restoring=restoring,
            torque_constant=p.torque_constant_Nm_A,
            torque_per_velocity=facts.torque_per_velocity,
            substep_s=h,
            drive_per_effort=per_ampere if self.base.is_drum else 1.0 / p.torque_unit,
            limit=p.current_limit_A / p.torque_unit,
            encoder_step=2.0 * math.pi / p.encoder_counts,
            angle_unit=p.angle_unit,
            effects=ca.densify(ca.vertcat(*(v for known in numbers for v in known.values()))),
        )
        return constants, numbers, motion

    def _driven(
        self, c: _Constants, n: Expression, before: Expression, after: Expression
    ) -> Expression:
        """What the drive adds to the state over the nth substep."""
        if not self.fractional:
            return c.by_drive * after
        jump = after - before
        return c.by_drive * (before + (n > c.change) * jump) + c.by_drive_after * (
            (n == c.change) * jump
        )


class _Plant(NamedTuple):
    """The stages of the signal's path: constants, effects, and whether it can stand off zero."""

    base: Base
    c: _Constants
    stages: Stages
    stands: bool

    def drive(self, x: Expression, effort: Expression) -> list[Expression]:
        """Actuator: effort to drive within its limit."""
        site = self._now(Port.ACTUATOR, x)
        x, drive = self.stages.forward(x, effort * self.c.drive_per_effort, site)
        return [x, ca.fmin(ca.fmax(drive, -self.c.limit), self.c.limit)]

    def substep(self, x: Expression, driven: Expression, *, moves: bool) -> Expression:
        """The state one substep later; `driven` is what the drive adds to it."""
        c, n = self.c, self.base.order
        free = c.transition @ x[:n] + driven
        if not moves:  # then only a constant torque can be there
            x, torque = self.stages.rest_torque(x, self._now(Port.DRUM, x))
            return ca.vertcat(free + c.by_torque * torque, x[n:, :])
        velocity = c.V @ x[:n]
        angle = c.C @ x[:n] + 0.5 * c.substep_s * velocity
        linear = c.restoring * angle / ARM_m
        site = Site(
            port=Port.CABLE,
            span_s=c.substep_s,
            angle_rad=angle if self.base.is_drum else None,
            start_velocity_rad_s=velocity,
            velocity_rad_s=velocity,
            tension_N=linear,
            torque_per_velocity=c.torque_per_velocity,
        )
        x, tension = self.stages.forward(x, linear, site)
        if not ca.is_equal(tension, linear):
            free = free - c.by_torque * (ARM_m * (tension - linear))
        at_drum = site._replace(port=Port.DRUM, velocity_rad_s=c.V @ free, tension_N=tension)
        x, torque = self.stages.torque(x, at_drum, c.V @ c.by_torque)
        return ca.vertcat(free + c.by_torque * torque, x[n:, :])

    def observe(
        self, x: Expression, before: Expression, noise: Expression, *, rounded: bool
    ) -> list[Expression]:
        """The output as it is read, as measurement or as angle."""
        c = self.c
        output = c.C @ x[: self.base.order] + c.E * c.torque_constant * before
        if self.base.is_drum:
            x, angle = self.stages.forward(x, output, self._now(Port.ENCODER, x))
            step = c.encoder_step
            read = ca.floor(angle / step + 0.5) * step if rounded else angle
            return [x, noise, read]
        x, reading = self._read(x, output)
        return [x, reading + noise, ca.SX(0.0)]

    def rest(self, reading: Expression) -> tuple[Expression, Expression]:
        """State and effort of the plant at rest where it reads so."""
        c, n = self.c, self.base.order
        x = ca.SX.zeros(self.stages.states)
        if not self.stands:
            return x, ca.SX(0.0)
        x, output = self._unread(x, reading)
        torque = c.restoring * output
        x[:n] = self._standing(output, torque)
        x, tension = self._held_tension(x, torque / ARM_m)
        torque = ARM_m * tension if not self.base.is_drum else torque
        at_drum = self._now(Port.DRUM, x)._replace(tension_N=tension)
        x, added = self.stages.rest_torque(x, at_drum)
        drive = (torque - added) / c.torque_constant
        x, command = self.stages.back(x, drive, self._now(Port.ACTUATOR, x))
        return x, command / c.drive_per_effort

    def locate(self, x: Expression) -> Expression:
        """Output and its derivatives without input, in measured units."""
        n, c = self.base.order, self.c
        if self.base.is_drum:
            return x[:n]
        _, reading = self._read(x, c.C @ x[:n])
        row, found = c.C, [reading]
        for _ in range(n - 1):
            row = row @ c.A
            found.append(c.angle_unit * (row @ x[:n]))
        return ca.vertcat(*found)

    def place(self, x: Expression, to: Expression) -> Expression:
        """The state put where output and derivatives are these.

        In the observer's form, which `plants.models.pole_zero_form` has, output and derivatives are lower
        triangular in the states.
        """
        n, c = self.base.order, self.c
        if self.base.is_drum:
            return self.stages.put(ca.vertcat(to, x[n:, :]), to[0])
        _, output = self._unread(x, to[0])
        wanted = [output, *(to[k] / c.angle_unit for k in range(1, n))]
        row, states = ca.densify(c.C), ca.SX.zeros(n)
        for k in range(n):
            states[k] = (wanted[k] - row[:k] @ states[:k] if k else wanted[k]) / row[k]
            row = row @ c.A
        return ca.vertcat(states, x[n:, :])

    def _read(self, x: Expression, output: Expression) -> tuple[Expression, Expression]:
        """State and reading of a gauge, in measured units."""
        site = self._now(Port.GAUGE, x)
        x, reading = self.stages.forward(x, READINGS_PER_ANGLE * output, site)
        return x, reading * (self.c.angle_unit / READINGS_PER_ANGLE)

    def _unread(self, x: Expression, reading: Expression) -> tuple[Expression, Expression]:
        """State and output of a plant that steadily reads so."""
        if self.base.is_drum:
            return x, reading
        reading = reading * (READINGS_PER_ANGLE / self.c.angle_unit)
        x, output = self.stages.back(x, reading, self._now(Port.GAUGE, x))
        return x, output / READINGS_PER_ANGLE

    def _standing(self, output: Expression, torque: Expression) -> Expression:
        """The linear plant's state at rest, from 0 = A x + B u in the observer's form."""
        n, c = self.base.order, self.c
        if self.base.is_drum:
            return ca.vertcat(output, 0.0)
        states = ca.SX.zeros(n)
        states[0] = output - c.E * torque
        for k in range(n - 1):
            states[k + 1] = -(c.A[k, 0] * states[0] + c.B[k] * torque) / c.A[k, k + 1]
        return states

    def _held_tension(self, x: Expression, linear: Expression) -> tuple[Expression, Expression]:
        """State and tension of a cable at rest, where the linear law has this one."""
        guess, site = ca.SX.sym("guess"), self._now(Port.CABLE, x)
        _, back = self.stages.back(x, guess, site)
        if ca.is_equal(back, guess):
            return x, linear
        correction, tension = (back - linear) / ca.jacobian(back, guess), linear
        for _ in range(CABLE_ROUNDS):
            tension = tension - ca.substitute(correction, guess, tension)
        x, _ = self.stages.back(x, tension, site)
        return x, tension

    def _now(self, port: Port, x: Expression) -> Site:
        """A port that is visited once a sample, or the plant at rest."""
        c, states = self.c, x[: self.base.order]
        angle, velocity = c.C @ states, c.V @ states
        return Site(
            port=port,
            span_s=c.substep_s * SUBSTEPS,
            angle_rad=angle if self.base.is_drum else None,
            start_velocity_rad_s=velocity,
            velocity_rad_s=velocity,
            tension_N=c.restoring * angle / ARM_m,
            torque_per_velocity=c.torque_per_velocity,
        )
