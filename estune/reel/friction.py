"""Feed-forward of friction and inertia to the drum.

The motor supplies the torque of friction and inertia beforehand, so that the tension has no error
for the PIDF to correct. All quantities are at the drum, as the paper tunes it: torques in N m,
velocities in rad/s.

Friction feed-forward is positive feedback of the velocity. The paper warns of instability when the
velocity is noisy and the friction coefficients are high: the sign changes with the noise, each
change disturbs the cable by twice the friction, and the tension decreases toward zero, where no
controller holds it. Two limits prevent this:

* the feed-forward is a fraction, below one, of the friction of (10). If the identified curve is at
  most 1/fraction too high, friction exceeds the feed-forward at any velocity;
* within the error bound of the velocity estimate, where its sign is uncertain, the sign is
  replaced by velocity / bound: zero on average over noise about rest, without jumps.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from estune.core.quantities import check_not_negative, check_positive
from estune.errors import InvalidInput
from estune.reel.velocity import Motion

Signal = Any
"""A float or an array."""


@dataclass(frozen=True, slots=True)
class StribeckFriction:
    """Dry friction with Stribeck effect, (10).

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
        check_positive("Stribeck velocity", self.stribeck_rad_s, "rad/s")

    def size_Nm(self, velocity_rad_s: Signal) -> Signal:
        """Magnitude of the friction at a velocity, the bracket of (10), N m; f_s at rest."""
        fade = np.exp(-((velocity_rad_s / self.stribeck_rad_s) ** 2))
        return self.coulomb_Nm + (self.static_Nm - self.coulomb_Nm) * fade

    def torque_Nm(self, velocity_rad_s: Signal) -> Signal:
        """Torque that balances friction at a velocity in rad/s, along the velocity, N m.

            F = (f_c + (f_s - f_c) exp(-(v/v_s)^2)) sgn(v)

        Implements (10).

        The paper calls it the Dahl equation; it is the steady state of the LuGre model without
        viscous friction. Zero at rest, where friction is anything up to f_s.
        """
        return self.size_Nm(velocity_rad_s) * np.sign(velocity_rad_s)


@dataclass(frozen=True, slots=True)
class FeedForward:
    """Feed-forward of friction and inertia.

    Attributes:
        friction: The identified dry friction.
        inertia_kgm2: Identified inertia J_m of all rotating parts at the drum, kg m2.
        fraction: Compensated share of the friction, from 0 to below 1. The identified friction may
            be too high by up to 1/fraction - 1 before the compensation drives the drum.

    Raises:
        InvalidInput: a value is out of its range.
    """

    friction: StribeckFriction
    inertia_kgm2: float
    fraction: float = 0.8

    def __post_init__(self) -> None:
        check_not_negative("inertia", self.inertia_kgm2, "kg m2")
        if not 0.0 <= self.fraction < 1.0:
            raise InvalidInput(
                f"friction fraction is {self.fraction}; from 1 on the compensation drives the "
                "drum by itself, choose one from 0 to below 1"
            )

    def friction_Nm(self, motion: Motion) -> Signal:
        """Friction compensation, N m, along the motion: (10) within its two limits.

        Args:
            motion: Estimated motion. Below its velocity bound the sign is uncertain; a velocity
                with an infinite bound, as at the first sample, is not compensated.
        """
        velocity = np.asarray(motion.velocity_rad_s)
        # The smallest float keeps an exact velocity, bound zero, from dividing zero by zero.
        scale = np.maximum(np.abs(velocity), np.maximum(motion.velocity_bound_rad_s, 5e-324))
        smooth_sign = velocity / scale
        torque = self.fraction * self.friction.size_Nm(velocity) * smooth_sign
        return torque if torque.ndim else float(torque)

    def inertia_Nm(self, motion: Motion) -> Signal:
        """Inertia compensation T_m = J_m alpha_m, N m; zero below the noise floor."""
        return self.inertia_kgm2 * motion.acceleration_rad_s2
