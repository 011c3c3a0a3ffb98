"""A reel with a platform on its cable: one degree of freedom along the cable.

    J omega' + b omega + friction = R (u - T)           drum; u is the effort after the dead time
    m x'' + c x' + k_c x = T_o + F - T            platform; x grows away from the reel
    T = max(0, k (R theta + x))                         cable; theta grows as it is wound in

T_o is the pull of the opposite reels, k_c and c the stiffness and damping with which they centre
the platform, and F the force of the user along the cable. Dry friction is a proximal step, as in
the reel's effects: the torque that stops the drum, at most that of (10). The moving cable end is
the case for compensation and the hybrid controller.
"""

from dataclasses import dataclass
from typing import NamedTuple

from estune.core.gains import Gains
from estune.core.quantities import check_not_negative, check_positive
from estune.errors import InvalidInput
from estune.reel.friction import StribeckFriction
from plants.models.reel import Reel
from plants.models.reel_equations import cable_stiffness_N_m, viscous_friction_Nms

SUBSTEPS = 16
"""Symplectic Euler steps per sample: 10 kHz, over 100 per period of the fastest mode."""

TENSION_GAINS = Gains(P=0.6, I=12.0, D=0.01, setpoint_filter_s=0.02)
"""Tension gains of the reference reel, well damped with the platform free or held."""


class PlatformState(NamedTuple):
    """State of drum and platform, and the delayed effort."""

    angle_rad: float
    velocity_rad_s: float
    position_m: float
    speed_m_s: float
    delayed_N: float


@dataclass(frozen=True)
class Platform:
    """A platform and its reel, which gives the parameters of drum, cable, gauge and encoder."""

    reel: Reel  # the reel, without effects; its dead time is taken as one sample
    friction: StribeckFriction  # dry friction of the drum
    mass_kg: float = 1.0  # mass m of the platform, kg
    damping_Ns_m: float = 1.0  # damping c, N s/m
    centring_N_m: float = 0.0  # stiffness k_c, N/m; zero for a free platform

    def __post_init__(self) -> None:
        check_positive("platform: mass_kg", self.mass_kg, "kg")
        check_not_negative("platform: damping_Ns_m", self.damping_Ns_m, "N s/m")
        check_not_negative("platform: centring_N_m", self.centring_N_m, "N/m")
        if self.reel.effects:
            raise InvalidInput(
                "platform: the reel has effects, which are not simulated; remove them"
            )

    def at_rest(self, position_m: float = 0.0) -> PlatformState:
        """State at rest at a position, with the cable at the reel's tension."""
        k = cable_stiffness_N_m(self.reel, self.reel.tension_N)
        stretch = self.reel.tension_N / k
        angle = (stretch - position_m) / self.reel.drum_radius_m
        return PlatformState(angle, 0.0, position_m, 0.0, self.reel.tension_N)

    def tension_N(self, state: PlatformState) -> float:
        """Tension of the cable, N."""
        k = cable_stiffness_N_m(self.reel, self.reel.tension_N)
        stretch = self.reel.drum_radius_m * state.angle_rad + state.position_m
        return float(max(0.0, k * stretch))

    def step(self, state: PlatformState, effort_N: float, outward_N: float) -> PlatformState:
        """State at the next sample.

        Args:
            state: State at this sample.
            effort_N: Effort of the controller, N; it acts one sample later.
            outward_N: T_o + F, N, held over the sample.
        """
        reel = self.reel
        R, J, b = reel.drum_radius_m, reel.drum_inertia_kg_m2, viscous_friction_Nms(reel)
        k = cable_stiffness_N_m(reel, reel.tension_N)
        h = 1.0 / (reel.sampling_Hz * SUBSTEPS)
        theta, omega, x, v, effort = state
        for _ in range(SUBSTEPS):
            tension = max(0.0, k * (R * theta + x))
            free = omega + h * (R * (effort - tension) - b * omega) / J
            dry = h * float(self.friction.size_Nm(omega)) / J
            omega = free - min(max(free, -dry), dry)
            theta += h * omega
            pull = outward_N - tension - self.damping_Ns_m * v - self.centring_N_m * x
            v += h * pull / self.mass_kg
            x += h * v
        return PlatformState(theta, omega, x, v, effort_N)
