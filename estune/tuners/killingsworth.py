"""Extremum seeking as published by Killingsworth & Krstic, IEEE Control Systems Magazine, 2006.

With J(k) the cost of trial k, zeta the washout filter's state, th the parameters without and theta
with dither, the printed law is

    zeta(k)      = -h zeta(k-1) + J(theta(k-1))                                     (KK 1)
    th_i(k+1)    = th_i(k) - gamma_i alpha_i cos(w_i k) [J(theta(k)) - (1+h) zeta(k)]   (KK 2)
    theta_i(k+1) = th_i(k+1) + alpha_i cos(w_i (k+1)),    w_i = a^i pi              (KK 3)

(KK 3) defines theta from the second trial on. By our reading the first trial applies the start
itself, the washout is at rest on its cost, and trials count from k = 1: this comes nearest to the
published transient of the first plant.

The law is kept with its defects, to reproduce the publication. The washout leads by 44 to 76
degrees at the published frequencies, which the demodulation ignores, so that parameters adapt at
rates that depend on their order. For four parameters 2 w_4 falls next to w_1.
"""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

from estune.core.quantities import check_positive
from estune.errors import InvalidInput
from estune.tuners.observation import Observation, usable_cost
from estune.tuners.perturbation import washout, washout_at_rest
from estune.tuners.search_space import Coordinates, Point, SearchSpace
from estune.tuners.settings import check_below_one
from estune.tuners.step_control import best_after, recover_after_safe, shrink_after_unsafe

RELATIVE_AMPLITUDE = 0.2
ADAPTATION_GAIN = 1.0


class KillingsworthState(NamedTuple):
    """The state of the search before trial k."""

    k: int
    centre: Coordinates  # th(k)
    zeta: float | None  # None: the washout will be at rest on the next cost
    step_scale: float
    best_point: Point
    best_cost: float | None


@dataclass(frozen=True, slots=True)
class Killingsworth:
    """The published law in the coordinates of its search space; the publication uses linear ones.

    Attributes:
        space: The tuned parameters; their order matters to this law.
        dither_amplitudes: alpha_i, in coordinates; left empty, 0.2 on a logarithmic scale and
            0.2 of the start on a linear one.
        adaptation_gains: gamma_i, 1/cost; left empty, 1.
        frequency_base: a, between 0 and 1.
        frequency_exponents: The power of a for each parameter; left empty, 1, 2, ... as printed.
        washout_h: h, between 0 and 1.

    Raises:
        InvalidInput: a setting is out of its range, or there is not one for each parameter.
    """

    space: SearchSpace
    dither_amplitudes: tuple[float, ...] = ()
    adaptation_gains: tuple[float, ...] = ()
    frequency_base: float = 0.8
    frequency_exponents: tuple[int, ...] = ()
    washout_h: float = 0.5
    name: Literal["killingsworth"] = "killingsworth"

    def __post_init__(self) -> None:
        n = len(self.space.names)
        fill = object.__setattr__  # the one way to complete a frozen value
        unit = (1.0,) * n if self.space.scale == "log" else self.space.start
        if not self.dither_amplitudes:
            fill(self, "dither_amplitudes", tuple(RELATIVE_AMPLITUDE * s for s in unit))
        if not self.adaptation_gains:
            fill(self, "adaptation_gains", (ADAPTATION_GAIN,) * n)
        if not self.frequency_exponents:
            fill(self, "frequency_exponents", tuple(range(1, n + 1)))
        for setting in ("dither_amplitudes", "adaptation_gains", "frequency_exponents"):
            values = getattr(self, setting)
            if len(values) != n:
                raise InvalidInput(
                    f"{self.name}: {len(values)} {setting} for {n} parameters; give one for each"
                )
            for value in values:
                check_positive(f"{self.name}: {setting}", value)
        check_below_one(self.name, "frequency_base", self.frequency_base)
        check_below_one(self.name, "washout_h", self.washout_h)

    def start(self) -> KillingsworthState:
        """The state before the first trial."""
        return KillingsworthState(
            k=1,
            centre=self.space.coordinates(self.space.start),
            zeta=None,
            step_scale=1.0,
            best_point=self.space.start,
            best_cost=None,
        )

    def ask(self, state: KillingsworthState) -> Point:
        """theta(k), (KK 3), within the bounds."""
        if state.k == 1:
            return self.space.start
        k = state.k
        rows = zip(state.centre, self.dither_amplitudes, self._frequencies(), strict=True)
        return self.space.point(
            tuple([th + state.step_scale * alpha * math.cos(w * k) for th, alpha, w in rows])
        )

    def tell(self, state: KillingsworthState, observation: Observation) -> KillingsworthState:
        """The state after the trial last asked for."""
        k, h = state.k, self.washout_h
        if observation.censored:
            return state._replace(
                k=k + 1,
                centre=self.space.coordinates(state.best_point),
                zeta=None,
                step_scale=shrink_after_unsafe(state.step_scale),
            )
        best_point, best_cost = best_after(state, self.ask(state), observation)
        J = usable_cost(observation)
        zeta = washout_at_rest(h, J) if state.zeta is None else state.zeta
        washed, zeta = washout(h, zeta, J)  # (KK 1)
        gains, alphas = self.adaptation_gains, self.dither_amplitudes
        rows = zip(state.centre, gains, alphas, self._frequencies(), strict=True)
        centre = [
            th - state.step_scale * gamma * alpha * math.cos(w * k) * washed  # (KK 2)
            for th, gamma, alpha, w in rows
        ]
        return KillingsworthState(
            k=k + 1,
            centre=self.space.clipped(tuple(centre)),
            zeta=zeta,
            step_scale=recover_after_safe(state.step_scale),
            best_point=best_point,
            best_cost=best_cost,
        )

    def recommend(self, state: KillingsworthState) -> Point:
        """th(k), without dither."""
        return self.space.point(state.centre)

    def _frequencies(self) -> list[float]:
        """w_i = a^i pi, (KK 3), rad/trial."""
        return [self.frequency_base**i * math.pi for i in self.frequency_exponents]
