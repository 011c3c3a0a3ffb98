"""Signal path of the reel, stage by stage; the equations are in `reel_equations`."""

from types import SimpleNamespace
from typing import NamedTuple

import casadi as ca

from plants.effects.effect import Port, Site
from plants.models.effect_stages import EffectStages
from plants.models.path_structure import SUBSTEPS
from plants.simulation.equations import Expression

THETA, OMEGA, READING, READING_RATE = range(4)
STATES = 4
REST_ROUNDS = 12
"""Fixed-point iterations at rest: a cable effect may depend on the angle that it causes."""
SECANTS = 2
"""Secant iterations for the drum's velocity at a given tension rate."""
SECANT_MIN_rad = 1e-9
"""Smallest angle of a secant."""
STIFFNESS_RATIO_MAX = 20.0
"""Bound of the cable's stiffness relative to the linear law, and of the inverse."""


class ReelPath(NamedTuple):
    """Signal path of a reel; see `SignalPath` and `ReelStructure`.

    With a gauge outside the eyelet the state holds, after the reel's own four numbers, the
    tension there less that of the linear law.
    """

    c: SimpleNamespace  # constants of a trial, from `_constants` of the structure
    stages: EffectStages
    has_outside_gauge: bool
    rounded: bool
    by_gauge: bool

    def drive(self, x: Expression, effort: Expression) -> list[Expression]:
        site = self._site(Port.ACTUATOR, x)
        x, current = self.stages.forward(x, effort * self.c.amperes_per_newton, site)
        limit = self.c.current_limit_A
        return [x, ca.fmin(ca.fmax(current, -limit), limit)]

    def substep(self, x: Expression, driven: Expression) -> Expression:
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
            # Not as a difference: it would lengthen the chain of operations of every substep.
            beyond = ca.fmax(-linear, 0.0)
        if self.has_outside_gauge:
            x = ca.vertcat(x[:STATES], outside - linear, x[STATES + 1 :])
        free = c.transition @ x[:STATES] + driven + c.by_tension * beyond
        at_drum = site._replace(port=Port.DRUM, velocity_rad_s=free[OMEGA], tension_N=tension)
        x, torque = self.stages.drum_torque(x, at_drum, c.by_torque[OMEGA])
        return ca.vertcat(free + c.by_torque * torque, x[STATES:])

    def observe(self, x: Expression, before: Expression, noise: Expression) -> list[Expression]:
        """Gauge and encoder: readings of tension and angle."""
        del before
        x, tension = self.stages.forward(x, x[READING], self._site(Port.GAUGE, x))
        x, angle = self.stages.forward(x, x[THETA], self._site(Port.ENCODER, x))
        step = self.c.encoder_step_rad
        read = ca.floor(angle / step + 0.5) * step if self.rounded else angle
        return [x, tension + noise, read]

    def outside(self, x: Expression) -> Expression | None:
        """Tension outside the eyelet; its deviation from the linear law is the substep's."""
        if not self.has_outside_gauge:
            return None
        return ca.fmax(self.c.tension_per_angle * x[THETA] + x[STATES], 0.0)

    def rest(self, reading: Expression) -> tuple[Expression, Expression]:
        c, stages = self.c, self.stages
        x = ca.SX.zeros(stages.states)
        x, tension = stages.inverse(x, reading, self._site(Port.GAUGE, x))
        x, outside = stages.inverse(x, tension, self._site(Port.EYELET, x))
        linear = outside
        for _ in range(REST_ROUNDS):
            x[THETA] = linear / c.tension_per_angle
            x, linear = stages.inverse(x, outside, self._site(Port.CABLE, x))
        x[THETA], x[READING] = linear / c.tension_per_angle, tension
        if self.has_outside_gauge:
            x[STATES] = outside - linear
        at_drum = self._site(Port.DRUM, x)._replace(tension_N=tension)
        x, torque = stages.rest_torque(x, at_drum)
        current = (c.drum_radius_m * tension - torque) / c.torque_constant_Nm_A
        x, command = stages.inverse(x, current, self._site(Port.ACTUATOR, x))
        x, _ = stages.inverse(x, x[THETA], self._site(Port.ENCODER, x))
        return x, command / c.amperes_per_newton

    def locate(self, x: Expression) -> Expression:
        """Angle and velocity of the drum, or tension reading and its rate."""
        if not self.by_gauge:
            return x[:READING]
        linear = self.c.tension_per_angle * x[:READING]
        reading = linear[0]
        for port in (Port.CABLE, Port.EYELET, Port.GAUGE):
            _, reading = self.stages.forward(x, reading, self._site(port, x))
        return ca.vertcat(reading, linear[1])

    def place(self, x: Expression, target: Expression) -> Expression:
        """State with the drum placed at a target; the gauge moves along and keeps ringing."""
        c = self.c
        if self.by_gauge:
            linear = target[0]
            for port in (Port.GAUGE, Port.EYELET, Port.CABLE):
                _, linear = self.stages.inverse(x, linear, self._site(port, x), keep_memory=True)
            angle = linear / c.tension_per_angle
            target = ca.vertcat(angle, self._velocity_of(x, angle, target[1]))
        # By the cable's own law: a slack cable is far softer than the linear law.
        still = ca.SX(0)
        before, after = (self._tension_at(x, at, still) for at in (x[THETA], target[0]))
        angle = ca.SX.sym("angle")
        slope = ca.substitute(
            ca.jacobian(self._tension_at(x, angle, still), angle), angle, target[0]
        )
        gauge = x[READING:STATES] + ca.vertcat(after - before, slope * (target[1] - x[OMEGA]))
        return self.stages.place(ca.vertcat(target, gauge, x[STATES:]), target[0])

    def _velocity_of(self, x: Expression, angle: Expression, rate_N_s: Expression) -> Expression:
        """Velocity of the drum at an angle and a rate of the tension.

        A cable that creeps, stiffens or sticks in the eyelet is stiffer than the linear law: its
        stiffness is taken as a secant over a substep.
        """
        span_s, linear = self.c.substep_s, self.c.tension_per_angle
        velocity = at_first = rate_N_s / linear
        for _ in range(SECANTS):
            turned = velocity * span_s + ca.if_else(
                velocity < 0.0, -SECANT_MIN_rad, SECANT_MIN_rad
            )
            later = self._tension_at(x, angle + turned, turned / span_s)
            per_angle = (later - self._tension_at(x, angle, ca.SX(0))) / (turned * linear)
            velocity = at_first / ca.fmin(
                ca.fmax(per_angle, 1.0 / STIFFNESS_RATIO_MAX), STIFFNESS_RATIO_MAX
            )
        return velocity

    def _tension_at(self, x: Expression, angle: Expression, velocity: Expression) -> Expression:
        """Tension at the drum at an angle, one substep after the state x."""
        tension = self.c.tension_per_angle * angle
        site = self._site(Port.CABLE, x)._replace(
            span_s=self.c.substep_s,
            angle_rad=angle,
            start_velocity_rad_s=velocity,
            velocity_rad_s=velocity,
            tension_N=tension,
        )
        x, tension = self.stages.forward(x, tension, site)
        tension = ca.fmax(tension, 0.0)
        _, tension = self.stages.forward(x, tension, site._replace(port=Port.EYELET))
        return tension

    def _site(self, port: Port, x: Expression) -> Site:
        """Conditions at a port that is visited once a sample, or of the reel at rest."""
        return Site(
            port=port,
            span_s=self.c.substep_s * SUBSTEPS,
            angle_rad=x[THETA],
            start_velocity_rad_s=x[OMEGA],
            velocity_rad_s=x[OMEGA],
            tension_N=self.c.tension_per_angle * x[THETA],
            torque_per_velocity=self.c.torque_per_velocity,
        )
