"""A short multisine on the setpoint that shows the plant where its step trials do not."""

import math

import numpy as np
from numpy.typing import NDArray

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import ComplexArray, FloatArray
from estune.errors import InvalidInput
from estune.loop_model.model import LoopModel, close_loop

SHARES = 25
"""Compromises between both limits that are compared."""

LINES_MIN = 8
"""Least number of lines of a multisine: with fewer a mode falls between them."""

HIGHEST = 0.95 * math.pi
"""Highest frequency, rad/sample: the controller acts up to half the sampling rate."""


def excitation(
    model: LoopModel,
    gains: Gains,
    settings: ControllerSettings,
    samples: int,
    *,
    effort_N: float,
    setpoint_N: float,
    band: tuple[float, float] | None = None,
) -> FloatArray:
    """What to add to the setpoint, N, shape (samples,), with mean zero.

    Its effort has the same amplitude at all lines of the band, as far as the limit of the setpoint
    allows: through the setpoint filter high frequencies need a larger setpoint. Gains with the
    least filter serve best; the stability of the loop does not depend on it.

    Args:
        model: The loop as far as it is known.
        gains: Gains of the trial, whose loop has to be stable.
        settings: The fixed part of the controller.
        samples: Length; the lines lie at multiples of one over it.
        effort_N: Largest deviation of the effort.
        setpoint_N: Largest deviation of the setpoint.
        band: Lowest and highest frequency, rad/sample; by default from half the frequency of the
            poles to `HIGHEST`.

    Raises:
        InvalidInput: a limit is not above zero, or the record is too short for the band.
    """
    if not (effort_N > 0.0 and setpoint_N > 0.0):
        raise InvalidInput(
            f"excitation of {effort_N:g} in effort and {setpoint_N:g} in setpoint; both must be "
            "above zero"
        )
    natural = 2.0 * math.pi / model.natural_period
    low, high = band or (0.5 * natural, HIGHEST)
    lines = np.arange(1, (samples + 1) // 2)
    theta = 2.0 * math.pi * lines / samples
    inside = (theta >= low) & (theta <= high)
    lines, theta = lines[inside], theta[inside]
    if lines.size < LINES_MIN:
        raise InvalidInput(
            f"{samples} samples hold {lines.size} lines of the band where {LINES_MIN} are needed; "
            "record longer"
        )
    to_effort = _setpoint_to_effort(model, gains, settings, theta)
    size, number = np.abs(to_effort), np.arange(lines.size)
    # Phases of Schroeder keep the sum low.
    phases = np.exp(-1j * math.pi * number * (number + 1) / lines.size)
    best, most = np.zeros(samples), 0.0
    # Flat in effort, but for lines that would need more setpoint than a share of the others.
    for share in np.geomspace(1.0, 1e-3, SHARES):
        amplitudes = phases / np.maximum(size, share * size.max())
        moves = _signal(lines, amplitudes, samples)
        efforts = _signal(lines, amplitudes * to_effort, samples)
        scale = min(effort_N / np.abs(efforts).max(), setpoint_N / np.abs(moves).max())
        typical = float(scale * np.median(np.abs(amplitudes * to_effort)))
        if typical > most:
            best, most = scale * moves, typical
    return best


def _setpoint_to_effort(
    model: LoopModel, gains: Gains, settings: ControllerSettings, theta: FloatArray
) -> ComplexArray:
    """From the setpoint before its filter to the effort, at angles in rad/sample."""
    loop, later = close_loop(model, gains, settings), np.exp(-1j * theta)
    filtered = np.polyval(loop.filter_numerator[::-1], later) / np.polyval(
        loop.filter_denominator[::-1], later
    )
    answer = np.polyval(loop.to_effort[::-1], later) / np.polyval(loop.characteristic[::-1], later)
    return np.asarray(filtered * answer)


def _signal(lines: NDArray[np.integer], amplitudes: ComplexArray, samples: int) -> FloatArray:
    spectrum = np.zeros(samples // 2 + 1, complex)
    spectrum[lines] = amplitudes
    return np.fft.irfft(spectrum, samples)
