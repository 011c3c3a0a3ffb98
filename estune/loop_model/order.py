"""Order and noise of a loop model, chosen by the Bayesian information criterion.

A fit whose prediction errors are white is kept. Otherwise further poles, a load and a drift are
tried, each from the starts that promise most, and what lowers the criterion most is added, until
nothing does.
"""

import math
from collections.abc import Sequence

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.criterion import (
    Selected,
    by_criterion,
    criterion,
    criterion_of,
    judged,
)
from estune.loop_model.fit_signals import FitSignals
from estune.loop_model.further_poles import POLES_MAX, further_poles
from estune.loop_model.identification import (
    START_NOISES,
    PoleFit,
    by_cost,
    cold_starts,
    dead_times,
    improve,
    searched_dead_time,
)
from estune.loop_model.least_squares import Solution
from estune.loop_model.noise_model import WHITE
from estune.loop_model.poles import OUTSIDE, sections_of, slowest_decay, with_single
from estune.loop_model.sensor_colour import recoloured
from estune.loop_model.slow_poles import is_controllable, is_resolved, is_settled
from estune.loop_model.whiteness import is_contradicted, is_white

SLOWEST_SINGLE, FASTEST_SINGLE = math.log(1e-4), math.log(2.0)
"""Logarithms of the decay per sample between which a single pole begins."""

COLOURS, COLOUR_GAIN = 4, 2.0
"""Colours that are found in turn, at most, and the decrease of the criterion that ends it."""

SLOWER = (3.0, 10.0, 30.0)
"""Ratios of a pole in place of the load to the slowest of the others."""

TRIED = 2
"""Starts that are improved."""

LOAD_SHARE = 0.5
"""Share of the squared errors that a load has to explain in one record. Loads of 3 % of the step
explain 84 to 93 % on four plants of `experiments.batch`, friction in the eyelet of a reel none."""

LOADS = (1e-2, 1.0, 100.0)
DRIFTS = (1e-4, 1e-2)
"""Sizes of load and drift that a search begins from."""


def select_order(signals: FitSignals, start: PoleFit) -> PoleFit:
    """The fit of the order and noise that the records ask for, from one of low order.

    Trials from rest have a load or drift where no further poles make their errors white, these
    do, the criterion falls, and the records before their steps allow it: a drum that friction
    holds is at rest there. In one record a loop that hunts looks like a load: there that has to
    explain `LOAD_SHARE` of what further poles leave.
    """
    other = _selected(signals, start, has_load=signals.in_motion)
    left = other.solution(signals)
    if signals.in_motion or is_white(signals, left.residual):
        return other
    begun = [start]
    if start.noise.is_white:  # poles that took up a load before it was known would stay
        begun += cold_starts(signals, START_NOISES[1:])
    found = min(
        (_selected(signals, one, has_load=True) for one in begun),
        key=lambda one: criterion_of(signals, one),
    )
    loaded = found.solution(signals)
    if not is_white(signals, loaded.residual) or is_contradicted(signals, loaded.residual):
        return other
    share = 1.0 - LOAD_SHARE if signals.records == 1 else math.inf
    is_better = criterion_of(signals, found) < criterion_of(signals, other)
    return found if is_better and loaded.squares < share * left.squares else other


def _selected(signals: FitSignals, start: PoleFit, *, has_load: bool) -> PoleFit:
    """The fit of the least criterion, with a load or drift or without."""
    if not has_load:
        start = start._replace(noise=WHITE)
    best = judged(signals, start)
    while has_load:  # before the colour, which else stands for load and drift
        solution = best.fit.solution(signals)
        if is_white(signals, solution.residual):
            return best.fit
        better = _best_of(signals, best, _with_noise(signals, solution))
        if better is None:
            break
        best = better
    while True:
        if signals.in_motion:  # before further poles, which else stand for the sensor's colour
            best = _recoloured(signals, best)
        solution = best.fit.solution(signals)
        if is_white(signals, solution.residual):
            return best.fit
        options = [*further_poles(signals, solution)]
        if has_load:
            options += _with_noise(signals, solution)
        options += _without_load(signals, solution)
        better = _best_of(signals, best, options)
        if better is None:
            return best.fit
        # Dead time stands for poles that a model lacks: with more of them it is shorter.
        moved = judged(signals, searched_dead_time(signals, [better.fit]))
        # A move may lose a drift that was just found: it was found again without an end.
        best = min(better, moved, key=by_criterion)


def _best_of(signals: FitSignals, best: Selected, options: Sequence[Selected]) -> Selected | None:
    """The best of the options that promise most; None where none is better than a fit."""
    promising = sorted(options, key=by_criterion)[:TRIED]
    tried = [judged(signals, improve(signals, one.fit)) for one in promising]
    is_usable = is_settled if is_resolved(signals, best.fit.coordinates) else is_controllable
    tried = [one for one in tried if is_usable(signals, one.fit)]
    better = min(tried, key=by_criterion, default=best)
    return better if better.criterion < best.criterion else None


def _recoloured(signals: FitSignals, best: Selected) -> Selected:
    """The fit with the colour that its errors have, where the criterion falls by it.

    In turn, for the errors have another colour with other poles.
    """
    for _ in range(COLOURS):
        noise = recoloured(signals, best.fit.solution(signals))
        if noise == best.fit.noise:
            break
        tried = judged(signals, improve(signals, best.fit._replace(noise=noise)))
        gained, best = best.criterion - tried.criterion, min(best, tried, key=by_criterion)
        if gained < COLOUR_GAIN:
            break
    return best


def without_spare_pole(signals: FitSignals, fit: PoleFit) -> PoleFit:
    """The fit of one pole where the criterion does not ask for the second of two.

    A zero cancels the spare one wherever it lies. Along such a direction the records know
    nothing, and an interval holds loops of any kind, unstable ones too. Two that swing are both
    asked for.
    """
    (pair,) = sections_of(fit.coordinates)
    if np.any(pair.log_poles.imag):
        return fit
    two = improve(signals, fit)
    (pair,) = sections_of(two.coordinates)
    rates = np.clip(np.log(np.abs(pair.log_poles)), SLOWEST_SINGLE, FASTEST_SINGLE)
    singles = rates + np.where(pair.log_poles.real > 0.0, OUTSIDE, 0.0)
    # A fast spare pole stands for dead time.
    delays = sorted({two.dead, *dead_times(signals.settling_samples)})
    coarse = [
        (*Solution.least(signals, np.array([single]), delays, two.noise), single)
        for single in singles.tolist()
    ]
    cost, dead, single = min(coarse)
    one = searched_dead_time(signals, [PoleFit(cost, np.array([single]), dead, two.noise)])
    return min(judged(signals, two), judged(signals, one), key=by_criterion).fit


def is_enough(signals: FitSignals, fit: PoleFit) -> bool:
    """Whether a fit of trials from rest is white and resolved, and no further pole promises more.

    A further one is judged where it begins, without a search.
    """
    solution = fit.solution(signals)
    if signals.in_motion or not is_white(signals, solution.residual):
        return False
    if not is_resolved(signals, fit.coordinates):
        return False
    # As that of a further pole where it begins: without the price of dead time.
    own = criterion(signals, solution.squares, fit.coordinates.size, fit.noise)
    return all(one.criterion >= own for one in further_poles(signals, solution))


def _with_noise(signals: FitSignals, solution: Solution) -> list[Selected]:
    """Starts of fits with a load or a drift more."""
    poles, noise, dead = solution.coordinates, solution.noise, solution.dead
    options = [noise._replace(load=size) for size in LOADS if not noise.load]
    options += [noise._replace(drift=size) for size in DRIFTS if not noise.drift]
    return [judged(signals, PoleFit.at(signals, poles, dead, option)) for option in options]


def _without_load(signals: FitSignals, solution: Solution) -> list[Selected]:
    """Starts of fits with a slow pole in place of the load, improved.

    Either explains slow errors. Beside the load a slow pole is not found, for its share of the
    response is small while the load takes the rest.
    """
    poles, noise, dead = solution.coordinates, solution.noise, solution.dead
    if not noise.load or poles.size == POLES_MAX:
        return []
    noise = noise._replace(load=0.0, drift=noise.drift or DRIFTS[-1])
    rates = math.log(slowest_decay(poles)) - np.log(SLOWER)
    starts = [with_single(poles, float(rate)) for rate in rates]
    fits = [PoleFit.at(signals, x, dead, noise) for x in starts]
    return [judged(signals, improve(signals, min(fits, key=by_cost)))]


def at_least_two(poles: FloatArray) -> FloatArray:
    """The coordinates; of a single pole those of a pair with one that decays within a sample."""
    return with_single(poles, FASTEST_SINGLE) if poles.size == 1 else poles
