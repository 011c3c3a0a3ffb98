"""Friction and inertia fed forward to the drum.

The motor gives beforehand what friction and inertia will take, so that the cable's tension need
not err before the PIDF acts. Everything is in angular terms at the drum, as the paper tunes it:
forces are torques in N m, velocities are in rad/s.

Feeding friction forward is positive feedback of the velocity. The paper warns of instability when
the velocity is noisy and the friction coefficients are high: the sign flips with the noise, each
flip kicks the cable by twice the friction, and the tension decreases toward zero, where no
controller holds it. Two limits keep `compensation_Nm` on the safe side:

* it gives a fraction, below one, of the friction of (10). With the identified curve at most
  1/fraction too high, friction still takes more than the compensation gives, at any velocity;
* within the error bound of the velocity estimate, where its sign means nothing, the sign is
  replaced by velocity / bound: zero on average over noise about rest, and no jumps.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from estune.errors import InvalidInput
from estune.reel.velocity import Motion

Signal = Any
"""A float or an array."""


@dataclass(frozen=True, slots=True)
class StribeckFriction:
    """Dry friction that falls from its static to its dynamic value, (10).

    Attributes:
        coulomb_Nm: Dynamic Coulomb friction f_c, N m; zero or above.
        static_Nm: Static (Stribeck) friction f_s, N m; the Coulomb friction or above.
        stribeck_rad_s: Stribeck velocity v_s, rad/s; above zero.

    Raises:
        InvalidInput: a value is out of its range.
    """

    coulomb_Nm: float
    static_Nm: float
    stribeck_rad_s: float

    def __post_init__(self) -> None:
        values = (self.coulomb_Nm, self.static_Nm, self.stribeck_rad_s)
        if not all(map(math.isfinite, values)):
            raise InvalidInput(f"friction {values} holds a value that is not finite")
        if not 0.0 <= self.coulomb_Nm <= self.static_Nm:
            raise InvalidInput(
                f"Coulomb friction {self.coulomb_Nm} N m and static friction {self.static_Nm} N m "
                "must be zero or above, the static one not below the other"
            )
        if not self.stribeck_rad_s > 0.0:
            raise InvalidInput(
                f"Stribeck velocity is {self.stribeck_rad_s} rad/s; it must be above zero"
            )

    def size_Nm(self, velocity_rad_s: Signal) -> Signal:
        """Size of the friction at a velocity: the bracket of (10), f_s at rest, N m."""
        fade = np.exp(-((velocity_rad_s / self.stribeck_rad_s) ** 2))
        return self.coulomb_Nm + (self.static_Nm - self.coulomb_Nm) * fade

    def torque_Nm(self, velocity_rad_s: Signal) -> Signal:
        """The torque that balances friction while the drum turns: along the velocity.

            F = (f_c + (f_s - f_c) exp(-(v/v_s)^2)) sgn(v)

        Implements (10).

        The paper calls it the Dahl equation; it is the steady state of the LuGre model without
        viscous friction. Zero at rest, where friction may be anything up to f_s.

        Args:
            velocity_rad_s: Velocity of the drum, rad/s, any shape.

        Returns:
            The torque, N m, of the same shape.
        """
        return self.size_Nm(velocity_rad_s) * np.sign(velocity_rad_s)


@dataclass(frozen=True, slots=True)
class LuGreFriction:
    """Friction with bristles: stiff before it slips, (10) and viscous friction afterwards.

    With the mean deflection z of the bristles (Canudas de Wit, Olsson, Astrom & Lischinsky 1995),

        dz/dt = v - sigma_0 |v| z / g(v),    F = sigma_0 z + sigma_1 dz/dt + sigma_2 v,

    where g is the bracket of (10). Dahl's model is the case f_s = f_c, sigma_1 = 0.

    Attributes:
        dry: The steady dry friction g.
        stiffness_Nm_rad: Bristle stiffness sigma_0, N m/rad; above zero.
        damping_Nms_rad: Bristle damping sigma_1, N m s/rad; zero or above.
        viscous_Nms_rad: Viscous friction sigma_2, N m s/rad; zero or above.

    Raises:
        InvalidInput: a value is out of its range, or there is no dry friction.
    """

    dry: StribeckFriction
    stiffness_Nm_rad: float
    damping_Nms_rad: float = 0.0
    viscous_Nms_rad: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.stiffness_Nm_rad) and self.stiffness_Nm_rad > 0.0):
            raise InvalidInput(
                f"bristle stiffness is {self.stiffness_Nm_rad} N m/rad; it must be above zero"
            )
        for name in ("damping_Nms_rad", "viscous_Nms_rad"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InvalidInput(f"{name} is {value}; it must be finite, and zero or above")
        if self.dry.coulomb_Nm == 0.0:
            raise InvalidInput("Coulomb friction is 0 N m; bristles need some to slip at")

    def steady_Nm(self, velocity_rad_s: Signal) -> Signal:
        """Friction of a drum that has turned at a velocity for long, along the velocity, N m."""
        return self.dry.torque_Nm(velocity_rad_s) + self.viscous_Nms_rad * velocity_rad_s

    def step(
        self, deflection_rad: Signal, velocity_rad_s: Signal, span_s: float
    ) -> tuple[Signal, Signal]:
        """The bristles over a span at held velocity, exactly.

        Args:
            deflection_rad: Deflection z at its start, rad.
            velocity_rad_s: Velocity v, rad/s.
            span_s: Length of the span, s.

        Returns:
            The deflection at its end, rad, and the friction there, N m, along the velocity.
        """
        g = self.dry.size_Nm(velocity_rad_s)
        rate = self.stiffness_Nm_rad * np.abs(velocity_rad_s) / g
        slipping = g / self.stiffness_Nm_rad * np.sign(velocity_rad_s)
        z = slipping + (deflection_rad - slipping) * np.exp(-rate * span_s)
        z_rate = velocity_rad_s - rate * z
        torque = (
            self.stiffness_Nm_rad * z
            + self.damping_Nms_rad * z_rate
            + self.viscous_Nms_rad * velocity_rad_s
        )
        return z, torque


@dataclass(frozen=True, slots=True)
class FeedForward:
    """What is fed forward for friction and inertia.

    Attributes:
        friction: The identified dry friction.
        inertia_kgm2: Identified inertia J_m of the drum and all that turns with it, kg m2.
        fraction: Share of the friction that is compensated, from 0 to below 1. The identified
            friction may be too high by up to 1/fraction - 1 without the sum driving the drum.

    Raises:
        InvalidInput: a value is out of its range.
    """

    friction: StribeckFriction
    inertia_kgm2: float
    fraction: float = 0.8

    def __post_init__(self) -> None:
        if not (math.isfinite(self.inertia_kgm2) and self.inertia_kgm2 >= 0.0):
            raise InvalidInput(
                f"inertia is {self.inertia_kgm2} kg m2; it must be finite, and zero or above"
            )
        if not 0.0 <= self.fraction < 1.0:
            raise InvalidInput(
                f"friction fraction is {self.fraction}; from 1 on the compensation drives the "
                "drum by itself, choose one from 0 to below 1"
            )

    def friction_Nm(self, motion: Motion) -> Signal:
        """Friction compensation, N m, along the motion: (10) within its two limits.

        Args:
            motion: Estimated motion; its velocity bound is where the sign stops meaning anything.
                A velocity with an infinite bound, as at the first sample, is not compensated.
        """
        velocity = np.asarray(motion.velocity_rad_s)
        # The smallest float keeps an exact velocity, bound zero, from dividing zero by zero.
        scale = np.maximum(np.abs(velocity), np.maximum(motion.velocity_bound_rad_s, 5e-324))
        smooth_sign = velocity / scale
        torque = self.fraction * self.friction.size_Nm(velocity) * smooth_sign
        return torque if torque.ndim else float(torque)

    def inertia_Nm(self, motion: Motion) -> Signal:
        """Inertia compensation T_m = J_m alpha_m, N m; exactly zero below the noise floor."""
        return self.inertia_kgm2 * motion.acceleration_rad_s2
