"""Measurement noise as a function of the rig's seed and the trial's number."""

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput


class NoiseSource:
    """White Gaussian noise from a counter-based generator (Philox, Salmon et al. 2011).

    The seed and the trial's number are the generator's key: the noise of any trial is available
    without that of the earlier ones. Not thread-safe.

    Raises:
        InvalidInput: the seed is not a whole number from 0 to 2^64 - 1.
    """

    def __init__(self, seed: int) -> None:
        if not (isinstance(seed, int | np.integer) and 0 <= seed < 2**64):
            raise InvalidInput(f"seed is {seed!r}; it must be a whole number from 0 to 2^64 - 1")
        self._seed = int(seed)
        self._bits = np.random.Philox(key=0)
        self._generator = np.random.Generator(self._bits)
        # Setting the state of a generator takes half the time of making one.
        self._state = self._bits.state

    def draw(self, number: int, samples: int, rms: float) -> FloatArray:
        """Noise of the trial with this number in its run, shape (samples,)."""
        self._state["state"]["key"][:] = self._seed, number
        self._state["state"]["counter"][:] = 0
        self._bits.state = self._state
        noise = self._generator.standard_normal(samples)
        noise *= rms
        return noise
