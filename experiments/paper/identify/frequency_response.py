"""Frequency response of a reel from a record of a periodic excitation.

Each period is transformed separately. The response is the mean output over the mean input, its
variance is that between periods, and the output on unexcited lines is distortion (Pintelon &
Schoukens, System Identification, 2nd ed., chapters 2 to 4).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.trial import SATURATED, Outcome, TrialRecord
from experiments.paper.identify.distortion import HarmonicDistortion, measure_distortion
from experiments.paper.identify.excitation import BroadbandExcitation
from experiments.paper.identify.spectra import (
    ComplexArray,
    SegmentSpectra,
    check_settled,
    running_mean,
)

FOREIGN_INPUT = 0.05
"""Share of the recorded input that may differ from the excitation, as sensor noise."""
FLAT_TOP_samples = 4
"""Equal consecutive samples at the extreme that indicate a limit."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FrequencyResponse:
    """A measured frequency response; arrays have shape (lines,), ascending in frequency."""

    sampling_Hz: float  # sampling rate; the input was held between samples
    frequency_Hz: FloatArray  # excited lines
    response: ComplexArray  # output over input, complex
    # Mean square error of each response: noise, and odd distortion if significant.
    variance: FloatArray
    # Share of the output power on each line that is explained by the input, 0 to 1.
    coherence: FloatArray
    periods: int  # periods evaluated
    degrees: FloatArray  # degrees of freedom of the variance, for each line
    even: HarmonicDistortion | None  # even distortion, or None without unexcited even lines
    odd: HarmonicDistortion | None  # odd distortion, or None

    def __repr__(self) -> str:
        low, high = self.frequency_Hz[[0, -1]]
        return f"FrequencyResponse({self.frequency_Hz.size} lines, {low:.4g} to {high:.4g} Hz)"

    def radius(self, probability: float = 0.95) -> FloatArray:
        """Radius of the confidence circle about each response, shape (lines,)."""
        from scipy.special import fdtri  # noqa: PLC0415  slow to import

        check_probability(probability)
        return np.asarray(np.sqrt(self.variance * fdtri(2, self.degrees, probability)))

    def magnitude_band(self, probability: float = 0.95) -> tuple[FloatArray, FloatArray]:
        """Bounds of the magnitude within the confidence circles."""
        size, radius = np.abs(self.response), self.radius(probability)
        return np.maximum(size - radius, 0.0), size + radius

    def phase_band_deg(self, probability: float = 0.95) -> tuple[FloatArray, FloatArray]:
        """Bounds of the unwrapped phase; half a turn where noise dominates."""
        middle = np.degrees(np.unwrap(np.angle(self.response)))
        ratio = np.minimum(self.radius(probability) / np.abs(self.response), 1.0)
        half = np.where(ratio < 1.0, np.degrees(np.arcsin(ratio)), 180.0)
        return middle - half, middle + half


def response_of_record(record: TrialRecord, excitation: BroadbandExcitation) -> FrequencyResponse:
    """Response from motor current to tension of an open-loop record, N/A.

    Args:
        record: A record that starts with the excitation's first sample, settling included.
        excitation: The signal added to the preload.

    Raises:
        InvalidInput: the record is incomplete or in closed loop; or as `frequency_response`.
    """
    if record.outcome is not Outcome.DONE:
        raise InvalidInput(f"record {record.trial_id} is not complete: {record.outcome.sentence}")
    if record.loop != "open":
        raise InvalidInput(
            f"record {record.trial_id} is of a {record.loop} loop, whose input depends on the "
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
    excitation: BroadbandExcitation, input_signal: FloatArray, output_N: FloatArray
) -> FrequencyResponse:
    """The frequency response from an input to an output.

    Args:
        excitation: The excitation, from its first sample on.
        input_signal: The commanded or measured input, in any unit, shape (samples,).
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
        parts.append(SegmentSpectra.of(segment, u[stretch], y[stretch]))
        begin += segment.samples
    check_settled(excitation, parts)
    line_Hz = excitation.sampling_Hz / excitation.segments[0].period_N.size
    order = np.argsort(np.concatenate([part.excited for part in parts]))
    frequency = np.concatenate([part.excited for part in parts])[order] * line_Hz
    U, Y, variance, coherence = (
        np.concatenate([getattr(part, name) for part in parts])[order]
        for name in ("U", "Y", "variance", "coherence")
    )
    periods = parts[0].periods
    smooth, lines = running_mean(variance)
    even, odd = (measure_distortion(parts, kind, line_Hz) for kind in ("even", "odd"))
    error = smooth / periods
    if odd is not None and odd.detected:
        # Odd distortion is as large on the excited lines, and does not average out.
        excess, _ = running_mean(odd.output_N**2 - odd.noise_N**2)
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


def _checked(
    excitation: BroadbandExcitation, input_signal: FloatArray, output_N: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The signals, cut to the excitation's length, after all checks."""
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
    # The input may have another unit and an offset, but must otherwise be the excitation.
    expected = excitation.waveform_N - excitation.waveform_N.mean()
    actual = u - u.mean()
    scale = float(actual @ expected) / float(expected @ expected)
    foreign = float(np.linalg.norm(actual - scale * expected))
    if not foreign <= FOREIGN_INPUT * float(np.linalg.norm(actual)) or scale == 0.0:
        share = foreign / max(float(np.linalg.norm(actual)), 1e-300)
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
