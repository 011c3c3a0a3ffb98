"""The frequency response of a reel from a record of a periodic excitation.

Each period is transformed by itself. The response is the mean answer over the mean input, its
variance comes from the scatter between periods, and what appears on lines that were not excited is
distortion (Pintelon & Schoukens, System Identification, 2nd ed., chapters 2 to 4).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.trial import SATURATED, Outcome, TrialRecord
from plants.identify.excitation import Excitation, Segment

ComplexArray = NDArray[np.complex128]

SMOOTHED_LINES = 11
"""Lines over which the noise level is averaged: it is taken as smooth, the response is not."""
FOREIGN_INPUT = 0.05
"""Share of the recorded input that may differ from the excitation: sensor noise, not limits."""
FLAT_TOP_samples = 4
"""So many equal samples in a row at the extreme, and it is a limit: noise would part them."""
DETECTED = 1e-3
"""Chance below which distortion is taken as there; all it does is to widen the band."""
NOT_SETTLED = 1e-6
"""Chance below which a record is refused as not settled: a sound one hardly ever is."""
NEGLIGIBLE = 1e-4
"""Share of the output by which the first period may always differ: it moves no estimate."""


class Distortion(NamedTuple):
    """What a nonlinear plant added on lines that were not excited.

    Attributes:
        frequency_Hz: Those lines, ascending, shape (lines,).
        output_N: Amplitude of the output on each, N.
        noise_N: What noise alone would leave there, rms of the amplitude, N.
        share: Root mean square of the output on these lines beyond the noise, relative to that on
            the excited ones; zero where noise explains it.
        chance: How likely noise alone would give as much.
    """

    frequency_Hz: FloatArray
    output_N: FloatArray
    noise_N: FloatArray
    share: float
    chance: float

    @property
    def detected(self) -> bool:
        """Whether there is distortion beyond what noise explains."""
        return self.chance < DETECTED


@dataclass(frozen=True, slots=True, eq=False)
class FrequencyResponse:
    """A measured frequency response; arrays have shape (lines,), ascending in frequency.

    Attributes:
        sampling_Hz: Sampling rate; the input was held between samples.
        frequency_Hz: Excited lines.
        response: Output over input, complex.
        variance: Mean square error of each response: noise, and odd distortion where detected.
        coherence: Share of the output's power in each line that the input explains, 0 to 1.
        periods: Periods evaluated.
        degrees: Degrees of freedom of the variance, for each line.
        even: Even distortion, or None where the excitation has no lines for it.
        odd: Odd distortion, or None.
    """

    sampling_Hz: float
    frequency_Hz: FloatArray
    response: ComplexArray
    variance: FloatArray
    coherence: FloatArray
    periods: int
    degrees: FloatArray
    even: Distortion | None
    odd: Distortion | None

    def radius(self, probability: float = 0.95) -> FloatArray:
        """Radius of the circle about each response that holds the true one, shape (lines,).

        Raises:
            InvalidInput: the probability is not between 0 and 1.
        """
        from scipy.stats import f  # noqa: PLC0415  slow to import

        check_probability(probability)
        return np.asarray(np.sqrt(self.variance * f.ppf(probability, 2, self.degrees)))

    def magnitude_band(self, probability: float = 0.95) -> tuple[FloatArray, FloatArray]:
        """Least and greatest magnitude inside the circle of each line."""
        size, radius = np.abs(self.response), self.radius(probability)
        return np.maximum(size - radius, 0.0), size + radius

    def phase_band_deg(self, probability: float = 0.95) -> tuple[FloatArray, FloatArray]:
        """Least and greatest phase, unwrapped along frequency; half a turn where noise rules."""
        middle = np.degrees(np.unwrap(np.angle(self.response)))
        ratio = np.minimum(self.radius(probability) / np.abs(self.response), 1.0)
        half = np.where(ratio < 1.0, np.degrees(np.arcsin(ratio)), 180.0)
        return middle - half, middle + half


def response_of_record(record: TrialRecord, excitation: Excitation) -> FrequencyResponse:
    """The response from motor current to tension, N/A, of an open-loop record.

    Args:
        record: It starts with the excitation's first sample, settling included.
        excitation: What was added to the preload.

    Raises:
        InvalidInput: the record is not one done in open loop, or see `frequency_response`.
    """
    if record.outcome is not Outcome.DONE:
        raise InvalidInput(f"record {record.trial_id} is not complete: {record.outcome.sentence}")
    if record.loop != "open":
        raise InvalidInput(
            f"record {record.trial_id} is of a {record.loop} loop, whose input answers to the "
            "noise; run the excitation in open loop"
        )
    if abs(record.sampling_Hz / excitation.sampling_Hz - 1.0) > 1e-9:
        raise InvalidInput(
            f"record {record.trial_id} is sampled at {record.sampling_Hz:g} Hz, the excitation at "
            f"{excitation.sampling_Hz:g} Hz; make the excitation at the rig's rate"
        )
    limited = int(np.count_nonzero(record.flags & SATURATED))
    if limited:
        raise InvalidInput(
            f"the current was limited in {limited} of {record.flags.size} samples of record "
            f"{record.trial_id}; lower the excitation's peak"
        )
    return frequency_response(excitation, record.current_A, record.tension_N)


def frequency_response(
    excitation: Excitation, input_signal: FloatArray, output_N: FloatArray
) -> FrequencyResponse:
    """The frequency response from an input to an output.

    Args:
        excitation: What was run, from its first sample on.
        input_signal: The input as commanded or measured, in any unit, shape (samples,).
        output_N: The output, shape (samples,), N.

    Returns:
        The response on the excited lines, in N per unit of the input.

    Raises:
        InvalidInput: a value is not finite, the signals are too short, the input is not the
            excitation, the output is clipped, or the plant has not settled.
    """
    u, y = _checked(excitation, input_signal, output_N)
    parts, begin = [], 0
    for segment in excitation.segments:
        stretch = slice(begin, begin + segment.samples)
        parts.append(_Segment.of(segment, u[stretch], y[stretch]))
        begin += segment.samples
    _check_settled(excitation, parts)
    line_Hz = excitation.sampling_Hz / excitation.segments[0].period_N.size
    order = np.argsort(np.concatenate([part.excited for part in parts]))
    frequency = np.concatenate([part.excited for part in parts])[order] * line_Hz
    U, Y, scatter, coherence = (
        np.concatenate([getattr(part, name) for part in parts])[order]
        for name in ("U", "Y", "scatter", "coherence")
    )
    periods = parts[0].periods
    smooth, lines = _smoothed(scatter)
    even, odd = (_distortion(parts, kind, line_Hz) for kind in ("even", "odd"))
    error = smooth / periods
    if odd is not None and odd.detected:
        # It acts on the excited lines as on those beside them, and does not average out.
        excess, _ = _smoothed(odd.output_N**2 - odd.noise_N**2)
        error = error + np.interp(frequency, odd.frequency_Hz, np.maximum(excess, 0.0))
    return FrequencyResponse(
        sampling_Hz=excitation.sampling_Hz,
        frequency_Hz=frequency,
        response=Y / U,
        variance=error / np.abs(U) ** 2,
        coherence=coherence,
        periods=periods,
        degrees=2.0 * (periods - 1) * lines,
        even=even,
        odd=odd,
    )


def check_probability(probability: float) -> None:
    """Refuses what is not a probability of an interval.

    Raises:
        InvalidInput: it is not between 0 and 1.
    """
    if not 0.0 < probability < 1.0:
        raise InvalidInput(f"probability is {probability}; it must lie between 0 and 1, as 0.95")


class _Segment(NamedTuple):
    """The periods of one segment, transformed; amplitudes, so that a sine of 1 N reads 1 N."""

    segment: Segment
    excited: NDArray[np.int64]
    U: ComplexArray
    Y: ComplexArray
    scatter: FloatArray  # mean square of one period's error on the excited lines
    coherence: FloatArray
    spectra: ComplexArray  # output of each period, all lines, shape (periods, lines)

    @property
    def periods(self) -> int:
        """Periods evaluated."""
        return len(self.spectra)

    @classmethod
    def of(cls, segment: Segment, u: FloatArray, y: FloatArray) -> "_Segment":
        samples = segment.period_N.size
        start = segment.settling_periods * samples
        inputs, outputs = (
            2.0 / samples * np.fft.rfft(signal[start:].reshape(-1, samples), axis=1)
            for signal in (u, y)
        )
        lines = segment.excited
        U, Y = inputs[:, lines], outputs[:, lines]
        U_mean, Y_mean = U.mean(axis=0), Y.mean(axis=0)
        # Noise on a measured input counts too: the error is that of Y - G U.
        error = Y - Y_mean - Y_mean / U_mean * (U - U_mean)
        power = _power(U) * _power(Y)
        together = np.abs((Y * U.conj()).mean(axis=0)) ** 2
        coherence = np.divide(together, power, out=np.zeros_like(power), where=power > 0.0)
        scatter = np.sum(np.abs(error) ** 2, axis=0) / (segment.periods - 1)
        return cls(segment, lines, U_mean, Y_mean, scatter, coherence, outputs)


def _power(spectra: ComplexArray) -> FloatArray:
    return np.asarray(np.mean(np.abs(spectra) ** 2, axis=0))


def _smoothed(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Running mean over neighbouring lines, and over how many."""
    width = min(SMOOTHED_LINES, values.size)
    window = np.ones(width)
    lines = np.convolve(np.ones(values.size), window, "same")
    return np.convolve(values, window, "same") / lines, lines


def _distortion(parts: list[_Segment], kind: str, line_Hz: float) -> Distortion | None:
    """What the lines that were left free for even or odd distortion show."""
    from scipy.stats import f  # noqa: PLC0415  slow to import

    free = [getattr(part.segment, kind) for part in parts]
    if not any(lines.size for lines in free):
        return None
    spectra = np.concatenate([p.spectra[:, at] for p, at in zip(parts, free, strict=True)], axis=1)
    mean, periods = spectra.mean(axis=0), len(spectra)
    noise = np.sum(np.abs(spectra - mean) ** 2, axis=0) / (periods - 1) / periods
    power, floor, n = float(np.sum(np.abs(mean) ** 2)), float(noise.sum()), mean.size
    excited = np.concatenate([part.Y for part in parts])
    level = math.sqrt(max(0.0, power - floor) / n / float(np.mean(np.abs(excited) ** 2)))
    # Without any scatter, as in a simulation without noise, what is above rounding is there.
    rounding = n * float(np.abs(excited).max() * 1e-12) ** 2
    if floor > rounding:
        chance = float(f.sf(power / floor, 2 * n, 2 * n * (periods - 1)))
    else:
        chance = 0.0 if power > rounding else 1.0
    order = np.argsort(np.concatenate(free), kind="stable")
    return Distortion(
        np.concatenate(free)[order] * line_Hz,
        np.abs(mean)[order],
        np.sqrt(noise)[order],
        level,
        chance,
    )


def _checked(
    excitation: Excitation, input_signal: FloatArray, output_N: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The signals, cut to the excitation's length.

    Raises:
        InvalidInput: they cannot be evaluated.
    """
    u, y = (np.asarray(signal, dtype=np.float64) for signal in (input_signal, output_N))
    samples = excitation.waveform_N.size
    for what, signal in (("input", u), ("output", y)):
        if signal.ndim != 1 or signal.size < samples:
            raise InvalidInput(
                f"{what} has shape {signal.shape}; the excitation of {excitation.duration_s:g} s "
                f"asks for {samples} samples: record all of it, or make one with fewer periods"
            )
        bad = np.flatnonzero(~np.isfinite(signal[:samples]))
        if bad.size:
            raise InvalidInput(
                f"{what} sample {bad[0]} is {signal[bad[0]]}; repeat the record without the gap"
            )
    u, y = u[:samples], y[:samples]
    # The input may be in another unit and about a preload, but else has to be the excitation.
    wanted = excitation.waveform_N - excitation.waveform_N.mean()
    found = u - u.mean()
    scale = float(found @ wanted) / float(wanted @ wanted)
    foreign = float(np.linalg.norm(found - scale * wanted))
    if not foreign <= FOREIGN_INPUT * float(np.linalg.norm(found)) or scale == 0.0:
        share = foreign / max(float(np.linalg.norm(found)), 1e-300)
        raise InvalidInput(
            f"{100.0 * share:.3g} % of the recorded input is not the excitation (at most "
            f"{100.0 * FOREIGN_INPUT:g} %): it was limited, shifted, or another one; lower the "
            "peak, or give the excitation that was run from its first sample"
        )
    for what, level in (("greatest", y.max()), ("least", y.min())):
        longest = _longest_run(y == level)
        if longest >= FLAT_TOP_samples:
            raise InvalidInput(
                f"output stays at its {what} value of {level:.6g} N for {longest} samples: the "
                "gauge is clipped, the cable slack, or nothing moves; lower the peak or change "
                "the preload"
            )
    return u, y


def _longest_run(same: NDArray[np.bool_]) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    return int((edges[1::2] - edges[::2]).max())


def _check_settled(excitation: Excitation, parts: list[_Segment]) -> None:
    """Compares the first period with the others.

    Raises:
        InvalidInput: the first differs from the others by more than they do among themselves.
    """
    from scipy.stats import f  # noqa: PLC0415  slow to import

    periods = parts[0].periods
    if periods < 3:
        return
    spectra = np.concatenate([part.spectra[:, part.excited] for part in parts], axis=1)
    rest = spectra[1:].mean(axis=0)
    among = float(np.sum(np.abs(spectra[1:] - rest) ** 2)) / (periods - 2)
    first = float(np.sum(np.abs(spectra[0] - rest) ** 2)) * (periods - 1) / periods
    n = spectra.shape[1]
    size = float(np.sum(np.abs(rest) ** 2))
    if first <= NEGLIGIBLE**2 * size:  # without noise, anything would stand out
        return
    if among == 0.0 or f.sf(first / among, 2 * n, 2 * n * (periods - 2)) < NOT_SETTLED:
        share = 100.0 * math.sqrt((first - among) / size)
        raise InvalidInput(
            f"the first evaluated period differs from the later ones by {share:.2g} % of the "
            f"output: not settled after {excitation.segments[0].settling_periods} periods; give "
            "more settling periods"
        )
