"""Extremum seeking by demodulation: logarithms of parameters and cost, two filters, a dither.

With l(k) the logarithm of the cost and x the logarithms of the parameters,

    b(k)    = l(k) - (1+h) zeta(k),  zeta(k+1) = -h zeta(k) + l(k)        high-pass
    d_i(k)  = (2/alpha) cos(w_i k + phi_i) b(k) / W_i                     demodulation
    g_i(k)  = g_i(k-1) + lambda [d_i(k) - g_i(k-1)]                       low-pass: the slope of l
    th(k+1) = th(k) - gamma g(k), limited and straightened as in `steps`
    x_i(k)  = th_i(k) + alpha cos(w_i k)

Which phase phi_i and gain W_i the demodulation has is what `otis` and `phase_compensated` differ
in. The frequencies keep the cost's curvature off the gradient: see `dither`.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

from estune.tuners.dither import dither
from estune.tuners.filters import low_pass, washout, washout_at_rest
from estune.tuners.observation import Observation, log_cost
from estune.tuners.search_space import Coordinates, Point, SearchSpace
from estune.tuners.settings import check_above_zero, check_below_one, check_logarithmic
from estune.tuners.step_length import clip_norm, kesten_step
from estune.tuners.step_scale import Best, best_after, recover_after_safe, shrink_after_unsafe


class DemodulationSignal(NamedTuple):
    """What the washed cost is multiplied by to read one slope.

    Attributes:
        frequency: w_i, rad/trial.
        gain: W_i, what it is divided by.
        lead: phi_i, rad.
    """

    frequency: float
    gain: float
    lead: float


class DemodulatedState(NamedTuple):
    """Where the search stands before trial k."""

    k: int
    centre: Coordinates  # th(k), logarithms
    zeta: float | None  # None: the washout will be at rest on the next cost
    slope: tuple[float, ...]  # g(k-1)
    drift: tuple[float, ...]  # mean step wanted, see `straightened`
    path: float  # mean length of it
    caution: float
    best_point: Point
    best_cost: float | None


@dataclass(frozen=True, slots=True)
class ExtremumSeeking(ABC):
    """What `otis` and `phase_compensated` share: all but what a carrier is.

    Attributes:
        space: What is tuned, on a logarithmic scale.
        dither_amplitude: alpha, in logarithms: 0.2 moves each gain by about a fifth.
        adaptation_gain: gamma, step in logarithms per slope of the logarithm of the cost.
        step_limit: Longest step of the centre between two trials, in logarithms.
        low_pass_share: lambda, the share of what is new in the low-pass filter.
        washout_h: h, between 0 and 1.
        name: What the tuner is called.

    Raises:
        InvalidInput: a setting is out of its range, or the scale is not logarithmic.
    """

    space: SearchSpace
    dither_amplitude: float = 0.2
    adaptation_gain: float = 0.5
    step_limit: float = 0.2
    low_pass_share: float = 0.15
    washout_h: float = 0.5
    name: str = ""

    def __post_init__(self) -> None:
        check_logarithmic(self.name, self.space)
        for what in ("dither_amplitude", "adaptation_gain", "step_limit"):
            check_above_zero(self.name, what, getattr(self, what))
        for what in ("low_pass_share", "washout_h"):
            check_below_one(self.name, what, getattr(self, what))

    @abstractmethod
    def carriers(self) -> tuple[DemodulationSignal, ...]:
        """What the cost is multiplied by, for each parameter."""

    def start(self) -> DemodulatedState:
        """The state before the first trial."""
        return DemodulatedState(
            k=0,
            centre=self.space.coordinates(self.space.start),
            zeta=None,
            slope=(0.0,) * len(self.space.names),
            drift=(0.0,) * len(self.space.names),
            path=0.0,
            caution=1.0,
            best_point=self.space.start,
            best_cost=None,
        )

    def ask(self, state: DemodulatedState) -> Point:
        """The centre with its dither, within the bounds."""
        k, alpha = state.k, state.caution * self.dither_amplitude
        rows = zip(state.centre, dither(len(state.centre)).frequencies, strict=True)
        return self.space.point(tuple([th + alpha * math.cos(w * k) for th, w in rows]))

    def tell(self, state: DemodulatedState, observation: Observation) -> DemodulatedState:
        """The state after the trial last asked for.

        Raises:
            InvalidInput: the cost is not finite although the observation is not censored.
        """
        if observation.censored:
            return state._replace(
                k=state.k + 1,
                centre=self.space.coordinates(state.best_point),
                zeta=None,
                slope=(0.0,) * len(state.slope),
                drift=(0.0,) * len(state.drift),
                path=0.0,
                caution=shrink_after_unsafe(state.caution),
            )
        best = best_after(Best(state.best_point, state.best_cost), self.ask(state), observation)
        level, h = log_cost(observation), self.washout_h
        zeta = washout_at_rest(h, level) if state.zeta is None else state.zeta
        washed, zeta = washout(h, zeta, level)
        alpha = state.caution * self.dither_amplitude
        news = zip(state.slope, self._demodulated(state.k, alpha, washed), strict=True)
        slope = tuple([low_pass(self.low_pass_share, g, d) for g, d in news])
        wanted = clip_norm(
            tuple([-self.adaptation_gain * g for g in slope]), state.caution * self.step_limit
        )
        step, drift, path = kesten_step(wanted, state.drift, state.path)
        return DemodulatedState(
            k=state.k + 1,
            centre=self.space.clipped(
                tuple([th + s for th, s in zip(state.centre, step, strict=True)])
            ),
            zeta=zeta,
            slope=slope,
            drift=drift,
            path=path,
            caution=recover_after_safe(state.caution),
            best_point=best.point,
            best_cost=best.cost,
        )

    def recommend(self, state: DemodulatedState) -> Point:
        """The search's centre, without dither."""
        return self.space.point(state.centre)

    def _demodulated(self, k: int, alpha: float, washed: float) -> list[float]:
        """d_i(k), of a trial that was dithered by alpha."""
        scale = 2.0 * washed / alpha
        return [scale * math.cos(w * k + lead) / gain for w, gain, lead in self.carriers()]
