"""Force felt by a user at the end of a reel's cable: figures of a `ForceRecord`."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from estune.core.quantities import BoolArray, FloatArray
from estune.errors import InvalidInput
from plants.bench.felt_force.force_procedure import BenchPhase, ForceRecord, ForceTest

HALF_POWER = 1.0 / np.sqrt(2.0)

AFTER_TURN_S = 0.25
"""Time left out after each turn of the slow motion, s, in which the cable sticks at the eyelets.

At 30 mm/s the cable of the simulated bench has 10 % more tension after 0.01 s; the controller of
1.9 Hz bandwidth has settled after 0.25 s.
"""


@dataclass(frozen=True)
class FeltForce:
    """Figures of a reel at one constant command.

    Attributes:
        error_rms_N: Error of the felt force while the far end moves fast, rms.
        error_peak_N: Error exceeded in 1 % of that time.
        hysteresis_N: Felt force while the cable is pulled out minus that while it is wound in, at
            the slow speed.
        gauge_rms_N: Error of the tension at the reel's own gauge in the fast motion, rms: the part
            of the controller, without the eyelet.
        bandwidth_Hz: Frequency at which the felt force has half the power of the command; None
            if it has more at all frequencies tested.
        frequencies_Hz: Frequencies of the command's oscillation.
        ratio: Felt force over command at these, complex.
    """

    command_N: float
    error_rms_N: float
    error_peak_N: float
    hysteresis_N: float
    gauge_rms_N: float
    bandwidth_Hz: float | None
    frequencies_Hz: FloatArray
    ratio: FloatArray


SMOOTHED_SAMPLES = 21


def felt_force(record: ForceRecord, test: ForceTest, period_s: float) -> FeltForce:
    """Figures of a record.

    Raises:
        InvalidInput: the far end did not move, so that nothing is known.
    """
    hysteresis_N = _hysteresis_N(record.of(BenchPhase.SLOW))
    fast = record.of(BenchPhase.FAST)
    error = fast.felt_N - record.command_N
    wave = record.of(BenchPhase.COMMAND)
    frequencies = test.frequencies_Hz(test.command_Hz, period_s)
    felt, commanded = (
        _at_lines(wave, column, frequencies) for column in (wave.felt_N, wave.setpoint_N)
    )
    ratio = felt / commanded
    return FeltForce(
        command_N=record.command_N,
        error_rms_N=float(np.sqrt(np.mean(error**2))),
        error_peak_N=float(np.quantile(np.abs(error), 0.99)),
        hysteresis_N=hysteresis_N,
        gauge_rms_N=float(np.sqrt(np.mean((fast.tension_N - record.command_N) ** 2))),
        bandwidth_Hz=_bandwidth_Hz(frequencies, np.abs(ratio)),
        frequencies_Hz=frequencies,
        ratio=ratio,
    )


def _hysteresis_N(slow: ForceRecord) -> float:
    """Mean difference between both directions, over the middle half of the stroke.

    There the cable slides at a constant speed in both.
    """
    speed = np.gradient(slow.position_m, slow.time_s)
    low, high = np.quantile(slow.position_m, (0.25, 0.75))
    middle = (slow.position_m > low) & (slow.position_m < high)
    out, back = middle & (speed > 0.0), middle & (speed < 0.0)
    if not (out.any() and back.any()):
        raise InvalidInput(
            "the far end did not move back and forth during the test; move it, or name the rig "
            "that moves it"
        )
    return float(slow.felt_N[out].mean() - slow.felt_N[back].mean())


def _at_lines(record: ForceRecord, column: FloatArray, frequencies_Hz: FloatArray) -> FloatArray:
    """Complex amplitudes at frequencies, by least squares, as the samples need not be even.

    What changes with the direction of the motion, by the eyelet's friction, is fitted along.
    """
    slides, direction = _sliding(record)
    angle = 2.0 * np.pi * np.outer(record.time_s, frequencies_Hz)
    regressors = np.column_stack(
        [np.cos(angle), -np.sin(angle), direction, np.ones_like(direction)]
    )
    found = np.linalg.lstsq(regressors[slides], column[slides])[0]
    count = frequencies_Hz.size
    return np.asarray(found[:count] + 1j * found[count : 2 * count])


def _sliding(record: ForceRecord) -> tuple[BoolArray, FloatArray]:
    """Samples at which the cable slides through the eyelet, and the direction of the motion."""
    time_s = record.time_s
    # Over a tenth of a second, the speed of a noisy position has the sign of the motion.
    speed = np.gradient(uniform_filter1d(record.position_m, SMOOTHED_SAMPLES), time_s)
    direction = np.asarray(np.sign(speed), np.float64)
    turns = np.flatnonzero(np.diff(direction))
    after_s = time_s[:, None] - time_s[turns]
    turning = (after_s > -0.5 * AFTER_TURN_S) & (after_s < AFTER_TURN_S)
    return np.asarray(~turning.any(axis=1)), direction


def _bandwidth_Hz(frequencies_Hz: FloatArray, ratio: FloatArray) -> float | None:
    """First frequency from which the ratio is below half power, interpolated in its logarithm."""
    below = np.flatnonzero(ratio < HALF_POWER)
    if not below.size:
        return None
    n = int(below[0])
    if n == 0:
        return float(frequencies_Hz[0])
    share = (ratio[n - 1] - HALF_POWER) / (ratio[n - 1] - ratio[n])
    return float(frequencies_Hz[n - 1] ** (1.0 - share) * frequencies_Hz[n] ** share)
