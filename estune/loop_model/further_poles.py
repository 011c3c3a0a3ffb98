"""Poles that a loop model may have beside its own: where a search for them begins."""

import math
from collections.abc import Iterator
from itertools import product

import numpy as np

from estune.core.filtering import lfilter
from estune.core.quantities import FloatArray
from estune.loop_model.criterion import Selected, judged
from estune.loop_model.error_filters import delayed, whiten, without
from estune.loop_model.fit_signals import FitSignals
from estune.loop_model.identification import PoleFit, improve
from estune.loop_model.least_squares import Solution
from estune.loop_model.noise_model import shaping
from estune.loop_model.poles import sections_of, slowest_decay, with_single

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


def with_further_pair(signals: FitSignals, best: PoleFit) -> PoleFit:
    """The fit with the further pair of poles that promises most, whatever the criterion says."""
    solution = best.solution(signals)
    pair = max(_pairs(signals, solution), key=lambda extra: _gain(signals, solution, extra))
    return improve(signals, best._replace(coordinates=np.append(best.coordinates, pair)))


def further_poles(signals: FitSignals, solution: Solution) -> Iterator[Selected]:
    """Starts of fits with further poles, and the criterion that the start alone would reach."""
    poles, noise, dead = solution.coordinates, solution.noise, solution.dead
    extras = _pairs(signals, solution) if poles.size % 2 == 0 else []
    slowest = max(slowest_decay(poles), 1e-3)
    extras += [np.log([rate]) for rate in np.geomspace(slowest / 10.0, 2.0, SINGLES)]
    for extra in extras:
        if poles.size + extra.size <= POLES_MAX:
            cost = 0.5 * max(solution.squares - _gain(signals, solution, extra), 0.0)
            more = np.append(poles, extra) if extra.size == 2 else with_single(poles, extra[0])
            yield judged(signals, PoleFit(cost, more, dead, noise))


def _pairs(signals: FitSignals, solution: Solution) -> list[FloatArray]:
    """Coordinates of pairs that a search may begin from."""
    slowest = min(slowest_decay(solution.coordinates), 1.0)
    frequencies = np.geomspace(max(slowest, 1e-3), HIGHEST, FREQUENCIES)
    pairs = [np.log(pair) for pair in product(frequencies, DAMPINGS)]
    highest = HIGHEST if signals.in_motion else math.pi
    for row in signals.split(solution.residual):
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
