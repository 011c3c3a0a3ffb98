"""Prediction errors of records as compiled C (`prediction_errors.c`), as of `least_squares`."""

import ctypes
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray

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
    memory: tuple[_Task, list[FloatArray]]
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
    b = np.empty(coordinates.size + 1) if numerator is None else np.array(numerator, float)
    task, arrays = _task(groups, hum, coordinates, b, dead, given=numerator is not None)
    if library.estune_prediction_errors(ctypes.byref(task)):
        raise MemoryError("no memory for the errors of a fit")
    ranks, nuisance, regressors, basis, residual = arrays[:5]
    lengths = (effort.shape[1] - history for effort, _, history in groups)
    parts = zip(nuisance, ranks.tolist(), lengths, strict=True)
    return CompiledErrors(
        tuple(one[:rank, :n].T for one, rank, n in parts),
        *(regressors.T, basis.T, b, residual),
        (task, arrays),
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
    b = np.empty(2 * coordinates.size + 1)
    task, arrays = _task(groups, hum, coordinates, b, 0, given=False)
    squares, numbers = np.empty(len(delays)), np.empty((len(delays), b.size))
    dead = np.array(delays, np.int64)
    places = (ctypes.c_void_p(one.ctypes.data) for one in (dead, squares, numbers))
    if library.estune_filtered_errors(ctypes.byref(task), ctypes.c_long(len(delays)), *places):
        raise MemoryError("no memory for the errors of a fit")
    del arrays  # the task reads them until here
    return squares, numbers


def _task(
    groups: Sequence[Group],
    hum: float,
    coordinates: FloatArray,
    b: FloatArray,
    dead: int,
    *,
    given: bool,
) -> tuple[_Task, list[FloatArray]]:
    """The argument of the C functions, and the arrays that it points to."""
    lengths = [effort.shape[1] - history for effort, _, history in groups]
    residuals = sum(len(g[0]) * n for g, n in zip(groups, lengths, strict=True))
    longest = max(lengths)
    signals = [np.ascontiguousarray(one, float) for group in groups for one in group[:2]]
    sizes = np.array([(*g[0].shape, g[2]) for g in groups], np.int64)
    addresses = np.array([one.ctypes.data for one in signals], np.int64)
    ranks = np.empty(len(groups), np.int64)
    nuisance = np.empty((len(groups), MOST_COLUMNS, longest))
    rows, x = np.empty((2, b.size, residuals)), np.array(coordinates, float)
    filled = [ranks, nuisance, rows[0], rows[1], np.empty(residuals)]
    arrays = [x, sizes, addresses, b, *filled]
    task = _Task(
        *(x.size, b.size, dead, len(groups), residuals, longest, given, hum),
        *(one.ctypes.data for one in arrays),
    )
    return task, [*filled, *arrays, *signals]
