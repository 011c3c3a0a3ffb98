"""Fits of plants that have poles outside the unit circle.

With C a polynomial of stable poles in place of A*, the prediction error

    e = (A/C) y - q^-(d+1) (B/C) u

is linear in A and B together, whose poles may then lie anywhere (a state-variable filter). C is
taken from a coarse grid, and then from the A that was found. From there the poles are searched as
those of any other plant.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.compiled import compiled
from estune.loop_model.compiled_errors import filtered_errors
from estune.loop_model.criterion import criterion_of
from estune.loop_model.error_filters import delayed, filters_of, regressors_of, without
from estune.loop_model.fit_signals import FitSignals
from estune.loop_model.identification import (
    PoleFit,
    by_cost,
    dead_times,
    searched_dead_time,
)
from estune.loop_model.noise_model import WHITE
from estune.loop_model.nuisance import nuisance_of
from estune.loop_model.poles import (
    coordinates_of,
    difference_polynomial,
    mirrored,
    sections_of,
)
from estune.loop_model.whiteness import is_white

ORDERS = (1, 2, 3)
"""Orders that are begun from; further poles are added where errors are not white."""

FREQUENCIES = (0.3, 1.0, 3.0)
"""Poles of C, in units of 2 pi over the settling time."""

ROUNDS = 3
"""Times that C follows A."""


class _Linear(NamedTuple):
    """The solution with some C: its sum of squared errors, its dead time and A.

    Attributes:
        A: In powers of 1 - q^-1, shape (n + 1,).
    """

    squares: float
    dead: int
    A: FloatArray


def growing_fit(signals: FitSignals) -> PoleFit | None:
    """The best fit with poles outside the unit circle, by the criterion; None without one."""
    scale, found = 2.0 * np.pi / signals.settling_samples, list[PoleFit]()
    for order in ORDERS:
        singles = (np.log(scale * frequency) for frequency in FREQUENCIES)
        begun = (_begun(signals, _equal(one, order)) for one in singles)
        starts = [start for start in begun if start is not None and _grows(start.coordinates)]
        if starts:
            found.append(searched_dead_time(signals, [min(starts, key=by_cost)]))
            if is_white(signals, found[-1].solution(signals).residual):
                break
    return min(found, key=lambda fit: criterion_of(signals, fit), default=None)


def _begun(signals: FitSignals, C: FloatArray) -> PoleFit | None:
    """The fit that begins from C; None where its poles have no coordinates."""
    delays: Iterable[int] = dead_times(signals.settling_samples)
    found = None
    for _ in range(1 + ROUNDS):
        best = min(_solved(signals, C, delays), key=lambda one: one.squares)
        (coordinates,) = coordinates_of(best.A[np.newaxis], growing=True)
        if coordinates is None:
            break
        x = np.array(coordinates)
        found = PoleFit.at(signals, x, best.dead)
        C, delays = mirrored(x), {max(best.dead + step, 0) for step in (-2, -1, 0, 1, 2)}
    return found


def _solved(signals: FitSignals, C: FloatArray, delays: Iterable[int]) -> Iterator[_Linear]:
    """The solutions with C at some dead times.

    A is C and q^-1 times a polynomial of one term less, for both begin with one.
    """
    n, library = C.size, compiled("prediction_errors")
    if library is not None:
        groups, delays = [group[:3] for group in signals.groups], list(delays)
        found = filtered_errors(library, groups, signals.hum, C, delays)
        for dead, squares, numbers in zip(delays, *found, strict=True):
            yield _Linear(float(squares), dead, _with_past(C, numbers))
        return
    filters, parts = filters_of(C, WHITE, signals.settling_samples), []
    for group in signals.groups:
        Q = nuisance_of(group, C, WHITE, signals)
        measured = delayed(regressors_of(group.measurement, filters, n)[:-1], 1)
        driven = regressors_of(group.effort, filters, n)
        target = without(group.measurement[:, group.history :], Q).ravel()
        late = without(measured[..., group.history :], Q).reshape(n, -1)
        parts.append((target, late, driven, group.history, Q))
    y = np.concatenate([target for target, *_ in parts])
    past = np.concatenate([late for _, late, *_ in parts], axis=1)
    for dead in delays:
        rows = [
            without(delayed(driven, dead + 1)[..., history:], Q).reshape(n + 1, -1)
            for *_, driven, history, Q in parts
        ]
        X = np.vstack([-past, np.concatenate(rows, axis=1)]).T
        size = np.maximum(np.linalg.norm(X, axis=0), 1e-300)
        numbers = np.linalg.lstsq(X / size, y, rcond=1e-10)[0] / size
        left = y - X @ numbers
        yield _Linear(float(left @ left), dead, _with_past(C, numbers))


def _with_past(C: FloatArray, numbers: FloatArray) -> FloatArray:
    """A in powers of 1 - q^-1, of C and the numbers of the past of the measurement."""
    A, n = difference_polynomial(C), C.size
    A[:-1] += numbers[:n]
    A[1:] -= numbers[:n]
    return A


def _grows(coordinates: FloatArray) -> bool:
    return any(section.grows for section in sections_of(coordinates))


def _equal(logarithm: float, order: int) -> FloatArray:
    """Coordinates of so many poles that decay alike."""
    return np.array([logarithm, 0.0] * (order // 2) + [logarithm] * (order % 2))
