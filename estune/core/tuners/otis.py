"""Extremum seeking as the paper has it (section V-C): [39] adapted to a real, noisy reel.

What it adds to Killingsworth & Krstic: the logarithm of each parameter in place of the parameter,
the setpoint filter's time constant as a fourth parameter, and a low-pass filter after the
demodulation beside the high-pass (washout) before it. With l(k) the logarithm of the cost,

    b(k)    = l(k) - (1+h) zeta(k),  zeta(k+1) = -h zeta(k) + l(k)        high-pass
    d_i(k)  = (2/alpha) cos(w_i k + phi_i) b(k) / |W(w_i)|                demodulation
    g_i(k)  = g_i(k-1) + lambda [d_i(k) - g_i(k-1)]                       low-pass: the slope of l
    th(k+1) = th(k) - gamma g(k), limited and straightened as in `steps`
    x_i(k)  = th_i(k) + alpha cos(w_i k),   x = logarithms of the parameters

The paper prints no numbers for these and none for the frequencies; where it is silent:

* The cost is normalised by its logarithm. The paper's is by the first-order reference in (35),
  which does not stop a bad start from making the first steps a hundred times the last ones.
* phi_i and |W| are the phase lead and gain of the washout W at w_i ("phase_compensated").
  Without them ("published", as in [39]) the slope is read at cos(phi_i) of its size or less,
  differently for each parameter.
* The frequencies keep the cost's curvature off the gradient: see `odd_frequencies`.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

from estune.core.filters import low_pass, washout, washout_at_rest, washout_response
from estune.core.search_space import Coordinates, Point, SearchSpace
from estune.core.tuners.dither import odd_frequencies
from estune.core.tuners.guard import Best, best_after, caution_after_safe, caution_after_unsafe
from estune.core.tuners.observation import Observation, log_cost
from estune.core.tuners.settings import check_above_zero, check_below_one, check_logarithmic
from estune.core.tuners.steps import limited, straightened
from estune.errors import InvalidInput


class OtisState(NamedTuple):
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
class Otis:
    """The paper's tuner.

    Attributes:
        space: What is tuned, on a logarithmic scale.
        demodulation: "phase_compensated" for the washout's lead and gain, or "published".
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
    demodulation: Literal["phase_compensated", "published"] = "phase_compensated"
    dither_amplitude: float = 0.2
    adaptation_gain: float = 0.5
    step_limit: float = 0.2
    low_pass_share: float = 0.15
    washout_h: float = 0.5
    name: Literal["otis"] = "otis"

    def __post_init__(self) -> None:
        check_logarithmic("otis", self.space)
        if self.demodulation not in ("phase_compensated", "published"):
            raise InvalidInput(
                f"otis: demodulation is {self.demodulation!r}; "
                "it must be 'phase_compensated' or 'published'"
            )
        for what in ("dither_amplitude", "adaptation_gain", "step_limit"):
            check_above_zero("otis", what, getattr(self, what))
        for what in ("low_pass_share", "washout_h"):
            check_below_one("otis", what, getattr(self, what))

    def start(self) -> OtisState:
        """The state before the first trial."""
        return OtisState(
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

    def ask(self, state: OtisState) -> Point:
        """The centre with its dither, within the bounds."""
        k, alpha = state.k, state.caution * self.dither_amplitude
        rows = zip(state.centre, odd_frequencies(len(state.centre)), strict=True)
        return self.space.point(tuple([th + alpha * math.cos(w * k) for th, w in rows]))

    def tell(self, state: OtisState, observation: Observation) -> OtisState:
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
                caution=caution_after_unsafe(state.caution),
            )
        best = best_after(Best(state.best_point, state.best_cost), self.ask(state), observation)
        level, h = log_cost(observation), self.washout_h
        zeta = washout_at_rest(h, level) if state.zeta is None else state.zeta
        washed, zeta = washout(h, zeta, level)
        alpha = state.caution * self.dither_amplitude
        news = zip(state.slope, self._demodulated(state.k, alpha, washed), strict=True)
        slope = tuple([low_pass(self.low_pass_share, g, d) for g, d in news])
        wanted = limited(
            tuple([-self.adaptation_gain * g for g in slope]), state.caution * self.step_limit
        )
        step, drift, path = straightened(wanted, state.drift, state.path)
        return OtisState(
            k=state.k + 1,
            centre=self.space.clipped(
                tuple([th + s for th, s in zip(state.centre, step, strict=True)])
            ),
            zeta=zeta,
            slope=slope,
            drift=drift,
            path=path,
            caution=caution_after_safe(state.caution),
            best_point=best.point,
            best_cost=best.cost,
        )

    def recommend(self, state: OtisState) -> Point:
        """The search's centre, without dither."""
        return self.space.point(state.centre)

    def _demodulated(self, k: int, alpha: float, washed: float) -> list[float]:
        """d_i(k), of a trial that was dithered by alpha."""
        n, scale = len(self.space.names), 2.0 * washed / alpha
        if self.demodulation == "published":
            return [scale * math.cos(w * k) for w in odd_frequencies(n)]
        return [
            scale * math.cos(w * k + lead) / gain
            for w, gain, lead in _washout_at_dither(n, self.washout_h)
        ]


@lru_cache(maxsize=64)
def _washout_at_dither(parameters: int, h: float) -> tuple[tuple[float, float, float], ...]:
    """Frequency, and the washout's gain and phase lead there, for each parameter."""
    return tuple((w, *washout_response(h, w)) for w in odd_frequencies(parameters))
