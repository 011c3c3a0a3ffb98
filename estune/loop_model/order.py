"""Order and noise of a loop model, chosen by the Bayesian information criterion.

A fit whose prediction errors are white is kept. Otherwise further poles, a load and a drift are
tried, each from the starts that promise most, and what lowers the criterion most is added, until
nothing does.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import product
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from estune.core.filtering import lfilter
from estune.core.quantities import FloatArray
from estune.loop_model.error_filters import delayed, whiten, without
from estune.loop_model.identification import (
    START_NOISES,
    PoleFit,
    by_cost,
    cold_starts,
    dead_times,
    improve,
    searched_dead_time,
)
from estune.loop_model.least_squares import FitSignals, Solution, free_parameters
from estune.loop_model.noise_model import WHITE, NoiseModel, shaping
from estune.loop_model.poles import GROWS_FROM, OUTSIDE, pair_coordinates, sections_of
from estune.loop_model.sensor_colour import recoloured
from estune.loop_model.whiteness import is_contradicted, is_white, rows_of

POLES_MAX = 6

FREQUENCIES, DAMPINGS = 9, (0.5, 0.1)
"""Coarse grid of a further pair of poles, between the slowest pole and the sampling rate."""

HIGHEST = 2.8
"""Highest frequency, rad/sample, that a further pair begins at in records of service: next to half
the sampling rate a plant is not told from the colour of the sensor's noise, which is fed back."""

PEAKS, PEAK_SHIFTS, PEAK_DAMPINGS = 2, (-0.9, -0.4, 0.0, 0.4, 0.9), (0.03, 0.01, 0.003)
"""Peaks of the spectrum of the errors that a further pair begins from, in bins beside them, for
the loop moves a resonance of the plant, and its damping there."""

SINGLES = 6
"""Further single poles that a search may begin from."""

SLOWEST_SINGLE, FASTEST_SINGLE = math.log(1e-4), math.log(2.0)
"""Logarithms of the decay per sample between which a single pole begins."""

COLOURS, COLOUR_GAIN = 4, 2.0
"""Colours that are found in turn, at most, and the decrease of the criterion that ends it."""

SLOWER = (3.0, 10.0, 30.0)
"""Ratios of a pole in place of the load to the slowest of the others."""

INTEGRATOR = 1e-2
"""Decay over the longest record from which on a pole is no integrator to it. The search moves one
that it does not need towards none, and the numerator with it to the wrong sign: on a lag of the
third order with a zero in the right half plane it ended at e^-41 per sample, and no gains made a
stable loop. A double integrator in noise is found with 0.3."""

TRIED = 2
"""Starts that are improved."""

LOAD_SHARE = 0.5
"""Share of the squared errors that a load has to explain in one record. Loads of 3 % of the step
explain 84 to 93 % on four plants of `experiments.batch`, friction in the eyelet of a reel none."""

LOADS = (1e-2, 1.0, 100.0)
DRIFTS = (1e-4, 1e-2)
"""Sizes of load and drift that a search begins from."""


class Selected(NamedTuple):
    """A fit and its criterion.

    Attributes:
        criterion: N ln(sum of squares) + ln N times the number of parameters.
    """

    fit: PoleFit
    criterion: float


by_criterion = attrgetter("criterion")


def select_order(signals: FitSignals, start: PoleFit) -> PoleFit:
    """The fit of the order and noise that the records ask for, from one of low order.

    Trials from rest have a load or drift where no further poles make their errors white, these
    do, the criterion falls, and the records before their steps allow it: a drum that friction
    holds is at rest there. In one record a loop that hunts looks like a load: there that has to
    explain `LOAD_SHARE` of what further poles leave.
    """
    other = _selected(signals, start, has_load=signals.in_motion)
    left = solution_of(signals, other)
    if signals.in_motion or is_white(signals, left.residual):
        return other
    begun = [start]
    if start.noise.is_white:  # poles that took up a load before it was known would stay
        begun += cold_starts(signals, START_NOISES[1:])
    found = min(
        (_selected(signals, one, has_load=True) for one in begun),
        key=lambda one: criterion_of(signals, one),
    )
    loaded = solution_of(signals, found)
    if not is_white(signals, loaded.residual) or is_contradicted(signals, loaded.residual):
        return other
    share = 1.0 - LOAD_SHARE if signals.records == 1 else math.inf
    is_better = criterion_of(signals, found) < criterion_of(signals, other)
    return found if is_better and loaded.squares < share * left.squares else other


def _selected(signals: FitSignals, start: PoleFit, *, has_load: bool) -> PoleFit:
    """The fit of the least criterion, with a load or drift or without.

    They come first, then the colour of what they leave, which else stands for them.
    """
    if not has_load:
        start = start._replace(noise=WHITE)
    best = _judged(signals, start)
    while has_load:
        solution = solution_of(signals, best.fit)
        if is_white(signals, solution.residual):
            return best.fit
        better = _best_of(signals, best, _with_noise(signals, solution))
        if better is None:
            break
        best = better
    while True:
        if signals.in_motion:
            best = _recoloured(signals, best)
        solution = solution_of(signals, best.fit)
        if is_white(signals, solution.residual):
            return best.fit
        options = [*_further(signals, solution)]
        if has_load:
            options += _with_noise(signals, solution)
        options += _without_load(signals, solution)
        better = _best_of(signals, best, options)
        if better is None:
            return best.fit
        # Dead time stands for poles that a model lacks: with more of them it is shorter.
        moved = _judged(signals, searched_dead_time(signals, [better.fit]))
        # A move may lose a drift that was just found: it was found again without an end.
        best = min(better, moved, key=by_criterion)


def _best_of(signals: FitSignals, best: Selected, options: Sequence[Selected]) -> Selected | None:
    """The best of the options that promise most; None where none is better than a fit."""
    promising = sorted(options, key=by_criterion)[:TRIED]
    tried = [_judged(signals, improve(signals, one.fit)) for one in promising]
    is_usable = _is_settled if is_resolved(signals, best.fit.coordinates) else _is_controllable
    tried = [one for one in tried if is_usable(signals, one.fit)]
    better = min(tried, key=by_criterion, default=best)
    return better if better.criterion < best.criterion else None


def _recoloured(signals: FitSignals, best: Selected) -> Selected:
    """The fit with the colour that its errors have, where the criterion falls by it.

    In turn, for the errors have another colour with other poles.
    """
    for _ in range(COLOURS):
        noise = recoloured(signals, solution_of(signals, best.fit))
        if noise == best.fit.noise:
            break
        tried = _judged(signals, improve(signals, best.fit._replace(noise=noise)))
        gained, best = best.criterion - tried.criterion, min(best, tried, key=by_criterion)
        if gained < COLOUR_GAIN:
            break
    return best


def solution_of(signals: FitSignals, fit: PoleFit) -> Solution:
    """The solution at the poles, the noise and the dead time of a fit."""
    return Solution.at(signals, fit.coordinates, fit.dead, fit.noise)


def without_slowest_pole(signals: FitSignals, fit: PoleFit) -> PoleFit:
    """The fit of more than two poles without one slower than all records, if the criterion falls.

    To the records it is an integrator, and a small one of the wrong sign, which they do not tell
    from none, leaves no stable loop.
    """
    poles = np.concatenate([section.log_poles for section in sections_of(fit.coordinates)])
    # Two integrators may be a pair that turns by less than the records tell.
    still = np.abs(poles.imag) * _longest(signals) < INTEGRATOR
    real = sorted(np.abs(poles[still]).tolist())
    if fit.coordinates.size < 3 or len(real) < 2 or is_resolved(signals, fit.coordinates):
        return fit
    if poles.real.max() > 0.0:  # one outside the unit circle is none of the plant's integrators
        return fit
    turning = poles[~still & (poles.imag > 0.0)]
    sizes = np.abs(turning)
    fewer = np.log(np.column_stack([sizes, -turning.real / sizes])).ravel()
    for rate in real[1:]:
        fewer = _with_single(fewer, math.log(rate))
    tried = _judged(signals, searched_dead_time(signals, [fit._replace(coordinates=fewer)]))
    return tried.fit if tried.criterion < _judged(signals, fit).criterion else fit


def is_resolved(signals: FitSignals, coordinates: FloatArray, least: float = 1.0) -> bool:
    """Whether no pole is slower than all records: it decays by more than this over the longest."""
    return bool(_slowest(coordinates) * _longest(signals) > least)


def _longest(signals: FitSignals) -> int:
    """Samples of the longest record."""
    return max(int(group.effort.shape[1]) for group in signals.groups)


def _is_controllable(signals: FitSignals, fit: PoleFit) -> bool:
    """Whether the plant of trials from rest is no integrator of the wrong sign."""
    if signals.in_motion or is_resolved(signals, fit.coordinates, INTEGRATOR):
        return True
    return bool(solution_of(signals, fit).numerator[0] > 0.0)


def _is_settled(signals: FitSignals, fit: PoleFit) -> bool:
    """Whether no pole is slower than all records, or its sign is that of a stable loop.

    In trials from rest such a fit has to explain them besides. A double integrator with a lag
    looks like two poles that are resolved until it has the third.

    In records of service a load takes the place of a slow pole that is refused: with it the step
    response of the chamber of `tests/test_loop_records.py` is 3 % of the true one after 300 of
    its 700 samples.
    """
    if is_resolved(signals, fit.coordinates):
        return True
    solution = solution_of(signals, fit)
    if signals.in_motion:
        return bool(solution.numerator[0] > 0.0)
    return is_white(signals, solution.residual) and _is_controllable(signals, fit)


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
    return min(_judged(signals, two), _judged(signals, one), key=lambda it: it.criterion).fit


def is_enough(signals: FitSignals, fit: PoleFit) -> bool:
    """Whether a fit of trials from rest is white and resolved, and no further pole promises more.

    A further one is judged where it begins, without a search.
    """
    solution = solution_of(signals, fit)
    if signals.in_motion or not is_white(signals, solution.residual):
        return False
    if not is_resolved(signals, fit.coordinates):
        return False
    # As that of a further pole where it begins: without the price of dead time.
    own = criterion(signals, solution.squares, fit.coordinates.size, fit.noise)
    return all(one.criterion >= own for one in _further(signals, solution))


def _judged(signals: FitSignals, fit: PoleFit) -> Selected:
    """A fit with its criterion, infinite where it failed; a load or a drift of no size is none."""
    fit = fit._replace(noise=fit.noise.counted)
    if not math.isfinite(fit.cost) or (fit.noise.is_white and fit.noise.colour):
        return Selected(fit, math.inf)
    return Selected(fit, criterion(signals, 2.0 * fit.cost, fit.coordinates.size, fit.noise))


def criterion_of(signals: FitSignals, fit: PoleFit) -> float:
    """The criterion of a fit."""
    return _judged(signals, fit).criterion


def criterion(
    signals: FitSignals, squares: float, poles: int, noise: NoiseModel, further: int = 0
) -> float:
    """The criterion of a sum of squares, for a number of poles and of further parameters."""
    n = signals.samples
    # Below the resolution of the measurement nothing is left to explain.
    variance = squares / n + signals.resolution**2
    free = sum(free_parameters(group, poles, noise) for group in signals.groups)
    noises = sum(k > 0.0 for k in noise.sizes) + len(noise.colour)
    count = 2 * poles + 1 + noises + free + further
    return n * math.log(variance) + count * math.log(n)


def with_further_pair(signals: FitSignals, best: PoleFit) -> PoleFit:
    """The fit with the further pair of poles that promises most, whatever the criterion says."""
    solution = solution_of(signals, best)
    pair = max(_pairs(signals, solution), key=lambda extra: _gain(signals, solution, extra))
    return improve(signals, best._replace(coordinates=np.append(best.coordinates, pair)))


def _further(signals: FitSignals, solution: Solution) -> Iterator[Selected]:
    """Starts of fits with further poles, and the criterion that the start alone would reach."""
    poles, noise, dead = solution.coordinates, solution.noise, solution.dead
    extras = _pairs(signals, solution) if poles.size % 2 == 0 else []
    slowest = max(_slowest(poles), 1e-3)
    extras += [np.log([rate]) for rate in np.geomspace(slowest / 10.0, 2.0, SINGLES)]
    for extra in extras:
        if poles.size + extra.size <= POLES_MAX:
            cost = 0.5 * max(solution.squares - _gain(signals, solution, extra), 0.0)
            more = np.append(poles, extra) if extra.size == 2 else _with_single(poles, extra[0])
            yield _judged(signals, PoleFit(cost, more, dead, noise))


def _with_noise(signals: FitSignals, solution: Solution) -> list[Selected]:
    """Starts of fits with a load or a drift more.

    Not of trials from rest that show none before their step: what looks like a load there is the
    answer to the step of what no model has.
    """
    poles, noise, dead = solution.coordinates, solution.noise, solution.dead
    options = [noise._replace(load=size) for size in LOADS if not noise.load]
    options += [noise._replace(drift=size) for size in DRIFTS if not noise.drift]
    costs = [Solution.at(signals, poles, dead, option).cost for option in options]
    return [
        _judged(signals, PoleFit(cost, poles, dead, option))
        for cost, option in zip(costs, options, strict=True)
    ]


def _without_load(signals: FitSignals, solution: Solution) -> list[Selected]:
    """Starts of fits with a slow pole in place of the load, improved.

    Either explains slow errors. Beside the load a slow pole is not found, for its share of the
    response is small while the load takes the rest.
    """
    poles, noise, dead = solution.coordinates, solution.noise, solution.dead
    if not noise.load or poles.size == POLES_MAX:
        return []
    noise = noise._replace(load=0.0, drift=noise.drift or DRIFTS[-1])
    rates = math.log(_slowest(poles)) - np.log(SLOWER)
    starts = [_with_single(poles, float(rate)) for rate in rates]
    fits = [PoleFit(Solution.at(signals, x, dead, noise).cost, x, dead, noise) for x in starts]
    return [_judged(signals, improve(signals, min(fits, key=by_cost)))]


def at_least_two(poles: FloatArray) -> FloatArray:
    """The coordinates; of a single pole those of a pair with one that decays within a sample."""
    return _with_single(poles, FASTEST_SINGLE) if poles.size == 1 else poles


def _with_single(poles: FloatArray, single: float) -> FloatArray:
    """Coordinates with one more real pole; two single ones are a pair."""
    if poles.size % 2 == 0 or poles[-1] > GROWS_FROM:
        return np.append(poles, single)
    p, q = math.exp(-math.exp(poles[-1])), math.exp(-math.exp(single))
    return np.append(poles[:-1], pair_coordinates(-(p + q), p * q))


def _slowest(poles: FloatArray) -> float:
    logs = np.concatenate([section.log_poles for section in sections_of(poles)])
    return max(float(np.abs(logs).min()), 1e-6)


def _pairs(signals: FitSignals, solution: Solution) -> list[FloatArray]:
    """Coordinates of pairs that a search may begin from."""
    slowest = min(_slowest(solution.coordinates), 1.0)
    frequencies = np.geomspace(max(slowest, 1e-3), HIGHEST, FREQUENCIES)
    pairs = [np.log(pair) for pair in product(frequencies, DAMPINGS)]
    highest = HIGHEST if signals.in_motion else math.pi
    for row in rows_of(signals, solution.residual):
        spectrum = np.sum(np.abs(np.fft.rfft(row, axis=1)) ** 2, axis=0)
        smooth = np.convolve(spectrum[1:-1], [0.5, 1.0, 0.5], mode="same")
        for _ in range(PEAKS):
            peak = int(np.argmax(smooth))
            for shift, damping in product(PEAK_SHIFTS, PEAK_DAMPINGS):
                w = 2.0 * math.pi * (peak + 1 + shift) / row.shape[1]
                if w < highest:
                    pairs.append(np.log([w, damping]))
            smooth[max(peak - 2, 0) : peak + 3] = 0.0
    return pairs


def _gain(signals: FitSignals, solution: Solution, extra: FloatArray) -> float:
    """Sum of squares that a parallel section with these poles explains of the errors."""
    (section,) = sections_of(extra)
    columns: list[list[FloatArray]] = [[], []]
    for group, Q in zip(signals.groups, solution.nuisance, strict=True):
        driven = delayed(group.effort, solution.dead + 1)
        if not solution.noise.is_white:
            H = shaping(solution.coordinates, solution.noise, signals.settling_samples)
            driven = whiten(driven, H.zeros, H.poles)
        driven = lfilter([1.0], section.taps, driven)
        for column, terms in zip(columns, (driven, delayed(driven, 1)), strict=True):
            column.append(without(terms[:, group.history :], Q).ravel())
    Z = np.stack([np.concatenate(column) for column in columns], axis=1)
    Z -= solution.basis @ (solution.basis.T @ Z)
    basis, triangle = np.linalg.qr(Z)
    usable = np.abs(np.diag(triangle)) > 1e-9 * np.abs(triangle).max()
    return float(np.sum((basis[:, usable].T @ solution.residual) ** 2))
