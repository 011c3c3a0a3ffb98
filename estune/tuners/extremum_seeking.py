"""Extremum seeking by demodulation: logarithms of parameters and cost, two filters, a dither.

With l(k) the logarithm of the cost and x the logarithms of the parameters,

    b(k)    = l(k) - (1+h) zeta(k),  zeta(k+1) = -h zeta(k) + l(k)        high-pass
    d_i(k)  = (2/alpha) cos(w_i k + phi_i) b(k) / W_i                     demodulation
    g_i(k)  = g_i(k-1) + lambda [d_i(k) - g_i(k-1)]                       low-pass: the slope of l
    th(k+1) = th(k) - gamma g(k), limited and straightened as in `step_control`
    x_i(k)  = th_i(k) + alpha cos(w_i k)

`Otis` and `PhaseCompensated` differ in the phase phi_i and the gain W_i of the demodulation. The
frequencies separate the curvature of the cost from its gradient, see `perturbation.dither`.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

from estune.core.quantities import check_positive
from estune.tuners.observation import Observation, log_cost
from estune.tuners.perturbation import (
    dither,
    low_pass,
    washout,
    washout_at_rest,
    washout_response,
)
from estune.tuners.search_space import Coordinates, Point, SearchSpace
from estune.tuners.settings import check_below_one, check_logarithmic
from estune.tuners.step_control import (
    best_after,
    clip_norm,
    kesten_step,
    recover_after_safe,
    shrink_after_unsafe,
)


class DemodulationSignal(NamedTuple):
    """The factor cos(w_i k + phi_i)/W_i that reads one slope from the washed cost.

    Attributes:
        frequency: w_i, rad/trial.
        gain: W_i.
        lead: phi_i, rad.
    """

    frequency: float
    gain: float
    lead: float


class ExtremumSeekingState(NamedTuple):
    """The state of the search before trial k."""

    k: int
    centre: Coordinates  # th(k), logarithms
    zeta: float | None  # None: the washout will be at rest on the next cost
    slope: tuple[float, ...]  # g(k-1)
    mean_step: tuple[float, ...]  # see `kesten_step`
    mean_length: float
    step_scale: float
    best_point: Point
    best_cost: float | None


@dataclass(frozen=True, slots=True)
class ExtremumSeeking(ABC):
    """Base of `Otis` and `PhaseCompensated`: everything but the demodulation signals.

    Attributes:
        space: The tuned parameters, on a logarithmic scale.
        dither_amplitude: alpha, in logarithms: 0.2 moves each gain by about a fifth.
        adaptation_gain: gamma, step in logarithms per slope of the logarithm of the cost.
        step_limit: Longest step of the centre between two trials, in logarithms.
        low_pass_share: lambda, weight of the newest slope in the low-pass filter.
        washout_h: h, between 0 and 1.

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
        for setting in ("dither_amplitude", "adaptation_gain", "step_limit"):
            check_positive(f"{self.name}: {setting}", getattr(self, setting))
        for setting in ("low_pass_share", "washout_h"):
            check_below_one(self.name, setting, getattr(self, setting))

    @abstractmethod
    def demodulation_signals(self) -> tuple[DemodulationSignal, ...]:
        """One signal for each parameter."""

    def start(self) -> ExtremumSeekingState:
        """The state before the first trial."""
        return ExtremumSeekingState(
            k=0,
            centre=self.space.coordinates(self.space.start),
            zeta=None,
            slope=(0.0,) * len(self.space.names),
            mean_step=(0.0,) * len(self.space.names),
            mean_length=0.0,
            step_scale=1.0,
            best_point=self.space.start,
            best_cost=None,
        )

    def ask(self, state: ExtremumSeekingState) -> Point:
        """The centre with its dither, within the bounds."""
        k, alpha = state.k, state.step_scale * self.dither_amplitude
        rows = zip(state.centre, dither(len(state.centre)).frequencies, strict=True)
        return self.space.point(tuple([th + alpha * math.cos(w * k) for th, w in rows]))

    def tell(self, state: ExtremumSeekingState, observation: Observation) -> ExtremumSeekingState:
        """The state after the trial last asked for."""
        if observation.censored:
            return self.start()._replace(
                k=state.k + 1,
                centre=self.space.coordinates(state.best_point),
                step_scale=shrink_after_unsafe(state.step_scale),
                best_point=state.best_point,
                best_cost=state.best_cost,
            )
        best_point, best_cost = best_after(state, self.ask(state), observation)
        level, h = log_cost(observation), self.washout_h
        zeta = washout_at_rest(h, level) if state.zeta is None else state.zeta
        washed, zeta = washout(h, zeta, level)
        rows = zip(state.slope, self._demodulate(state, washed), strict=True)
        slope = tuple([low_pass(self.low_pass_share, g, d) for g, d in rows])
        step, mean_step, mean_length = kesten_step(
            clip_norm(
                tuple([-self.adaptation_gain * g for g in slope]),
                state.step_scale * self.step_limit,
            ),
            state.mean_step,
            state.mean_length,
        )
        return ExtremumSeekingState(
            k=state.k + 1,
            centre=self.space.clipped(
                tuple([th + s for th, s in zip(state.centre, step, strict=True)])
            ),
            zeta=zeta,
            slope=slope,
            mean_step=mean_step,
            mean_length=mean_length,
            step_scale=recover_after_safe(state.step_scale),
            best_point=best_point,
            best_cost=best_cost,
        )

    def recommend(self, state: ExtremumSeekingState) -> Point:
        """The centre of the search, without dither."""
        return self.space.point(state.centre)

    def _demodulate(self, state: ExtremumSeekingState, washed: float) -> list[float]:
        """d_i(k) by the washed cost b(k)."""
        k, scale = state.k, 2.0 * washed / (state.step_scale * self.dither_amplitude)
        return [
            scale * math.cos(w * k + lead) / gain for w, gain, lead in self.demodulation_signals()
        ]


@dataclass(frozen=True, slots=True)
class Otis(ExtremumSeeking):
    """Extremum seeking of the paper (section V-C): [39] adapted to a real, noisy reel.

    It adds to Killingsworth & Krstic the logarithms of the parameters, the setpoint filter's time
    constant as a fourth parameter, and the low-pass after the demodulation. Like [39] it
    demodulates by the dither itself, phi_i = 0 and W_i = 1, and so ignores the phase lead of the
    washout: each slope is read at cos(lead) times the washout's gain of its size.

    The paper prints no settings and no frequencies. It normalises the cost by the first-order
    reference in (35), which lets a bad start make the first steps a hundred times the last ones.
    The logarithm of the cost used here prevents that.
    """

    name: Literal["otis"] = "otis"

    def demodulation_signals(self) -> tuple[DemodulationSignal, ...]:
        """The dither itself."""
        frequencies = dither(len(self.space.names)).frequencies
        return tuple([DemodulationSignal(w, 1.0, 0.0) for w in frequencies])


@dataclass(frozen=True, slots=True)
class PhaseCompensated(ExtremumSeeking):
    """Extremum seeking that compensates the phase lead and the gain of its washout filter.

    phi_i and W_i are those of the washout at w_i, so that every slope is read at its full size.
    After 120 trials on eight families of plants it is 2.4 % above the optimum in the median,
    `Otis` 35 %.
    """

    name: Literal["phase_compensated"] = "phase_compensated"

    def demodulation_signals(self) -> tuple[DemodulationSignal, ...]:
        """The dither after the washout."""
        return _washed_dither(len(self.space.names), self.washout_h)


@lru_cache(maxsize=64)
def _washed_dither(parameters: int, h: float) -> tuple[DemodulationSignal, ...]:
    return tuple(
        [DemodulationSignal(w, *washout_response(h, w)) for w in dither(parameters).frequencies]
    )
