"""Dry friction of the drum, and its feed-forward along the motion that is known beforehand.

The motor supplies the torque of friction in advance, so that the tension has no error for the PIDF
to correct. All quantities are at the drum, as the paper tunes it: torques in N m, velocities in
rad/s.

The feed-forward follows the drum's known motion: that which the filtered setpoint and the
commanded motion of the cable's far end require of it. It does not follow the measured velocity.
Friction fed along that is positive feedback around a drum that sticks, and makes the tension hunt
even where the friction is known exactly. Along the known motion nothing is fed back: at rest the
tension is as calm as without (`python -m experiments.compensation`). Friction of a motion that
nobody announces is not compensated.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from estune.core.quantities import check_not_negative, check_positive
from estune.errors import InvalidInput

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


def slid(direction: float, moved_rad: float, memory_rad: float) -> float:
    """Direction z of sliding after a known motion, from its value before; 0 after an unknown one.

    Args:
        direction: Its value before, -1 to 1.
        moved_rad: The motion, rad; NaN where it is not known.
        memory_rad: Distance d over which z turns, rad.
    """
    if math.isnan(moved_rad):
        return 0.0
    if moved_rad == 0.0:
        return direction
    sign = math.copysign(1.0, moved_rad)
    return sign + (direction - sign) * math.exp(-abs(moved_rad) / memory_rad)


FRACTION_MAX = 1.2
"""Greatest fraction fed forward: up to it the tension at rest is as calm as without."""


@dataclass(frozen=True, slots=True)
class FrictionFeedForward:
    """Feed-forward of dry friction along the known motion of the drum.

    The direction z follows the angle s that the drum is known to have turned, as the bristles of
    Dahl (1968) do, and keeps its value at rest:

        dz = (sgn(ds) - z) |ds| / d

    so that the torque changes over the same distance as the friction of a drum that presses its
    contacts forward before it slides, at whatever velocity; see `slid`. Where a half of the
    contacts gives way sooner, z is the mean of two, over d and over d/s.

    Attributes:
        memory_rad: Presliding distance d, rad; far below any motion where the friction has none.
        load_share: Friction per tension c, without unit: adds c T R to the torque.
        fraction: Share of the friction that is fed forward, from 0 to `FRACTION_MAX`.
        spread: Factor s, one or above.

    Raises:
        InvalidInput: a value is out of its range.
    """

    friction: StribeckFriction
    memory_rad: float
    load_share: float = 0.0
    fraction: float = 0.8
    spread: float = 1.0

    def __post_init__(self) -> None:
        check_positive("presliding distance", self.memory_rad, "rad")
        check_not_negative("friction per tension", self.load_share, "")
        if not 0.0 <= self.fraction <= FRACTION_MAX:
            raise InvalidInput(
                f"friction fraction is {self.fraction}; choose one from 0 to {FRACTION_MAX:g}"
            )

    def force_N(
        self, direction: float, velocity_rad_s: float, tension_N: float, drum_radius_m: float
    ) -> float:
        """Force at the cable that is fed forward, N.

        Args:
            direction: Direction z.
            velocity_rad_s: Known velocity of the drum, rad/s.
            tension_N: Known tension, that of the filtered setpoint, N.
        """
        dry_N = float(self.friction.size_Nm(velocity_rad_s)) / drum_radius_m
        return self.fraction * direction * (dry_N + self.load_share * max(tension_N, 0.0))
