"""The gains of least predicted cost whose limits hold by the upper ends of their intervals."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.loop_model.intervals import Interval, PredictedMargins, relative_cost
from estune.loop_model.load_rejection import load_rejection
from estune.loop_model.model import LoopModel
from estune.loop_model.optimum import RegionSearch, RobustnessLimits
from estune.loop_model.prediction import StepTrial, predict, predictions
from estune.loop_model.rival import rival_model
from estune.service_records.identification import ServiceLoop
from estune.service_records.judgement import margins_of

FACTOR = 30.0
"""Largest factor between a recommended gain and the one in use. Beyond it a fit of records at the
gains in use says nothing: the intervals refuse such gains long before."""

ROUNDS = 6
"""Most optima, each within tighter limits than the last."""

SCALED_DOWN = tuple(
    np.log(shares)
    for shares in product(
        (1.0, 0.6, 0.35, 0.2, 0.1, 0.05), (1.0, 0.4, 0.1), (1.0, 0.3, 0.03), (1.0, 4.0, 16.0)
    )
)
"""Shares of P, of I beside P, of D beside P and of the setpoint filter at which gains are checked
before it is said that none keep the limits, or none but costly ones. The optimiser's own limits
stop at an overshoot of none, where an interval may still be wide."""

DEAR = 0.05
"""Price from which scaled-down gains are checked, too: tighter limits may cut off what keeps the
true ones. Of a wheel with a coarse encoder the gains in use kept them by their intervals, and the
tightened optimum cost 2.7 times as much."""

BISECTIONS = 4
"""Bisections between such gains and the optimum, whose limits do not hold."""

AIMED = ((1.0, 1.0), (0.7, 0.4), (0.4, 0.1), (0.2, 0.1), (1.0, 0.0))
"""Shares of the limit of ln Ms, and of I, within which the best of those gains are checked in
turn: where the slow part of a plant is hardly known, less I alone keeps the overshoot in all that
it may be, and where not even its sign is, none, if the gains in use have none."""

LEAST = 0.02
"""Least share by which a limit of the overshoot is tightened: the optimiser is done before a
thousandth of it, and six rounds ended a thousandth beyond, of which 81 % was the price."""

SCATTERED = 64
"""Low-discrepancy points of which the best is one of the starts of an optimum."""


class Recommendation(NamedTuple):
    """Recommended gains.

    Attributes:
        price: Their cost over that of the optimum whose limits hold by the model alone, less one:
            what the uncertainty of the records costs.
        relative_cost: Their cost over that of the gains in use, by the same models.
        load_error: Integral of the deviation after a load step, over that of the gains in use.
    """

    gains: Gains
    margins: PredictedMargins
    price: float
    relative_cost: Interval
    load_error: float


def recommend(
    loop: ServiceLoop, trial: StepTrial, in_use: Gains, limits: RobustnessLimits
) -> Recommendation | None:
    """The recommended gains; None where no gains keep the limits by their intervals.

    Args:
        trial: The step by which costs and overshoots are predicted.
        in_use: The gains that the search begins from.
        limits: What the gains have to keep.
    """
    start = np.log(_started(in_use, trial).as_tuple())
    span = math.log(FACTOR)

    def gains_of(x: FloatArray) -> Gains:
        return Gains(*np.exp(x).tolist())

    rival = rival_model(loop.fit, loop.records)

    def margins_at(x: FloatArray) -> PredictedMargins:
        return _with_rival(margins_of(loop, trial, gains_of(x))[0], rival, trial, gains_of(x))

    within, first_cost, x, first = limits, math.nan, start, start
    # The gains in use as they are, too: any integral may be unstable by an interval. A chamber at
    # an Ms of 2.1 without one was told KEEP.
    with np.errstate(divide="ignore"):
        about = [start, np.log(in_use.as_tuple())]
    kept = list[tuple[FloatArray, PredictedMargins]]()
    for _ in range(ROUNDS):
        search = RegionSearch(
            *(loop.fit.model, trial, within, gains_of, start - span, start + span),
            loop.fit.noise_std,
        )
        best = search.minimise([x, start], scattered=SCATTERED)
        if not (best.feasible and math.isfinite(best.prediction.cost)):
            break
        x, margins = best.coordinates, margins_at(best.coordinates)
        if math.isnan(first_cost):
            first, first_cost = x, margins.cost.value
        tighter = _tightened(within, limits, margins)
        if tighter is None:
            kept.append((x, margins))
        if tighter is None or tighter == within:
            break
        within = tighter
    if not kept or _price(kept[0][1], first_cost) > DEAR:
        kept += _scaled_down(loop, trial, limits, (gains_of, margins_at), [first, x, *about])
    if not kept:
        return None
    x, margins = min(kept, key=lambda one: one[1].cost.value)
    found = gains_of(x)
    relative = relative_cost(loop.fit, trial, found, in_use, loop.draws)
    rejections = [
        load_rejection(*(loop.fit.model, gains, trial.controller, 1.0, trial.cost.settling_time_s))
        for gains in (found, in_use)
    ]
    then, now = (np.abs(one.deviation).sum() if one else math.inf for one in rejections)
    return Recommendation(
        found, margins, _price(margins, first_cost), relative, float(then / max(now, 1e-300))
    )


def _price(margins: PredictedMargins, first_cost: float) -> float:
    price = margins.cost.value / first_cost - 1.0
    return max(price, 0.0) if math.isfinite(price) else 0.0


def _scaled_down(
    loop: ServiceLoop,
    trial: StepTrial,
    limits: RobustnessLimits,
    known: tuple[Callable[[FloatArray], Gains], Callable[[FloatArray], PredictedMargins]],
    about: Sequence[FloatArray],
) -> list[tuple[FloatArray, PredictedMargins]]:
    """The best of scaled-down gains whose limits hold by their intervals, if there is one."""
    gains_of, margins_at = known
    beside = np.array([[1.0, 1.0, 1.0, 0.0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]])
    scaled = [(x, shares) for x in about for shares in SCALED_DOWN]
    points = [x + shares @ beside for x, shares in scaled]
    gains = [gains_of(x) for x in points]
    found = predictions([loop.fit.model], trial, gains, loop.fit.noise_std)
    stable = [(one, i) for i, one in enumerate(found) if math.isfinite(one.cost)]
    ranked = sorted(stable, key=lambda one: one[0].cost)
    for share, most_I in AIMED:
        within = limits
        if limits.max_sensitivity is not None:
            within = replace(within, max_sensitivity=limits.max_sensitivity**share)
        kept = (
            i
            for one, i in ranked
            if (np.exp(scaled[i][1][1]) <= most_I if most_I else not gains[i].I)
            and not (within.excess(one) > 0.0).any()
        )
        best = next(kept, None)
        if best is None:
            continue
        margins = margins_at(points[best])
        if _tightened(limits, limits, margins) is None:
            return [_nearest_kept((points[best], margins), about[0], margins_at, limits)]
    return []


def _nearest_kept(
    kept: tuple[FloatArray, PredictedMargins],
    wanted: FloatArray,
    margins_at: Callable[[FloatArray], PredictedMargins],
    limits: RobustnessLimits,
) -> tuple[FloatArray, PredictedMargins]:
    """The point nearest to a wanted one whose limits hold, by bisection from one where they do."""
    inside, outside, best = kept[0], wanted, kept
    for _ in range(BISECTIONS):
        middle = 0.5 * (inside + outside)
        margins = margins_at(middle)
        if _tightened(limits, limits, margins) is not None:
            outside = middle
            continue
        inside = middle
        if margins.cost.value < best[1].cost.value:
            best = middle, margins
    return best


def _with_rival(
    margins: PredictedMargins, rival: LoopModel | None, trial: StepTrial, gains: Gains
) -> PredictedMargins:
    """The margins with upper ends that hold what a rival model foretells."""
    if rival is None:
        return margins
    other, Ms, overshoot = predict(rival, trial, gains), margins.sensitivity, margins.overshoot
    return margins._replace(
        sensitivity=Ms._replace(high=max(Ms.high, other.sensitivity)),
        overshoot=overshoot._replace(high=max(overshoot.high, other.overshoot)),
    )


def _tightened(
    within: RobustnessLimits, limits: RobustnessLimits, margins: PredictedMargins
) -> RobustnessLimits | None:
    """Limits tighter by what the intervals exceed the limits; None where they hold."""
    Ms, overshoot, angle = margins.sensitivity, margins.overshoot, margins.phase_margin_deg
    changes: dict[str, float] = {}
    if limits.max_sensitivity is not None and within.max_sensitivity is not None:
        most = limits.max_sensitivity
        if not Ms.high <= most:
            # The width of the interval shrinks with Ms, to zero at one.
            high = Ms.high if math.isfinite(Ms.high) else 4.0 * most
            share = (most - 1.0) / (high - 1.0)
            changes["max_sensitivity"] = 1.0 + 0.98 * share * (min(Ms.value, most) - 1.0)
    if limits.max_overshoot is not None and within.max_overshoot is not None:
        most = limits.max_overshoot
        if not overshoot.high <= most:
            high = overshoot.high if math.isfinite(overshoot.high) else 4.0 * most
            changes["max_overshoot"] = max(
                within.max_overshoot - max(high - most, LEAST * most), 1e-3
            )
    least, aimed = limits.min_phase_margin_deg, within.min_phase_margin_deg
    if least is not None and aimed is not None and not angle.low >= least:
        low = angle.low if math.isfinite(angle.low) else 0.0
        changes["min_phase_margin_deg"] = min(aimed + least - low, 89.0)
    return replace(within, **changes) if changes else None


def _started(gains: Gains, trial: StepTrial) -> Gains:
    """The gains in use, with small values for terms that they do not have."""
    T = trial.cost.settling_time_s
    return Gains(
        gains.P,
        gains.I or 0.3 * gains.P / T,
        gains.D or 0.02 * gains.P * T,
        gains.setpoint_filter_s or 0.05 * T,
    )
