"""Prediction errors of records as compiled C (`prediction_errors.c`), as of `least_squares`."""

import ctypes
import math
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from estune.loop_model.compiled import places

MOST_COLUMNS = 24
"""Columns that the C code has room for in each group."""

_COUNTS = ("order", "terms", "dead", "groups", "residuals", "longest", "given")
_FILTERS = ("zeros", "over", "colours")
_ARRAYS = ("coordinates", "filters", "sizes", "signals", "numerator", "ranks", "nuisance")


class _Task(ctypes.Structure):
    """Argument of the C functions."""

    _fields_ = (
        *((name, ctypes.c_long) for name in (*_COUNTS, *_FILTERS)),
        ("hum", ctypes.c_double),
        *((n, ctypes.c_void_p) for n in (*_ARRAYS, "regressors", "basis", "residual", "slopes")),
    )


Group = tuple[FloatArray, FloatArray, int]
"""Effort and measurement, shape (records, samples), and the history."""


class NoiseFilters(NamedTuple):
    """Filters of a noise that is not white.

    Attributes:
        zeros: Number of sections of C.
        over: Number of sections of A.
        taps: Those of both, three each, and of P N behind them.
    """

    zeros: int
    over: int
    taps: FloatArray


class CompiledErrors(NamedTuple):
    """Prediction errors at some poles.

    Attributes:
        nuisance: Of each group, as the other fields of `least_squares.Solution`.
        regressors: Of the numerator.
        basis: Of them; empty with a given numerator.
        numerator: B.
        residual: e.
        memory: What the C code reads for the slopes.
        library: The C code.
    """

    nuisance: tuple[FloatArray, ...]
    regressors: FloatArray
    basis: FloatArray
    numerator: FloatArray
    residual: FloatArray
    memory: tuple[_Task, list[NDArray[Any]]]
    library: ctypes.CDLL

    def slopes(self) -> FloatArray:
        """Slopes of the residual along the coordinates, shape (residuals, coordinates)."""
        task = self.memory[0]
        return self._slopes(task.order, self.library.estune_error_slopes)

    def noise_slopes(self, moved: Sequence[NoiseFilters], step: float) -> FloatArray:
        """Slopes to filters that are moved by a step each, shape (residuals, moves)."""
        taps = np.concatenate([one.taps for one in moved])
        move = self.library.estune_noise_slopes
        address, by = ctypes.c_void_p(taps.ctypes.data), ctypes.c_double(step)
        return self._slopes(
            len(moved), lambda task: move(task, ctypes.c_long(len(moved)), address, by)
        )

    def _slopes(self, count: int, found_by: Callable[[Any], int]) -> FloatArray:
        task = self.memory[0]
        found = np.empty((count, task.residuals))
        task.slopes = found.ctypes.data
        if found_by(ctypes.byref(task)):
            raise MemoryError("no memory for the slopes of a fit")
        return found.T


def compiled_errors(
    library: ctypes.CDLL,
    groups: Sequence[Group],
    hum: float,
    coordinates: FloatArray,
    *,
    dead: int,
    numerator: FloatArray | None,
    filters: NoiseFilters | None = None,
) -> CompiledErrors:
    """The prediction errors; without filters those with white noise.

    Raises:
        MemoryError: there is not enough memory.
    """
    task, numbers, ranks, memory = _task(
        groups, hum, coordinates, dead, numerator=numerator, filters=filters
    )
    if library.estune_prediction_errors(ctypes.byref(task)):
        raise MemoryError("no memory for the errors of a fit")
    _, b, residual, regressors, basis, nuisance = numbers
    lengths = (effort.shape[1] - history for effort, _, history in groups)
    parts = zip(nuisance, ranks.tolist(), lengths, strict=True)
    return CompiledErrors(
        tuple(one[:rank, :n].T for one, rank, n in parts),
        *(regressors.T, (basis if numerator is None else basis[:0]).T, b, residual),
        (task, memory),
        library,
    )


def improved(
    library: ctypes.CDLL,
    groups: Sequence[Group],
    hum: float,
    coordinates: FloatArray,
    *,
    dead: int,
    tolerances: tuple[float, float, float],
    most: int,
) -> tuple[FloatArray, float]:
    """Coordinates of least squares from some on, with white noise, and their sum of squares.

    The tolerances are of the sum of squares, of the coordinates and of the gradient.

    Raises:
        MemoryError: there is not enough memory.
    """
    task, numbers, _, memory = _task(groups, hum, coordinates, dead)
    squares, limits = ctypes.c_double(), map(ctypes.c_double, tolerances)
    by = ctypes.byref(squares)
    if library.estune_improve(ctypes.byref(task), *limits, ctypes.c_long(most), by):
        raise MemoryError("no memory for the errors of a fit")
    del memory  # the task reads it until here
    return numbers[0][: coordinates.size].copy(), squares.value


def delayed_errors(
    library: ctypes.CDLL,
    groups: Sequence[Group],
    hum: float,
    coordinates: FloatArray,
    *,
    delays: Sequence[int],
    filters: NoiseFilters | None,
) -> FloatArray:
    """Sums of squared errors at some dead times, shape (delays,), for which all is filtered once.

    Raises:
        MemoryError: there is not enough memory.
    """
    task, *_, memory = _task(groups, hum, coordinates, 0, filters=filters)
    squares, dead = np.empty(len(delays)), np.array(delays, np.int64)
    arrays = (ctypes.c_void_p(one.ctypes.data) for one in (dead, squares))
    if library.estune_delayed_errors(ctypes.byref(task), ctypes.c_long(len(delays)), *arrays):
        raise MemoryError("no memory for the errors of a fit")
    del memory  # the task reads it until here
    return squares


def filtered_errors(
    library: ctypes.CDLL,
    groups: Sequence[Group],
    hum: float,
    coordinates: FloatArray,
    delays: Sequence[int],
) -> tuple[FloatArray, FloatArray]:
    """Sums of squared errors (A/C) y - q^-(d+1) (B/C) u at some dead times, C of these poles.

    Returns:
        The sums, shape (delays,), and the numbers of A and B, shape (delays, 2 poles + 1).

    Raises:
        MemoryError: there is not enough memory.
    """
    terms = 2 * coordinates.size + 1
    task, *_, memory = _task(groups, hum, coordinates, 0, terms=terms)
    squares, numbers = np.empty(len(delays)), np.empty((len(delays), terms))
    dead = np.array(delays, np.int64)
    arrays = (ctypes.c_void_p(one.ctypes.data) for one in (dead, squares, numbers))
    if library.estune_filtered_errors(ctypes.byref(task), ctypes.c_long(len(delays)), *arrays):
        raise MemoryError("no memory for the errors of a fit")
    del memory  # the task reads it until here
    return squares, numbers


def _task(
    groups: Sequence[Group],
    hum: float,
    x: FloatArray,
    dead: int,
    *,
    numerator: FloatArray | None = None,
    terms: int | None = None,
    filters: NoiseFilters | None = None,
) -> tuple[_Task, list[FloatArray], NDArray[np.int64], list[NDArray[Any]]]:
    """The argument of the C functions, its arrays of numbers, its ranks, and all its memory."""
    lengths = [effort.shape[1] - history for effort, _, history in groups]
    residuals = sum(len(g[0]) * n for g, n in zip(groups, lengths, strict=True))
    longest, m, count = max(lengths), terms or x.size + 1, len(groups)
    signals = [np.ascontiguousarray(one, float) for group in groups for one in group[:2]]
    whole = np.array(
        [
            *(n for effort, _, history in groups for n in (*effort.shape, history)),
            *(one.ctypes.data for one in signals),
            *[0] * count,
        ],
        np.int64,
    )
    rows = (m, residuals)
    zeros, over, taps = filters or NoiseFilters(0, 0, np.empty(0))
    given = x if filters is None else np.concatenate([x, taps])
    shapes = (given.shape, (m,), (residuals,), rows, rows, (count, MOST_COLUMNS, longest))
    sizes = [math.prod(shape) for shape in shapes]
    block = np.empty(sum(sizes))
    ends = [*accumulate(sizes)]
    parts = zip((0, *ends), ends, shapes, strict=False)
    numbers = [block[begin:end].reshape(shape) for begin, end, shape in parts]
    numbers[0][:] = given
    if numerator is not None:
        numbers[1][:] = numerator
    of_x, b, residual, regressors, basis, nuisance = places(block, sizes)
    sized, addresses, ranks = places(whole, (3 * count, 2 * count, count))
    of_filters = of_x + x.nbytes
    task = _Task(
        *(x.size, m, dead, count, residuals, longest, numerator is not None),
        *(zeros, over, taps.size - 3 * (zeros + over), hum),
        *(of_x, of_filters, sized, addresses, b, ranks, nuisance, regressors, basis, residual),
    )
    return task, numbers, whole[-count:], [block, whole, *signals]
