"""Pose control of a platform: from the reels' feedback to their next setpoints."""

from collections.abc import Sequence

import numpy as np

from estune.core.quantities import FloatArray
from estune.reel.hybrid import SwitchingRules
from estune.trial import Feedback, Setpoint
from experiments.paper.cable_platform.distribution import distribute
from plants.bench.cable_platform.mechanism import Mechanism

ITERATIONS = 3
"""Gauss-Newton steps from the last pose, which lies a few millimetres away."""

VELOCITY_FILTER_S = 0.01
"""Lag of the velocity, s; the fifth part of 1/w at 20 rad/s."""


class PoseController:
    """Holds a platform at a pose: the source of the reels' setpoints.

    The pose is that which explains the cable lengths best, found from the drums' angles and
    corrected for the stretch of the cables (direct kinematics). The wrench is
    M (a_d + 2 zeta w (v_d - v) + w^2 (q_d - q)) - F, with the weight F; the tension distribution
    turns it into tensions. Where it has no solution, the reels are switched to position control.

    Attributes:
        pose: Estimated pose q.
        wrench: Wrench commanded last.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        *,
        natural_rad_s: float,
        damping_ratio: float,
        rules: SwitchingRules,
        tension_max_N: float,
    ) -> None:
        """Prepares the controller. At home without tension all angles are zero.

        Args:
            mechanism: The platform, as far as its source knows it.
            natural_rad_s: Natural frequency w of each coordinate, rad/s.
            damping_ratio: Damping ratio zeta.
            rules: Rules that select tension or position control.
            tension_max_N: Greatest tension that is commanded, N.
        """
        self._mechanism = mechanism
        self._stiffness = natural_rad_s**2
        self._damping = 2.0 * damping_ratio * natural_rad_s
        self._rules = rules
        self._max_N = tension_max_N
        self._radius_m = np.array([reel.drum_radius_m for reel in mechanism.reels])
        self.pose = np.array(mechanism.home)
        self._home_m = self._kinematics(self.pose)[0]
        self._velocity = np.zeros(self.pose.size)
        self._time_s = float("nan")
        self.wrench = np.zeros(self.pose.size)
        self._in_tension = np.ones(self._radius_m.size, np.bool_)
        self._held_rad = np.zeros(self._radius_m.size)

    def update(
        self, feedback: Sequence[Feedback], pose: FloatArray, speed: FloatArray, push: FloatArray
    ) -> tuple[Setpoint, ...]:
        """Next setpoints.

        Args:
            feedback: Feedback of the reels.
            pose: Desired pose q_d.
            speed: Its derivative v_d.
            push: Its second derivative a_d.
        """
        self.estimate(feedback)
        tensions = np.array([each.tension_N for each in feedback])
        angles = np.array([each.angle_rad for each in feedback])
        jacobian = self._kinematics(self.pose)[1]
        masses, load = np.array(self._mechanism.masses), np.array(self._mechanism.load)
        wanted = self._damping * (speed - self._velocity) + self._stiffness * (pose - self.pose)
        self.wrench = masses * (push + wanted) - load
        found = distribute(jacobian, self.wrench, self._rules.tension_min_N, self._max_N)
        solved = np.full(tensions.size, found is not None)
        distributed = tensions if found is None else found
        setpoints = self._rules.tension_setpoint_N(distributed, solved)
        in_tension = self._rules.select(self._in_tension, tensions, solved)
        # A reel that changes to position control holds the angle that it has there.
        self._held_rad = np.where(self._in_tension, angles, self._held_rad)
        self._in_tension = in_tension
        limited = np.clip(setpoints, self._rules.tension_min_N, self._max_N)
        return tuple(
            Setpoint(tension, None if by_tension else angle)
            for tension, by_tension, angle in zip(
                *(limited.tolist(), in_tension.tolist(), self._held_rad.tolist()), strict=True
            )
        )

    def estimate(self, feedback: Sequence[Feedback]) -> FloatArray:
        """Updates pose and velocity; the pose."""
        tensions = np.array([each.tension_N for each in feedback])
        angles, time_s = np.array([each.angle_rad for each in feedback]), feedback[0].time_s
        change = tensions * self._mechanism.softness_m_N - self._radius_m * angles
        measured, before = self._home_m + change, self.pose
        for _ in range(ITERATIONS):
            lengths, jacobian = self._kinematics(self.pose)
            self.pose = self.pose + np.linalg.lstsq(jacobian, measured - lengths)[0]
        passed_s, self._time_s = time_s - self._time_s, time_s
        if passed_s > 0.0:  # not at the first feedback
            # Filtered over the time in which the drum turns by some encoder counts.
            share = passed_s / (VELOCITY_FILTER_S + passed_s)
            self._velocity += share * ((self.pose - before) / passed_s - self._velocity)
        return self.pose

    def _kinematics(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        lengths, jacobian = self._mechanism.kinematics(pose)
        return np.asarray(lengths).ravel(), np.asarray(jacobian)
