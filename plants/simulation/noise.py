"""Measurement noise that depends on the rig's seed and the trial's number alone."""

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput


class NoiseSource:
    """White Gaussian noise from a counter-based generator (Philox, Salmon et al. 2011).

    The seed and the trial's number are the generator's key, so that any trial's noise can be had
    without drawing that of the trials before it. Not for two threads at once.

    Raises:
        InvalidInput: the seed is not a whole number from 0 to 2^64 - 1.
    """

    def __init__(self, seed: int) -> None:
        if not (isinstance(seed, int | np.integer) and 0 <= seed < 2**64):
            raise InvalidInput(f"seed is {seed!r}; it must be a whole number from 0 to 2^64 - 1")
        self._seed = int(seed)
        self._bits = np.random.Philox(key=0)
        self._generator = np.random.Generator(self._bits)
        # Setting the state of one generator costs half of what making one does.
        self._state = self._bits.state

    def draw(self, number: int, samples: int, rms: float) -> FloatArray:
        """The noise of one trial, shape (samples,).

        Args:
            number: The trial's place in its run, zero or above.
            samples: How many.
            rms: Their root mean square.
        """
        self._state["state"]["key"][:] = self._seed, number
        self._state["state"]["counter"][:] = 0
        self._bits.state = self._state
        noise = self._generator.standard_normal(samples)
        noise *= rms
        return noise
