"""How far the plant may be from its identified model, over frequency.

The true plant is G + E. What the records leave unexplained in a band, over the effort there,
bounds the additive error in it:

    |E|^2 <= (|e|^2 - noise)/|u|^2 + (2 s)^2,     s^2 = noise/|u|^2

with powers summed over the bins of the band in all records. The first term is what is left beyond
the noise, s the standard deviation of an error that the noise would hide. With a
controller C and a loop L the true |1 + L| is at least |1 + L| - |C E|: where |C E| is not small
against |1 + L|, nothing is known of the loop.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.error_filters import whiten
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.margins import loop_response
from estune.loop_model.noise_model import shaping
from estune.loop_model.records import LoopRecord

HALF_WIDTH = 0.02
"""Half width of a band over its frequency: errors are averaged over as much as the resonance of a
mode of this damping. A narrower one is bounded as far as the records resolve it."""

DEVIATIONS = 2.0
"""Standard deviations of an error that the noise would hide: a complex one exceeds them in 2 %."""

MOST = 0.7
"""Share of a bound from which what is unexplained is the larger part of its square."""

CHANCE = 0.02
"""Probability that noise alone is taken for something unexplained in any of the bands, half of
which overlap with the next."""

UNKNOWN_FROM = 0.5
"""Share of |1 + L| that |C E| may reach: there Ms may be twice what the model says."""


class PlantErrorBound(NamedTuple):
    """Bound of the additive error of the plant.

    Attributes:
        theta: Frequencies, rad/sample, shape (bands,).
        bound: Largest |E| in each band; infinite where nothing is excited.
        unexplained: Part of it that is left beyond the noise.
    """

    theta: FloatArray
    bound: FloatArray
    unexplained: FloatArray


class ErrorMargin(NamedTuple):
    """What a bound of the plant's error leaves of the robustness of a loop.

    Attributes:
        distance: Least |1 + L| that the bound allows; zero or below where it allows an unstable
            loop.
        unknown: Lowest and highest frequency, rad/sample, of the band in which the bound is not
            small against the loop; None where it is small everywhere.
        excited: Whether what the model leaves unexplained is the reason, not too little effort.
    """

    distance: float
    unknown: tuple[float, float] | None
    excited: bool = False

    @property
    def sensitivity(self) -> float:
        """Largest Ms that the bound allows; infinite where it allows an unstable loop."""
        return 1.0 / self.distance if self.distance > 0.0 else math.inf


class BandPowers(NamedTuple):
    """Powers of records in bands, by which the plant's error is bounded; shape (bands,) each.

    Attributes:
        theta: Frequencies, rad/sample.
        left: Power of what is left of the records.
        driven: Power of the effort.
        noise: Power of the noise.
        bins: Number of bins.
    """

    theta: FloatArray
    left: FloatArray
    driven: FloatArray
    noise: FloatArray
    bins: FloatArray

    def bound(self, effort: FloatArray | None = None, trials: int = 1) -> PlantErrorBound:
        """The bound, with trials from rest to come of an effort of shape (samples,).

        With them the noise hides less, and no more is left unexplained.
        """
        known = self.driven
        if effort is not None and np.isfinite(effort).all():
            known = known + trials * _in_bands(_step_power(effort), effort.size - 1, self.theta)[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            expected = self.noise * _largest(self.bins)
            beyond = np.maximum(self.left - expected, 0.0) / self.driven
            squared = beyond + DEVIATIONS**2 * self.noise / (self.bins * known)
        seen, moved = self.bins > 0.0, self.driven > 0.0
        return PlantErrorBound(
            self.theta[seen],
            np.sqrt(np.where(moved, squared, math.inf))[seen],
            np.sqrt(np.where(moved, beyond, 0.0))[seen],
        )


def plant_error(fit: LoopFit, records: Sequence[LoopRecord]) -> PlantErrorBound:
    """The bound of a fit by the records given to it."""
    return band_powers(fit, records).bound()


def band_powers(fit: LoopFit, records: Sequence[LoopRecord]) -> BandPowers:
    """The powers of those of the records given to a fit that were fitted."""
    kept = fit.fitted(range(len(records)))
    longest = max(records[i].samples for i in kept)
    edges = _edges(longest)
    left, driven, noise, bins = (np.zeros(edges.size) for _ in range(4))
    for i in kept:
        one = _spectra(fit, records[i], i, edges)
        left, driven, noise, bins = left + one[0], driven + one[1], noise + one[2], bins + one[3]
    return BandPowers(edges, left, driven, noise, bins)


def _edges(samples: int) -> FloatArray:
    """Centres of the bands: as far apart as half their width, or as the records resolve.

    The last band ends at half the sampling rate. One that reached beyond it had so few bins that
    nothing was known of a loop there, whatever the records were.
    """
    resolved = 2.0 * math.pi / samples
    last = min(math.pi / (1.0 + HALF_WIDTH), math.pi - resolved)
    centres = [resolved]
    while centres[-1] < last:
        centres.append(centres[-1] + max(HALF_WIDTH * centres[-1], resolved))
    return np.array([*centres[:-1], last])


def _spectra(
    fit: LoopFit, record: LoopRecord, number: int, centres: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Power of what is left, of the effort and of the noise, and bins, in each band."""
    left, effort = fit.unexplained[number], record.effort
    if not fit.noise.is_white:
        H = shaping(fit.model.coordinates, fit.noise, fit.settling_samples)
        effort = whiten((effort - effort[0])[np.newaxis], H.zeros, H.poles)[0]
        left = fit.errors[number]
    start = int(np.argmax(left != 0.0))
    if record.at_rest:
        left = _without_jump(left, start, record.step_index)
    power = _step_power if record.at_rest else _service_power
    samples = left.size - start - 1 if record.at_rest else left.size - start
    (remaining, bins), (driven, _) = (
        _in_bands(power(signal[start:]), samples, centres) for signal in (left, effort)
    )
    return remaining, driven, fit.error_std**2 * bins, bins


def _in_bands(
    power: FloatArray, samples: int, centres: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Sum of the power at the bins of each band, and their number, shape (bands,) each."""
    theta = 2.0 * math.pi * np.arange(1, samples // 2) / samples
    half = np.maximum(HALF_WIDTH * centres, 1.01 * math.pi / samples)
    low, high = np.searchsorted(theta, centres - half), np.searchsorted(theta, centres + half)
    sums = np.concatenate([[0.0], np.cumsum(power)])
    return sums[high] - sums[low], (high - low).astype(float)


def _step_power(signal: FloatArray) -> FloatArray:
    """Power at each bin from the first on, of a signal that ends elsewhere than it begins.

    Its differences have no jump at the ends.
    """
    moves = np.diff(signal)
    theta = 2.0 * math.pi * np.arange(1, moves.size // 2) / moves.size
    weight = moves.size * np.abs(2.0 * np.sin(theta / 2.0)) ** 2
    return np.asarray(np.abs(np.fft.rfft(moves)[1 : theta.size + 1]) ** 2 / weight)


def _without_jump(left: FloatArray, start: int, moves: int) -> FloatArray:
    """What is left of a trial from rest, with its noise faded out at both ends.

    The noise of the first and the last sample is a jump: at the lowest frequency of 650 samples it
    has 33 times the power of the noise, and would pass for something unexplained.

    Args:
        left: What is left, shape (samples,).
        start: The first sample that is predicted.
        moves: The first sample at which the setpoint moves.
    """
    faded, last = left.copy(), max(left.size // 10, 2)
    at_rest = max(moves - start, 0)
    faded[start : start + at_rest] *= np.sin(np.linspace(0.0, math.pi / 2.0, at_rest)) ** 2
    end = float(faded[-last:].mean())
    faded[-last:] = (
        end + (faded[-last:] - end) * np.cos(np.linspace(0.0, math.pi / 2.0, last)) ** 2
    )
    return faded


def _service_power(signal: FloatArray) -> FloatArray:
    """Power at each bin from the first on, of a signal without a beginning or an end.

    A window takes off both: the differences of white noise have a jump there, whose power at low
    frequencies is far above that of the noise.
    """
    window = np.hanning(signal.size)
    spectrum = np.abs(np.fft.rfft((signal - signal.mean()) * window)) ** 2
    return np.asarray(spectrum[1 : signal.size // 2] / np.sum(window**2))


def error_margin(
    fit: LoopFit, error: PlantErrorBound, gains: Gains, settings: ControllerSettings
) -> ErrorMargin:
    """What a bound leaves of the robustness, and the unknown band, of a loop with these gains."""
    theta, controller, loop, stable = loop_response(fit.model, gains, settings)
    if not stable:
        return ErrorMargin(-math.inf, None)
    inside = theta >= error.theta[0]
    bound = np.interp(theta[inside], error.theta, error.bound)
    size = np.abs(1.0 + loop[inside])
    share = np.abs(controller[inside]) * bound / size
    least = float(np.min(size * (1.0 - share)))
    unknown = np.flatnonzero(share > UNKNOWN_FROM)
    if not unknown.size:
        return ErrorMargin(least, None)
    angles = theta[inside]
    left = np.interp(angles, error.theta, error.unexplained)
    ends = float(angles[unknown[0]]), float(angles[unknown[-1]])
    enough = np.abs(controller[inside]) * left > UNKNOWN_FROM * size
    excited = bool(np.any(enough & (left > MOST * bound)))
    return ErrorMargin(least, ends, excited)


def unknown_band(unknown: tuple[float, float], sampling_Hz: float) -> str:
    """A band of which nothing is known, by its ends in rad/sample, in words."""
    low, high = (theta * sampling_Hz / (2.0 * math.pi) for theta in unknown)
    if high > 0.45 * sampling_Hz:
        return f"above {low:.3g} Hz"
    return f"from {low:.3g} to {high:.3g} Hz" if high > 1.05 * low else f"about {low:.3g} Hz"


def _largest(bins: FloatArray) -> FloatArray:
    """Largest power of noise in any band, over its mean; shape (bands,).

    The power of a band is a chi-squared variable of two degrees of freedom for each bin.
    """
    from scipy.special import gammaincinv  # noqa: PLC0415  slow to import

    bands = 0.5 * max(int((bins > 0.0).sum()), 2)
    return np.asarray(gammaincinv(bins, 1.0 - CHANCE / bands) / bins)
