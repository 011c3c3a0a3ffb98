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
    order, terms = coordinates.size, coordinates.size + 1
    lengths = [effort.shape[1] - history for effort, _, history in groups]
    residuals = sum(len(g[0]) * n for g, n in zip(groups, lengths, strict=True))
    longest = max(lengths)
    signals = [np.ascontiguousarray(one, float) for group in groups for one in group[:2]]
    sizes = np.array([(*g[0].shape, g[2]) for g in groups], np.int64)
    ranks = np.empty(len(groups), np.int64)
    b = np.empty(terms) if numerator is None else np.array(numerator, float)
    x = np.array(coordinates, float)
    nuisance = np.empty((len(groups), MOST_COLUMNS, longest))
    rows, residual = np.empty((2, terms, residuals)), np.empty(residuals)
    addresses = np.array([one.ctypes.data for one in signals], np.int64)
    arrays = [x, sizes, addresses, b, ranks, nuisance, rows[0], rows[1], residual]
    given = numerator is not None
    task = _Task(
        *(order, terms, dead, len(groups), residuals, longest, given, hum),
        *(one.ctypes.data for one in arrays),
    )
    if library.estune_prediction_errors(ctypes.byref(task)):
        raise MemoryError("no memory for the errors of a fit")
    parts = zip(nuisance, ranks.tolist(), lengths, strict=True)
    return CompiledErrors(
        tuple(one[:rank, :n].T for one, rank, n in parts),
        *(rows[0].T, rows[1].T, b, residual),
        (task, [*arrays, *signals]),
        library,
    )
