"""Measurement per effort of a plant, by the record of a step: costs weigh the effort by it."""

import math

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.fitting import fit_loop
from estune.loop_model.margins import frequency_response
from estune.loop_model.records import LoopRecord
from estune.trial.profiles import StepProfile
from estune.trial.records import TrialRecord

BLOCKS = 20
"""Means by which the effort after the step is judged, without its noise."""

HELD = 0.2
"""Least share of the effort's root mean square that is left at the end of a plant that needs
effort to hold its measurement; an integrator needs none."""


def measured_effort_scale(
    record: TrialRecord, step: StepProfile, newtons_per_ampere: float, settling_time_s: float
) -> float:
    """Change of the measurement at rest per change of the effort.

    Of a plant that needs no effort to hold its measurement, such as an integrator, it is the size
    of its frequency response at the frequency 1/settling_time_s. One where nothing responds.
    """
    shape = step.shape(record.sampling_Hz)
    end = shape.load.sample if shape.load else record.tension_N.size
    effort, measurement = record.current_A * newtons_per_ampere, record.tension_N
    moved, answered = (
        _block_changes(signal[:end], shape.sample) for signal in (effort, measurement)
    )
    held = abs(float(moved[-1])) > HELD * float(np.sqrt(np.mean(moved**2)))
    if held and answered[-1] / moved[-1] > 0.0:
        return float(answered[-1] / moved[-1])
    signals = LoopRecord.of_step(
        effort[:end], measurement[:end], shape.size, shape.sample, record.gains
    )
    fit = fit_loop([signals], record.sampling_Hz, settling_time_s)
    theta = np.array([2.0 * math.pi / (settling_time_s * record.sampling_Hz)])
    scale = float(np.abs(frequency_response(fit.model, theta))[0])
    return scale if fit.responds and 0.0 < scale < math.inf else 1.0


def _block_changes(signal: FloatArray, index: int) -> FloatArray:
    """Means of a signal after the step less that before it, shape (up to BLOCKS,)."""
    after = np.array_split(signal[index:], min(BLOCKS, signal.size - index))
    means: FloatArray = np.array([block.mean() for block in after])
    return means - float(signal[: max(index, 1)].mean())
