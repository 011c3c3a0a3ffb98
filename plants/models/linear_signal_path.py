"""Signal path of a linear plant with effects; the equations are in `linear_with_effects`."""

from types import SimpleNamespace
from typing import NamedTuple

import casadi as ca

from plants.effects.effect import Port, Site
from plants.models.effect_stages import EffectStages
from plants.models.path_structure import SUBSTEPS
from plants.models.pole_zero_form import LinearBase
from plants.simulation.equations import Expression

ARM_m = 0.01
READINGS_PER_ANGLE = 100.0
CABLE_ROUNDS = 8
"""Newton iterations for the rest tension of a cable law that is given by its inverse."""


class LinearPath(NamedTuple):
    """Signal path of a linear plant; see `SignalPath` and `LinearEffectStructure`."""

    base: LinearBase
    c: SimpleNamespace  # constants of a trial, from `_constants` of the structure
    stages: EffectStages
    rounded: bool

    def drive(self, x: Expression, effort: Expression) -> list[Expression]:
        site = self._site(Port.ACTUATOR, x)
        x, drive = self.stages.forward(x, effort * self.c.drive_per_effort, site)
        return [x, ca.fmin(ca.fmax(drive, -self.c.limit), self.c.limit)]

    def substep(self, x: Expression, driven: Expression) -> Expression:
        c, n = self.c, self.base.order
        free = c.transition @ x[:n] + driven
        if not c.V.nnz():  # the output jumps with the input: effects give a constant torque only
            x, torque = self.stages.rest_torque(x, self._site(Port.DRUM, x))
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
        if self.base.is_drum:  # the load of a gear is the torque it passes on
            tension = c.V @ driven * c.torque_per_velocity / c.drum_radius_m
        at_drum = site._replace(port=Port.DRUM, velocity_rad_s=c.V @ free, tension_N=tension)
        x, torque = self.stages.drum_torque(x, at_drum, c.V @ c.by_torque)
        return ca.vertcat(free + c.by_torque * torque, x[n:, :])

    def observe(self, x: Expression, before: Expression, noise: Expression) -> list[Expression]:
        """Reading of the output, as measurement or as angle."""
        c = self.c
        output = c.C @ x[: self.base.order] + c.E * c.torque_constant * before
        if self.base.is_drum:
            x, angle = self.stages.forward(x, output, self._site(Port.ENCODER, x))
            step = c.encoder_step
            read = ca.floor(angle / step + 0.5) * step if self.rounded else angle
            return [x, noise, read]
        x, reading = self._read(x, output)
        return [x, reading + noise, ca.SX(0.0)]

    def outside(self, _x: Expression) -> Expression | None:
        return None

    def rest(self, reading: Expression) -> tuple[Expression, Expression]:
        c, n = self.c, self.base.order
        x = ca.SX.zeros(self.stages.states)
        if not self.base.can_rest:
            return x, ca.SX(0.0)
        x, output = self._unread(x, reading)
        torque = c.restoring * output
        x[:n] = self._rest_states(output, torque)
        x, tension = self._held_tension(x, torque / ARM_m)
        torque = ARM_m * tension if not self.base.is_drum else torque
        at_drum = self._site(Port.DRUM, x)._replace(tension_N=tension)
        x, added = self.stages.rest_torque(x, at_drum)
        drive = (torque - added) / c.torque_constant
        x, command = self.stages.inverse(x, drive, self._site(Port.ACTUATOR, x))
        return x, command / c.drive_per_effort

    def locate(self, x: Expression) -> Expression:
        """Reading and its derivatives without input, in measured units."""
        n, c = self.base.order, self.c
        if self.base.is_drum:
            return x[:n]
        _, reading = self._read(x, c.C @ x[:n])
        row, parts = c.C, [reading]
        for _ in range(n - 1):
            row = row @ c.A
            parts.append(c.angle_unit * (row @ x[:n]))
        return ca.vertcat(*parts)

    def place(self, x: Expression, target: Expression) -> Expression:
        """State at which the reading and its derivatives are the target.

        In the observer's form of `pole_zero_form` they are lower triangular in the states.
        """
        n, c = self.base.order, self.c
        if self.base.is_drum:
            return self.stages.place(ca.vertcat(target, x[n:, :]), target[0])
        _, output = self._unread(x, target[0])
        outputs = [output, *(target[k] / c.angle_unit for k in range(1, n))]
        row, states = ca.densify(c.C), ca.SX.zeros(n)
        for k in range(n):
            states[k] = (outputs[k] - row[:k] @ states[:k] if k else outputs[k]) / row[k]
            row = row @ c.A
        return ca.vertcat(states, x[n:, :])

    def _read(self, x: Expression, output: Expression) -> tuple[Expression, Expression]:
        """State and reading of the gauge, in measured units."""
        site = self._site(Port.GAUGE, x)
        x, reading = self.stages.forward(x, READINGS_PER_ANGLE * output, site)
        return x, reading * (self.c.angle_unit / READINGS_PER_ANGLE)

    def _unread(self, x: Expression, reading: Expression) -> tuple[Expression, Expression]:
        """State and output at a steady reading."""
        if self.base.is_drum:
            return x, reading
        reading = reading * (READINGS_PER_ANGLE / self.c.angle_unit)
        x, output = self.stages.inverse(x, reading, self._site(Port.GAUGE, x))
        return x, output / READINGS_PER_ANGLE

    def _rest_states(self, output: Expression, torque: Expression) -> Expression:
        """States of the linear plant at rest: 0 = A x + B u in the observer's form."""
        n, c = self.base.order, self.c
        if self.base.is_drum:
            return ca.vertcat(output, 0.0)
        states = ca.SX.zeros(n)
        states[0] = output - c.E * torque
        for k in range(n - 1):
            states[k + 1] = -(c.A[k, 0] * states[0] + c.B[k] * torque) / c.A[k, k + 1]
        return states

    def _held_tension(self, x: Expression, linear: Expression) -> tuple[Expression, Expression]:
        """State and tension of a cable at rest, for the tension of the linear law."""
        guess, site = ca.SX.sym("guess"), self._site(Port.CABLE, x)
        _, inverse = self.stages.inverse(x, guess, site)
        if ca.is_equal(inverse, guess):
            return x, linear
        correction, tension = (inverse - linear) / ca.jacobian(inverse, guess), linear
        for _ in range(CABLE_ROUNDS):
            tension = tension - ca.substitute(correction, guess, tension)
        x, _ = self.stages.inverse(x, tension, site)
        return x, tension

    def _site(self, port: Port, x: Expression) -> Site:
        """Conditions at a port that is visited once a sample, or of the plant at rest."""
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
