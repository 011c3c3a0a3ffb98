"""The signal's path through the reel, stage by stage; its equations are in `reel_equations`."""

from typing import NamedTuple

import casadi as ca

from plants.effects.effect import Port, Site
from plants.models.effect_stages import Stages
from plants.simulation.equations import Expression

SUBSTEPS = 4
THETA, OMEGA, READING, READING_RATE = range(4)
STATES = 4
REST_ROUNDS = 12
"""Rounds of the fixed point at rest, where a cable effect depends on the angle it leads to."""
SECANTS = 2
"""Rounds in which the velocity is sought that a rate of the tension tells."""
LEAST_rad = 1e-9
"""Least angle of such a secant."""
STEEPEST = 20.0
"""A cable is at most so many times as stiff as the linear law, and as soft."""


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


class ReelPath(NamedTuple):
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
                _, linear = self.stages.back(x, linear, self._now(port, x), moved=True)
            angle = linear / c.tension_per_angle
            to = ca.vertcat(angle, self._turning(x, angle, to[1]))
        # By the cable's own law: a slack one is softer than the linear law by far.
        still = ca.SX(0)
        before, after = (self._pull(x, at, still) for at in (x[THETA], to[0]))
        angle = ca.SX.sym("angle")
        slope = ca.substitute(ca.jacobian(self._pull(x, angle, still), angle), angle, to[0])
        gauge = x[READING:STATES] + ca.vertcat(after - before, slope * (to[1] - x[OMEGA]))
        return self.stages.put(ca.vertcat(to, gauge, x[STATES:]), to[0])

    def _turning(self, x: Expression, angle: Expression, rate_N_s: Expression) -> Expression:
        """Velocity of the drum at an angle where the tension changes at a rate.

        A cable that creeps, stiffens or sticks in the eyelet pulls more for each angle than the
        linear law: by a secant over a substep, a second time from where the first led.
        """
        span_s, linear = self.c.substep_s, self.c.tension_per_angle
        velocity = at_first = rate_N_s / linear
        for _ in range(SECANTS):
            turned = velocity * span_s + ca.if_else(velocity < 0.0, -LEAST_rad, LEAST_rad)
            later = self._pull(x, angle + turned, turned / span_s)
            per_angle = (later - self._pull(x, angle, ca.SX(0))) / (turned * linear)
            velocity = at_first / ca.fmin(ca.fmax(per_angle, 1.0 / STEEPEST), STEEPEST)
        return velocity

    def _pull(self, x: Expression, angle: Expression, velocity: Expression) -> Expression:
        """Tension at the drum at an angle, a substep after the effects remembered a state."""
        tension = self.c.tension_per_angle * angle
        site = self._now(Port.CABLE, x)._replace(
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
