"""What another start of each window explains, and what that leaves of a signal.

Everything is done block by block, a block being the entries of one window.
"""

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray

NOTHING = 1e-6
"""A direction of which less than this share is left beside the others is none."""


class WindowProjection:
    """Sums over the entries of each window."""

    def __init__(self, block_end: NDArray[np.int64]) -> None:
        """Notes where windows end.

        Args:
            block_end: Entry after the last of each window, shape (windows,).
        """
        self._first = np.concatenate([[0], block_end[:-1]])
        self._sizes = np.diff(np.concatenate([[0], block_end]))
        self._filled = self._sizes > 0

    def dot(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """The product of two signals over each window, at each of its entries."""
        sums = np.zeros(self._sizes.size)
        if self._filled.any():
            sums[self._filled] = np.add.reduceat(a * b, self._first[self._filled])
        return np.repeat(sums, self._sizes)

    def orthonormal(self, directions: FloatArray) -> FloatArray:
        """Gram and Schmidt's method, twice, in each window by itself; same shape."""
        basis = np.zeros_like(directions)
        for n, direction in enumerate(directions):
            size = np.sqrt(self.dot(direction, direction))
            left = np.divide(direction, size, out=np.zeros_like(direction), where=size > 0.0)
            for _ in range(2):
                left = self.residual_after(left, basis[:n])
            rest = np.sqrt(self.dot(left, left))
            np.divide(left, rest, out=basis[n], where=rest > NOTHING)
        return basis

    def residual_after(self, signal: FloatArray, basis: FloatArray) -> FloatArray:
        """What directions leave of a signal, shape (entries,).

        Args:
            signal: Shape (entries,).
            basis: Orthonormal in each window, shape (directions, entries).
        """
        for direction in basis:
            signal = signal - self.dot(signal, direction) * direction
        return signal
