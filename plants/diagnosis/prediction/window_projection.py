"""Projection that removes the initial state of each window from a signal."""

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray


class WindowProjection:
    """Inner products and projections, window by window."""

    def __init__(self, block_end: NDArray[np.int64]) -> None:
        """The windows end before the entries `block_end`, shape (windows,)."""
        self._first = np.concatenate([[0], block_end[:-1]])
        self._sizes = np.diff(np.concatenate([[0], block_end]))
        self._filled = self._sizes > 0

    def dot(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Inner product of two signals over each window, at each of its entries."""
        sums = np.zeros(self._sizes.size)
        if self._filled.any():
            sums[self._filled] = np.add.reduceat(a * b, self._first[self._filled])
        return np.repeat(sums, self._sizes)

    def later_sums(self, a: FloatArray) -> FloatArray:
        """Sum of a signal from each entry to the end of its window."""
        before = np.cumsum(a) - a
        first = before[np.minimum(self._first, a.size - 1)]
        sums: FloatArray = self.dot(a, np.ones(a.size)) - before + np.repeat(first, self._sizes)
        return sums

    def orthonormal(self, directions: FloatArray) -> FloatArray:
        """Gram-Schmidt orthonormalisation, twice for accuracy, in each window; same shape."""
        basis = np.zeros_like(directions)
        for n, direction in enumerate(directions):
            size = np.sqrt(self.dot(direction, direction))
            remainder = np.divide(direction, size, out=np.zeros_like(direction), where=size > 0.0)
            for _ in range(2):
                remainder = self.residual_after(remainder, basis[:n])
            length = np.sqrt(self.dot(remainder, remainder))
            # What is nearly a combination of the others is left out.
            np.divide(remainder, length, out=basis[n], where=length > 1e-6)
        return basis

    def residual_after(self, signal: FloatArray, basis: FloatArray) -> FloatArray:
        """Signal without its components along the basis, shape (entries,).

        Args:
            signal: Shape (entries,).
            basis: Orthonormal in each window, shape (directions, entries).
        """
        for direction in basis:
            signal = signal - self.dot(signal, direction) * direction
        return signal
