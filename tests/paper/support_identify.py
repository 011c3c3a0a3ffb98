"""A second-order plant simulated without the code under test: scipy's hold on a finer clock."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import cont2discrete, dlsim

SAMPLING_HZ = 632.0
FINER = 4
"""Fine samples per sample, so that a dead time may be a multiple of a quarter of a sample."""


class Truth(NamedTuple):
    """A plant with known numbers; the dead time in quarters of a sample."""

    gain: float = 18.0
    natural_Hz: float = 8.0
    damping: float = 0.11
    dead_time_quarters: int = 5
    gauge_Hz: float = 280.0
    gauge_damping: float = 0.03

    @property
    def dead_time_s(self):
        return self.dead_time_quarters / FINER / SAMPLING_HZ


def simulated(truth, u):
    """Output just before each new input, from rest, exact under zero-order hold."""
    w, w_g = 2 * np.pi * truth.natural_Hz, 2 * np.pi * truth.gauge_Hz
    A = block_diag(
        [[0.0, 1.0], [-(w**2), -2 * truth.damping * w]],
        [[0.0, 1.0], [-(w_g**2), -2 * truth.gauge_damping * w_g]],
    )
    A[3, 0] = w_g**2
    B = np.array([[0.0], [truth.gain * w**2], [0.0], [0.0]])
    system = (A, B, np.array([[0.0, 0.0, 1.0, 0.0]]), np.zeros((1, 1)))
    fine = cont2discrete(system, 1.0 / (SAMPLING_HZ * FINER), method="zoh")
    held_input = np.repeat(u, FINER)
    late = np.concatenate([np.zeros(truth.dead_time_quarters), held_input])[: held_input.size]
    _, y, _ = dlsim((*fine[:4], fine[4]), late)
    return y[::FINER, 0]
