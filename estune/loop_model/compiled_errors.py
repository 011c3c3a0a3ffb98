"""Prediction errors of records as compiled C (`prediction_errors.c`), as of `least_squares`."""

import ctypes
import math
from collections.abc import Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from estune.loop_model.compiled import places

MOST_COLUMNS = 24
"""Columns that the C code has room for in each group."""

_COUNTS = ("order", "terms", "dead", "groups", "residuals", "longest", "given")
_ARRAYS = ("coordinates", "sizes", "signals", "numerator", "ranks", "nuisance")


class _Task(ctypes.Structure):
    """Argument of the C functions."""

    _fields_ = (
        *((name, ctypes.c_long) for name in _COUNTS),
        ("hum", ctypes.c_double),
        *((n, ctypes.c_void_p) for n in (*_ARRAYS, "regressors", "basis", "residual", "slopes")),
    )


Group = tuple[FloatArray, FloatArray, int]
"""Effort and measurement, shape (records, samples), and the history."""


class CompiledErrors(NamedTuple):
    """Prediction errors at some poles.

    Attributes:
        nuisance: Of each group, as the other fields of `least_squares.Solution`.
        regressors: Of the numerator.
        basis: Of them.
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
        found = np.empty((task.order, task.residuals))
        task.slopes = found.ctypes.data
        if self.library.estune_error_slopes(ctypes.byref(task)):
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
) -> CompiledErrors:
    """The prediction errors with white noise.

    Raises:
        MemoryError: there is not enough memory.
    """
    task, numbers, ranks, memory = _task(groups, hum, coordinates, dead, numerator=numerator)
    if library.estune_prediction_errors(ctypes.byref(task)):
        raise MemoryError("no memory for the errors of a fit")
    _, b, residual, regressors, basis, nuisance = numbers
    lengths = (effort.shape[1] - history for effort, _, history in groups)
    parts = zip(nuisance, ranks.tolist(), lengths, strict=True)
    return CompiledErrors(
        tuple(one[:rank, :n].T for one, rank, n in parts),
        *(regressors.T, basis.T, b, residual),
        (task, memory),
        library,
    )


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
    shapes = (x.shape, (m,), (residuals,), rows, rows, (count, MOST_COLUMNS, longest))
    sizes = [math.prod(shape) for shape in shapes]
    block = np.empty(sum(sizes))
    ends = [*accumulate(sizes)]
    parts = zip((0, *ends), ends, shapes, strict=False)
    numbers = [block[begin:end].reshape(shape) for begin, end, shape in parts]
    numbers[0][:] = x
    if numerator is not None:
        numbers[1][:] = numerator
    of_x, b, residual, regressors, basis, nuisance = places(block, sizes)
    sized, addresses, ranks = places(whole, (3 * count, 2 * count, count))
    given = numerator is not None
    task = _Task(
        *(x.size, m, dead, count, residuals, longest, given, hum),
        *(of_x, sized, addresses, b, ranks, nuisance, regressors, basis, residual),
    )
    return task, numbers, whole[-count:], [block, whole, *signals]
