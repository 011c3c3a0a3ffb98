"""Where the plant is at some instants of a record, from what is measured around them.

A window of a prediction begins there. Around each instant the plant is taken to move as
`models.Local` says, with an input that is off by a constant: a least-squares fit over a few
samples on either side. So few that what the model does not know hardly shows, so many that noise
and the encoder's steps are smoothed: the span grows as long as its residual stays that of noise.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from estune.core.quantities import FloatArray
from plants.diagnosis.models.diagnosed_model import Local

TOLERATED = 1.05
"""Residual of a span, relative to the noise, up to which it may grow."""
SPANS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48)
"""Samples on either side that are tried, beyond what the unknowns need."""
FURTHEST = 5.0
"""Span times the fastest rate, beyond which nothing is left of a mode, or too much backward."""


class InitialStates(NamedTuple):
    """States at some instants.

    Attributes:
        placed: What `Equations.place` takes, shape (instants, n).
        deviation: Their standard deviations by the noise, shape (n,).
    """

    placed: FloatArray
    deviation: FloatArray


class _Spanned(NamedTuple):
    states: FloatArray
    residual: float
    spread: FloatArray


def anchors(
    local: Local, output: FloatArray, sampling_Hz: float, noise: float, at: NDArray[np.int64]
) -> InitialStates:
    """The state at some samples of a record.

    Args:
        local: How the plant moves.
        output: What was measured of it, shape (samples,).
        sampling_Hz: Sampling rate.
        noise: Noise of the output, rms; zero is none.
        at: The samples, shape (instants,).
    """
    needed = (local.B.size + 2) // 2
    rate = float(np.abs(np.linalg.eigvals(local.A)).max(initial=0.0)) / sampling_Hz
    sampled = _Sampled(local, output, sampling_Hz)
    best = sampled.states(at, needed)
    for extra in SPANS:
        either = needed + extra
        if 4 * either > output.size or either * rate > FURTHEST:
            break
        wider = sampled.states(at, either)
        if wider.residual > max(TOLERATED * noise, best.residual):
            break
        best = wider
    return InitialStates(best.states @ local.to_placed.T, noise * best.spread)


class _Sampled:
    """The local plant under zero-order hold, its state made longer by the constant."""

    def __init__(self, local: Local, output: FloatArray, sampling_Hz: float) -> None:
        n = local.B.size
        A = np.zeros((n + 1, n + 1))
        A[:n, :n], A[:n, n] = local.A, local.B
        self._held = expm(A / sampling_Hz)
        self._back = np.linalg.inv(self._held)
        self._C = np.append(local.C, 0.0)
        self._to_placed = local.to_placed
        self._input = (
            None if local.input is None else shifted(local.input, local.dead_time_s * sampling_Hz)
        )
        self._output = output

    def states(self, at: NDArray[np.int64], either: int) -> _Spanned:
        """The states by so many samples on either side; at a record's ends by more on one."""
        n, size = self._held.shape[0] - 1, self._output.size
        span = min(2 * either + 1, size)
        first = np.clip(at - either, 0, size - span)
        states, left, spread = np.empty((at.size, n)), 0.0, np.zeros(n)
        for place in np.unique(at - first).tolist():
            chosen = np.flatnonzero(at - first == place)
            windows = first[chosen, None] + np.arange(span)
            design = self._rows(-place, span - place)
            scale = np.abs(design).max(axis=0)
            pseudo = np.linalg.pinv(design / scale) / scale[:, None]
            wanted = self._output[windows]
            if self._input is not None:
                wanted = wanted - self._input[windows] @ self._forced(place, span).T
            found = wanted @ pseudo.T
            left += float(np.sum((wanted - found @ design.T) ** 2))
            states[chosen] = found[:, :n]
            spread = np.sqrt(np.sum((self._to_placed @ pseudo[:n]) ** 2, axis=1))
        freedom = at.size * max(span - n - 1, 1)
        return _Spanned(states, math.sqrt(left / freedom), spread)

    def _rows(self, first: int, last: int) -> FloatArray:
        """The output so many samples after an instant, by the state there, (samples, n + 1)."""
        rows = np.empty((last - first, self._C.size))
        rows[-first] = self._C
        for k in range(1 - first, last - first):
            rows[k] = rows[k - 1] @ self._held
        for k in range(-first - 1, -1, -1):
            rows[k] = rows[k + 1] @ self._back
        return rows

    def _forced(self, place: int, span: int) -> FloatArray:
        """The output by the input at each sample of a span, from rest at the place."""
        # A constant held over one sample moves the state by the last column of exp(A h).
        pushed = np.append(self._held[:-1, -1], 0.0)
        answer = self._rows(-span, span) @ pushed  # so many samples after the push has ended
        j, i = np.arange(span)[:, None], np.arange(span)
        forced: FloatArray = answer[j - i - 1 + span]
        # What is pushed after the place shows later, what is pushed before it is undone earlier.
        return np.where((i >= place) & (j > i), forced, 0.0) - np.where(
            (i < place) & (j <= i), forced, 0.0
        )


def shifted(signal: FloatArray, samples: float) -> FloatArray:
    """A held signal that comes late, or early: its mean over each sample."""
    whole = math.floor(samples)
    now = np.clip(np.arange(signal.size) - whole, 0, signal.size - 1)
    before = np.maximum(now - 1, 0)
    fraction = samples - whole
    return np.asarray((1.0 - fraction) * signal[now] + fraction * signal[before])
