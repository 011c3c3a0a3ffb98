"""What a log shows of each cause, as numbers."""

import math
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.service_records.cause import margins, sensor
from estune.service_records.cause.loop_signals import (
    Controller,
    JudgedSignals,
    shown_controller,
    span,
    swing_length,
)
from estune.service_records.cause.outside import Jump, SpectralLine, jump, line
from estune.service_records.cause.predictors import ModelComparison, compare
from estune.service_records.cause.shapes import Shapes, shapes


class CauseEvidence(NamedTuple):
    """What a log shows.

    Attributes:
        predicted: The linear loop beside one whose actuator sticks.
        jump: The largest sudden change of the disturbance.
        sensitivity: Ms of the linear loop.
        room: Factor of the gains at which Ms is `margins.SENSITIVITY`.
        faults: What the sensor does that no plant can.
        numbers: Evidence in the order of `NAMES`.
    """

    signals: JudgedSignals
    controller: Controller
    predicted: ModelComparison
    shapes: Shapes
    line: SpectralLine
    jump: Jump
    sensitivity: float
    room: float
    faults: tuple[sensor.SensorLaw, ...]
    numbers: FloatArray

    @property
    def gain(self) -> float:
        """Log likelihood of what is left out that an actuator which sticks gains."""
        return GAIN * math.sinh(float(self.numbers[0]))


NAMES = (
    "gain", "without best", "informed", "slow", "curved", "moving", "offset", "together",
    "returns", "later", "line", "sharp", "line of error", "beside peak", "Ms", "room", "jump",
    "noise", "band", "least band", "blocks",
)  # fmt: skip

CLIP = (-6.0, 12.0)
"""Least and greatest gain in likelihood of one block of forty that counts: one setpoint step whose
model is a sample late would else outvote the rest of the log."""

GAIN = 8.0
"""Gain in log likelihood beyond which its logarithm counts."""

BEST = 3
"""Blocks that are left out of the gain once: a load step that looks like a slip is in as many."""

BETTER = 0.5
"""Gain in log likelihood by which one law foretells a block better than the other. A load step is
in two or three blocks of forty; an actuator that sticks shows in most of them, with swings of the
same shape whatever their size."""


def evidence(log: JudgedSignals) -> CauseEvidence:
    """The evidence of a log of at least 40 samples in which the output moves."""
    laws = (sensor.frozen(log), sensor.steps(log), sensor.spikes(log), sensor.noise(log))
    signals = log.thinned()
    controller = shown_controller(signals)
    sign = controller.sign
    predicted = compare(signals, sign)
    white = sensor.noise_deviation(signals.measurement)
    found = shapes(signals, sign, white)
    of_left, of_error = line(predicted.left), line(signals.error)
    Ms, factor = margins.sensitivity(predicted.linear, controller), 30.0
    if predicted.linear.gain:
        factor = margins.room(predicted.linear, controller)
    at_peak = margins.peak(predicted.linear, controller)
    length = max(1, round(swing_length(signals.output) / 8))
    sudden = jump(predicted.linear.errors, signals.setpoint, length)
    valve = predicted.sticking.valve
    band = valve.band / (span(signals.output) or 1.0) if valve else 1.0
    least = min((one.band for one in predicted.near), default=0.0) / (
        np.ptp(signals.output) or 1.0
    )
    gains = np.sort(np.clip(predicted.blocks, *CLIP))
    numbers = (
        math.asinh(float(gains.sum()) / GAIN),
        math.asinh(float(gains[:-BEST].sum()) / GAIN),
        math.asinh(predicted.informed / 20.0),
        predicted.slow,
        found.curved,
        found.moving,
        math.log(found.offset + 0.05),
        found.together,
        found.returns,
        found.later,
        of_left.share,
        of_left.sharpness,
        of_error.share,
        math.log(max(of_error.angle, 1e-6) / at_peak),
        math.log(Ms),
        math.log(factor),
        math.log1p(sudden.score),
        min(white / (float(np.std(signals.measurement)) or 1.0), 1.0),
        math.log(band + 1e-3),
        math.log(least + 1e-3),
        float(np.mean(predicted.blocks > BETTER) - np.mean(predicted.blocks < -BETTER)),
    )
    return CauseEvidence(
        signals,
        controller,
        predicted,
        found,
        of_left,
        sudden,
        Ms,
        factor,
        tuple(law for law in laws if law is not None),
        np.array(numbers),
    )
