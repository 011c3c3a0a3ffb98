"""A simulated two-reel bench: drums, an elastic cable, and eyelets with stick and slip.

Quasi-static: the cable has no mass, and in each period no eyelet holds more than its friction
limit. There are three lengths of cable between X and Y. With w the length wound in by each drum
and s the length that has slid in at each eyelet,

    T_x = k_x (w_x - s_x),    T_o = k_o (s_x + s_y),    T_y = k_y (w_y - s_y)

and each eyelet keeps `B T <= T_o <= T/B`. The result is hysteresis: after a reversal the cable
sticks, and the tension at one reel does not determine that at the other.
"""

import math

import numpy as np

from estune.core.quantities import FloatArray, check_positive
from estune.errors import InvalidInput, PlantError
from experiments.paper.two_reels.bench_parts import Eyelet, ReelModel
from experiments.paper.two_reels.friction_ratio import log_loss
from experiments.paper.two_reels.rig import BenchReading, BenchRecord
from experiments.paper.two_reels.simulated_reel import SimulatedReel

_ROUNDS = 200
"""Iterations of alternate sliding; each at least halves the error."""

_ROUNDING_N = 1e-10

_SLIDING_MEMORY_s = 0.1
"""Lag of friction behind the sliding velocity, as in rate-and-state friction."""


class _Contact:
    """State of one eyelet: sliding velocity and present attenuation ratio."""

    def __init__(self, eyelet: Eyelet) -> None:
        self.eyelet = eyelet
        self.velocity_m_s = 0.0
        self.factor = 1.0
        self._bends = [math.cos(0.5 * gamma) for gamma in eyelet.angles_rad]
        self._coefficient = -1.0
        self._ratio = 1.0

    def ratio(self, tension_N: float) -> float:
        """Attenuation ratio B."""
        coefficient = self.factor * self.eyelet.coefficient_at(tension_N, self.velocity_m_s)
        if coefficient != self._coefficient:
            if not 0.0 <= coefficient < 1.0:
                raise PlantError(
                    f"friction coefficient became {coefficient:.3g} at {tension_N:.3g} N and "
                    f"{self.velocity_m_s:.3g} m/s; it must stay within 0 and 1, lower its growth"
                )
            self._coefficient = coefficient
            loss = sum(float(log_loss(coefficient, bend)) for bend in self._bends)
            self._ratio = math.exp(-loss)
        return self._ratio


class SimulatedBench:
    """Two simulated reels on one cable; a `Bench`.

    Both start at rest with the same tension everywhere.

    Attributes:
        x: Reel X, whose gauge should read newtons.
        y: Reel Y.

    Raises:
        InvalidInput: a stiffness, rate or tension is not above zero.
    """

    def __init__(
        self,
        x: ReelModel,
        y: ReelModel,
        *,
        outer_stiffness_N_m: float = 10e3,
        tension_N: float = 5.0,
        sampling_Hz: float = 50.0,
        seed: int = 0,
    ) -> None:
        for name, value in (
            ("stiffness of x", x.stiffness_N_m),
            ("stiffness of y", y.stiffness_N_m),
            ("outer_stiffness_N_m", outer_stiffness_N_m),
            ("tension_N", tension_N),
            ("sampling_Hz", sampling_Hz),
        ):
            check_positive(name, value)
        softness = 1.0 / x.stiffness_N_m + 1.0 / outer_stiffness_N_m + 1.0 / y.stiffness_N_m
        self.x = SimulatedReel(x, tension_N, tension_N / outer_stiffness_N_m, 1.0 / softness)
        self.y = SimulatedReel(y, tension_N, 0.0, 1.0 / softness)
        self.time_s = 0.0
        self._contacts = _Contact(x.eyelet), _Contact(y.eyelet)
        self._outer_N_m = outer_stiffness_N_m
        self._period_s = 1.0 / sampling_Hz
        self._random = np.random.default_rng(seed)
        self._drift = [g.drift_N * self._random.standard_normal() for g in (x.gauge, y.gauge)]

    def record(self, duration_s: float) -> BenchRecord:
        """Runs both reels for a time; see `Bench`.

        Raises:
            InvalidInput: the time is not finite or holds no sample.
            PlantError: the cable became slack.
        """
        samples = round(duration_s / self._period_s) if math.isfinite(duration_s) else 0
        if samples < 1:
            raise InvalidInput(
                f"duration is {duration_s} s; it must hold a sample of {self._period_s:g} s"
            )
        disturbances = self._disturbances(samples).tolist()
        rows = []
        for for_x, for_y in disturbances:
            self._step()
            self.x.observe(for_x)
            self.y.observe(for_y)
            x, y = self.x, self.y
            rows.append((self.time_s, x.reading, x.angle_rad, y.reading, y.angle_rad))
        columns = np.array(rows).T
        return BenchRecord(columns[0], BenchReading(*columns[1:3]), BenchReading(*columns[3:5]))

    def _step(self) -> None:
        """One period: the drums move, and the cable slides until friction holds it."""
        self.time_s += self._period_s
        for reel in (self.x, self.y):
            if reel.friction_due:
                # Each approach has other contact spots of the cable, at both eyelets.
                for contact in self._contacts:
                    contact.factor = math.exp(
                        contact.eyelet.variation * self._random.standard_normal()
                    )
                reel.friction_due = False
            reel.advance(self._period_s)
        before = self.x.slid_m, self.y.slid_m
        self._slide()
        share = self._period_s / (_SLIDING_MEMORY_s + self._period_s)
        for reel, contact, slid in zip((self.x, self.y), self._contacts, before, strict=True):
            velocity = abs(reel.slid_m - slid) / self._period_s
            contact.velocity_m_s += share * (velocity - contact.velocity_m_s)

    def _slide(self) -> None:
        """Slides the cable at both eyelets until friction holds it at each."""
        x, y = self.x, self.y
        B_x, B_y = (
            contact.ratio(reel.tension_N)
            for reel, contact in zip((x, y), self._contacts, strict=True)
        )
        for _ in range(_ROUNDS):
            before_x, before_y = x.slid_m, y.slid_m
            share_x = self._slide_one(x, y, B_x)
            share_y = self._slide_one(y, x, B_y)
            if share_x and share_y:
                self._slide_both(share_x, share_y, x.slid_m - before_x, y.slid_m - before_y)
            elif not (share_x or share_y):
                break
        for reel in (x, y):
            reel.tension_N = reel.model.stiffness_N_m * (reel.wound_m - reel.slid_m)
        if not (min(x.tension_N, y.tension_N) > 0.0 and x.slid_m + y.slid_m > 0.0):
            raise PlantError(
                f"the cable became slack at {self.time_s:.2f} s; raise the tension at which the "
                "reels start or turn round"
            )

    def _slide_one(self, reel: SimulatedReel, other: SimulatedReel, B: float) -> float:
        """Slides the cable at one eyelet; returns `dT_o/dw` of its drum, 0 where it sticks."""
        k, k_o = reel.model.stiffness_N_m, self._outer_N_m
        inside = k * (reel.wound_m - reel.slid_m)
        outside = k_o * (reel.slid_m + other.slid_m)
        if B * inside - outside > _ROUNDING_N:
            share = B * k  # slides in until T_o = B T
        elif outside - inside / B > _ROUNDING_N:
            share = k / B  # slides out until T = B T_o
        else:
            return 0.0
        reel.slid_m = (share * reel.wound_m - k_o * other.slid_m) / (k_o + share)
        return share

    def _slide_both(self, share_x: float, share_y: float, first_x: float, first_y: float) -> None:
        """Slides both eyelets to their common equilibrium, unless one would have to slide back."""
        x, y = self.x, self.y
        outer = (x.wound_m + y.wound_m) / (1.0 / self._outer_N_m + 1.0 / share_x + 1.0 / share_y)
        on_x = x.wound_m - outer / share_x - x.slid_m
        on_y = y.wound_m - outer / share_y - y.slid_m
        if on_x * first_x >= 0.0 and on_y * first_y >= 0.0:
            x.slid_m += on_x
            y.slid_m += on_y

    def _disturbances(self, samples: int) -> FloatArray:
        """Noise and drift of both gauges, N, shape (samples, 2)."""
        drawn = np.empty((samples, 2))
        for n, reel in enumerate((self.x, self.y)):
            gauge = reel.model.gauge
            drawn[:, n] = gauge.noise_N * self._random.standard_normal(samples)
            if gauge.drift_N > 0.0:
                decay = math.exp(-self._period_s / gauge.drift_time_s)
                innovation = gauge.drift_N * math.sqrt(1.0 - decay**2)
                for k, normal in enumerate(self._random.standard_normal(samples).tolist()):
                    self._drift[n] = decay * self._drift[n] + innovation * normal
                    drawn[k, n] += self._drift[n]
        return drawn
