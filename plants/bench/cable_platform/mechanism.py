"""Equations of reels that hold one body by their cables.

For each reel, with the drum's angle theta, the length s that has slid in at the eyelet, and the
body's coordinates q, which change the distance l(q) from the eyelet to the cable's end,

    J theta'' + b theta' = R (u - T)              drum; u is the effort after the dead time
    T   = max(0, k_s (R theta - s))               cable and structure inside the eyelet
    T_o = max(0, EA/L (l(q) - l(q_0) + s))        cable outside
    g'' + 2 zeta w_g g' + w_g^2 g = w_g^2 T       gauge
    M q'' + c q' = F - (dl/dq)' T_o               body; F holds its weight and the force of a user

The cable slides at the eyelet so far that B T <= T_o <= T/B, (15) and (16): s is clipped to the
interval in which both hold, which is hysteresis. The parameters of a reel are those of
`plants.models.reel`; the cable's sag is left out.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from estune.core.quantities import FloatArray, check_not_negative, check_positive
from estune.errors import InvalidInput
from plants.models.path_structure import GRAVITY_M_S2
from plants.models.reel import Reel, reference_reel
from plants.models.reel_equations import viscous_friction_Nms

SUBSTEPS = 16
"""Symplectic Euler steps per sample: 10 kHz, 35 per period of the gauge."""

PER_REEL = 5
"""States of a reel: angle, velocity, length slid in, reading of the gauge and its rate."""


@dataclass(frozen=True)
class Mechanism:
    """Reels and the body that they hold.

    Attributes:
        reels: The reels, without effects; their dead time is taken as one sample.
        lengths_m: Distances from the eyelets to the cable ends, m, as a function of the
            coordinates q of the body, in CasADi operations.
        home: Coordinates at which the reels' own cable lengths hold; m and rad.
        masses: Mass or inertia of each coordinate, kg or kg m2.
        damping: Damping of each coordinate, N s/m or N m s/rad.
        load: Constant force on each coordinate, N or N m.
        attenuation: Attenuation ratio B of each eyelet, up to 1.

    Raises:
        InvalidInput: the numbers do not fit each other, or a reel has effects.
    """

    reels: tuple[Reel, ...]
    lengths_m: Callable[[Any], Any]
    home: tuple[float, ...]
    masses: tuple[float, ...]
    damping: tuple[float, ...]
    load: tuple[float, ...]
    attenuation: tuple[float, ...]

    def __post_init__(self) -> None:
        for value in self.masses:
            check_positive("mass of the body", value)
        for value in self.damping:
            check_not_negative("damping of the body", value)
        if not all(0.0 < B <= 1.0 for B in self.attenuation):
            raise InvalidInput(f"attenuation {self.attenuation} must lie above 0 and up to 1")
        if len(self.attenuation) != len(self.reels) or not (
            len(self.home) == len(self.masses) == len(self.damping) == len(self.load)
        ):
            raise InvalidInput(
                f"{len(self.reels)} reels need as many attenuation ratios, and every coordinate "
                "a home, a mass, a damping and a load"
            )
        if any(reel.effects for reel in self.reels):
            raise InvalidInput("reels of a platform are simulated without effects; remove them")
        if len({reel.sampling_Hz for reel in self.reels}) > 1:
            raise InvalidInput("the reels of a platform need one sampling rate")

    @property
    def sampling_Hz(self) -> float:
        """Sampling rate of the reels."""
        return self.reels[0].sampling_Hz

    @cached_property
    def kinematics(self) -> Any:
        """CasADi function from q to the lengths, m, and their Jacobian."""
        q = ca.SX.sym("q", len(self.home))
        lengths = self.lengths_m(q)
        return ca.Function("kinematics", [q], [lengths, ca.jacobian(lengths, q)])

    @property
    def softness_m_N(self) -> FloatArray:
        """Stretch of each cable with its structure per tension, m/N."""
        return np.array(
            [1.0 / r.structure_stiffness_N_m + r.cable_length_m / r.cable_EA_N for r in self.reels]
        )

    def at_rest(self, tensions_N: FloatArray) -> FloatArray:
        """State at home with these tensions on both sides of the eyelets."""
        state = np.zeros(PER_REEL * len(self.reels) + 2 * len(self.home))
        by_reel = state[: PER_REEL * len(self.reels)].reshape(len(self.reels), PER_REEL)
        inside = tensions_N / self._numbers("structure_stiffness_N_m")
        by_reel[:, 2] = tensions_N / self._outside_N_m
        by_reel[:, 0] = (inside + by_reel[:, 2]) / self._numbers("drum_radius_m")
        by_reel[:, 3] = tensions_N
        state[by_reel.size : by_reel.size + len(self.home)] = self.home
        return state

    @cached_property
    def advance(self) -> Any:
        """CasADi function: state, efforts in N and force of a user, to the state a sample later.

        Its further outputs are the gauges' readings, N, the angles, rad, and the tensions outside
        the eyelets, N, all at that state.
        """
        n, m = len(self.reels), len(self.home)
        x, effort, force = (
            ca.SX.sym("x", PER_REEL * n + 2 * m),
            ca.SX.sym("u", n),
            ca.SX.sym("F", m),
        )
        following = x
        for _ in range(SUBSTEPS):
            following = self._substep(following, effort, force)
        results = [following, *self._outputs(following)]
        return ca.Function("advance", [x, effort, force], results)

    def _substep(self, x: Any, effort: Any, force: Any) -> Any:
        """One step of symplectic Euler."""
        h = 1.0 / (self.sampling_Hz * SUBSTEPS)
        theta, omega, slid, reading, rate, q, v = self._split(x)
        R, J = self._column("drum_radius_m"), self._column("drum_inertia_kg_m2")
        b = ca.DM([viscous_friction_Nms(reel) for reel in self.reels])
        w = 2.0 * np.pi * self._column("gauge_Hz")
        zeta = self._column("gauge_damping")
        inside, outside = self._tensions(theta, slid, q)
        omega = omega + h * (R * (effort - inside) - b * omega) / J
        rate = rate + h * (w**2 * (inside - reading) - 2.0 * zeta * w * rate)
        pull = ca.mtimes(self.kinematics(q)[1].T, outside)
        push = force + ca.DM(self.load) - ca.DM(self.damping) * v - pull
        v = v + h * push / ca.DM(self.masses)
        theta, reading, q = theta + h * omega, reading + h * rate, q + h * v
        slid = self._slide(theta, slid, q)
        by_reel = ca.horzcat(theta, omega, slid, reading, rate)
        return ca.vertcat(ca.vec(by_reel.T), q, v)

    def _outputs(self, x: Any) -> tuple[Any, Any, Any]:
        theta, _, slid, reading, _, q, _ = self._split(x)
        return reading, theta, self._tensions(theta, slid, q)[1]

    def _split(self, x: Any) -> tuple[Any, ...]:
        n, m = len(self.reels), len(self.home)
        by_reel = ca.reshape(x[: PER_REEL * n], PER_REEL, n).T
        return *ca.horzsplit(by_reel), x[PER_REEL * n : PER_REEL * n + m], x[PER_REEL * n + m :]

    def _tensions(self, theta: Any, slid: Any, q: Any) -> tuple[Any, Any]:
        """Tensions inside and outside the eyelets, N."""
        wound, stretched = self._lengths(theta, q)
        inside = self._column("structure_stiffness_N_m") * (wound - slid)
        return ca.fmax(0.0, inside), ca.fmax(0.0, ca.DM(self._outside_N_m) * (stretched + slid))

    def _slide(self, theta: Any, slid: Any, q: Any) -> Any:
        """Length slid in at each eyelet, for B T <= T_o <= T/B."""
        wound, stretched = self._lengths(theta, q)
        k, k_o = self._column("structure_stiffness_N_m"), ca.DM(self._outside_N_m)
        B = ca.DM(self.attenuation)
        out = (B * k * wound - k_o * stretched) / (k_o + B * k)
        in_ = (k / B * wound - k_o * stretched) / (k_o + k / B)
        return ca.fmin(ca.fmax(slid, out), in_)

    def _lengths(self, theta: Any, q: Any) -> tuple[Any, Any]:
        """Length wound in by each drum, and by which the body has stretched the cable, m."""
        home_m = self.lengths_m(ca.DM(self.home))
        return self._column("drum_radius_m") * theta, self.lengths_m(q) - home_m

    @property
    def _outside_N_m(self) -> FloatArray:
        """Stiffness of each cable outside its eyelet, N/m."""
        return self._numbers("cable_EA_N") / self._numbers("cable_length_m")

    def _numbers(self, name: str) -> FloatArray:
        return np.array([getattr(reel, name) for reel in self.reels])

    def _column(self, name: str) -> Any:
        """A parameter of all reels; NumPy's arrays have one dimension, CasADi's two."""
        return ca.DM(self._numbers(name))


def planar_platform(
    anchors_m: Sequence[tuple[float, float]],
    attachments_m: Sequence[tuple[float, float]],
    *,
    mass_kg: float = 2.0,
    inertia_kg_m2: float = 0.03,
    attenuation: float = 1.0,
) -> Mechanism:
    """A platform on reference reels in a vertical plane; q is x, y, m, and its turn, rad.

    Args:
        anchors_m: Positions of the eyelets, m.
        attachments_m: Positions of the cable ends on the platform, m.
        mass_kg: Mass, kg.
        inertia_kg_m2: Moment of inertia, kg m2.
        attenuation: Attenuation ratio B of the eyelets.
    """
    anchors, ends = ca.DM(anchors_m), ca.DM(attachments_m)

    def lengths_m(q: Any) -> Any:
        turned_x = ends[:, 0] * ca.cos(q[2]) - ends[:, 1] * ca.sin(q[2])
        turned_y = ends[:, 0] * ca.sin(q[2]) + ends[:, 1] * ca.cos(q[2])
        x, y = q[0] + turned_x - anchors[:, 0], q[1] + turned_y - anchors[:, 1]
        return ca.sqrt(x**2 + y**2)

    home = (0.0, 0.0, 0.0)
    at_home = np.asarray(lengths_m(ca.DM(home))).ravel().tolist()
    return Mechanism(
        reels=tuple(reference_reel(cable_length_m=length) for length in at_home),
        lengths_m=lengths_m,
        home=home,
        masses=(mass_kg, mass_kg, inertia_kg_m2),
        damping=(1.0, 1.0, 0.01),
        load=(0.0, -GRAVITY_M_S2 * mass_kg, 0.0),
        attenuation=(attenuation,) * len(at_home),
    )


CARRIAGE_DAMPING_Ns_m = 3.0
"""Stands for the damping of the cables: 4 % for 0.05 kg between 12.5 kN/m on either side."""


def bench_carriage(
    x: Reel, y: Reel, attenuation: tuple[float, float] = (1.0, 1.0), mass_kg: float = 0.05
) -> Mechanism:
    """Two reels face to face with a force sensor between their cables; q is its position, m.

    It moves away from reel X. The sensor reads the tension outside the eyelet of X.

    Args:
        x: The reel under test.
        y: The reel that moves the far end.
        attenuation: Attenuation ratio B of both eyelets.
        mass_kg: Mass of the sensor, kg.
    """
    return Mechanism(
        reels=(x, y),
        lengths_m=lambda q: ca.vertcat(q[0], -q[0]),
        home=(0.0,),
        masses=(mass_kg,),
        damping=(CARRIAGE_DAMPING_Ns_m,),
        load=(0.0,),
        attenuation=attenuation,
    )
