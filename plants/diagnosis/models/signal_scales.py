"""Scale of the signals of some records: initial values of a fit have their size."""

import math
from collections.abc import Sequence

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.noise import step_of
from plants.effects import RecordScale


def signal_scale(
    currents: Sequence[FloatArray],
    torque_constant: float,
    angles: Sequence[FloatArray],
    rates_Hz: Sequence[float],
) -> RecordScale:
    """Sizes of some records' commands and angles; any angle may be missing."""
    moved = [current - current.mean() for current in currents]
    # Over spans so long that an encoder's steps do not make the velocity.
    each = ((*travels(a), rate) for a, rate in zip(angles, rates_Hz, strict=True) if a.size)
    velocities = [np.asarray(moved * (rate / span)) for moved, span, rate in each]
    speeds = np.abs(np.concatenate(velocities)) if velocities else np.empty(0)
    moving = speeds[speeds > 0.0]
    steps = [
        float(np.abs(np.diff(i)).max(initial=0.0)) * rate
        for i, rate in zip(currents, rates_Hz, strict=True)
    ]
    turned = max((float(np.ptp(angle)) for angle in angles if angle.size), default=0.0)
    return RecordScale(
        sample_s=1.0 / min(rates_Hz),
        record_s=max(i.size / rate for i, rate in zip(currents, rates_Hz, strict=True)),
        turn_periods=2.0 * math.pi / turned if turned > 0.0 else math.nan,
        torque_rms_Nm=abs(torque_constant) * _rms(moved),
        torque_max_Nm=abs(torque_constant) * _max(currents),
        angle_rms_rad=_rms([angle - angle.mean() for angle in angles if angle.size]),
        velocity_rms_rad_s=_rms(velocities),
        velocity_max_rad_s=_max(velocities),
        # Below it are the slowest of the moving samples.
        velocity_min_rad_s=float(np.quantile(moving, 0.02)) if moving.size else 0.0,
        current_rms_A=_rms(moved),
        current_max_A=_max(currents),
        current_rate_A_s=max(steps, default=0.0),
    )


def travels(angle: FloatArray) -> tuple[FloatArray, int]:
    """Travels over the shortest span in which they are well above the rounding of both ends.

    Returns:
        The travels from each sample on, rad, and the span, samples.
    """
    rounding, span = step_of(angle) / math.sqrt(6.0), 1  # of both ends
    while True:
        moved = angle[span:] - angle[:-span]
        if 2 * span >= angle.size or rounding <= CONSTANTS.quiet * _rms([moved]):
            return moved, span
        span *= 2


def _rms(signals: Sequence[FloatArray]) -> float:
    count = sum(signal.size for signal in signals)
    return math.sqrt(sum(float(signal @ signal) for signal in signals) / count) if count else 0.0


def _max(signals: Sequence[FloatArray]) -> float:
    return max((float(np.abs(signal).max(initial=0.0)) for signal in signals), default=0.0)


def units(
    inputs: Sequence[FloatArray], outputs: Sequence[FloatArray | None]
) -> tuple[float, float]:
    """Powers of ten in which signals are as large as a reel's.

    Returns:
        Input that stands for a newton metre, output that stands for a radian.
    """
    moved = [y - y.mean() for y in outputs if y is not None]
    return _above(_rms([u - u.mean() for u in inputs])), 10.0 * _above(_rms(moved))


def _above(value: float) -> float:
    """The power of ten at or next above a value."""
    return float(10.0 ** math.ceil(math.log10(value))) if value > 0.0 else 1.0
