"""State of the plant at some instants of a record, by least squares over the samples around them.

A window of a prediction begins there. The plant moves as its `Local` model with a constant input
error. The span is short enough that model errors hardly show and long enough to smooth noise and
the encoder's steps: it grows as long as its residual is that of noise.
"""

import math
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.models.diagnosed_model import Local


class InitialStates(NamedTuple):
    """Estimated states at some instants.

    Attributes:
        placed: Argument of `Equations.place`, shape (instants, n).
        residual: Root mean square of what the states leave of the output.
        deviation: Standard deviations of the states due to noise, shape (n,).
    """

    placed: FloatArray
    residual: float
    deviation: FloatArray


def estimate_states(
    local: Local, output: FloatArray, sampling_Hz: float, noise: float, at: NDArray[np.int64]
) -> InitialStates:
    """The states at the samples `at` of a record, whose output has `noise` rms."""
    needed = (local.B.size + 2) // 2
    rate = float(np.abs(np.linalg.eigvals(local.A)).max(initial=0.0)) / sampling_Hz
    sampled = _Sampled(local, output, sampling_Hz)
    best = sampled.states(at, needed)
    for extra in (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48):
        either = needed + extra
        # The backward propagation of a mode grows with its rate: a period of it at most.
        if 2 * either > output.size or either * rate > 2.0 * math.pi:
            break
        wider = sampled.states(at, either)
        if wider.residual > max((1.0 + CONSTANTS.quiet) * noise, best.residual):
            break
        best = wider
    return best._replace(deviation=noise * best.deviation)


class _Sampled:
    """The local model under zero-order hold, the constant input error appended to its state."""

    def __init__(self, local: Local, output: FloatArray, sampling_Hz: float) -> None:
        n = local.B.size
        A = np.zeros((n + 1, n + 1))
        A[:n, :n], A[:n, n] = local.A, local.B
        self._held = expm(A / sampling_Hz)
        # A mode that dies away within a sample leaves nothing to go back by.
        self._back = np.linalg.pinv(self._held)
        self._C = np.append(local.C, 0.0)
        self._to_placed = local.to_placed
        self._input = (
            None if local.input is None else shifted(local.input, local.dead_time_s * sampling_Hz)
        )
        self._output = output

    def states(self, at: NDArray[np.int64], either: int) -> InitialStates:
        """The states from so many samples on either side; at a record's ends from more on one."""
        n, size = self._held.shape[0] - 1, self._output.size
        span = min(2 * either + 1, size)
        first = np.clip(at - either, 0, size - span)
        states, squares, spread = np.empty((at.size, n)), 0.0, np.zeros(n)
        for place in np.unique(at - first).tolist():
            chosen = np.flatnonzero(at - first == place)
            windows = first[chosen, None] + np.arange(span)
            design = self._rows(-place, span - place)
            scale = np.abs(design).max(axis=0)
            pseudo = np.linalg.pinv(design / scale) / scale[:, None]
            wanted = self._output[windows]
            if self._input is not None:
                wanted = wanted - self._input[windows] @ self._forced(place, span).T
            solution = wanted @ pseudo.T
            squares += float(np.sum((wanted - solution @ design.T) ** 2))
            states[chosen] = solution[:, :n]
            spread = np.sqrt(np.sum((self._to_placed @ pseudo[:n]) ** 2, axis=1))
        freedom = at.size * max(span - n - 1, 1)
        return InitialStates(states @ self._to_placed.T, math.sqrt(squares / freedom), spread)

    def _rows(self, first: int, last: int) -> FloatArray:
        """Output at samples after an instant by the state there, (samples, n + 1)."""
        ahead = accumulate(range(last - 1), lambda row, _: row @ self._held, initial=self._C)
        before = accumulate(range(-first), lambda row, _: row @ self._back, initial=self._C)
        return np.array([*list(before)[:0:-1], *ahead])

    def _forced(self, place: int, span: int) -> FloatArray:
        """Output by the input at each sample of a span, from rest at the instant."""
        # A constant held over one sample moves the state by the last column of exp(A h).
        pushed = np.append(self._held[:-1, -1], 0.0)
        answer = self._rows(-span, span) @ pushed  # by samples since the end of the input pulse
        j, i = np.arange(span)[:, None], np.arange(span)
        forced: FloatArray = answer[j - i - 1 + span]
        # Inputs after the instant act on later samples, those before it on earlier ones.
        return np.where((i >= place) & (j > i), forced, 0.0) - np.where(
            (i < place) & (j <= i), forced, 0.0
        )


def shifted(signal: FloatArray, samples: float) -> FloatArray:
    """A held signal delayed or advanced: its mean over each sample."""
    whole = math.floor(samples)
    now = np.clip(np.arange(signal.size) - whole, 0, signal.size - 1)
    before = np.maximum(now - 1, 0)
    fraction = samples - whole
    return np.asarray((1.0 - fraction) * signal[now] + fraction * signal[before])
