"""Frequencies and periods suggested by the base model's residual, before any fit."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise import step_of
from plants.diagnosis.residual.angle_periods import ResidualOverAngle, per_turn
from plants.diagnosis.residual.localisation import Block, ResidualLocation
from plants.diagnosis.residual.residuals import of_usual_rate
from plants.diagnosis.search.model_fitter import ModelFitter
from plants.effects import RecordScale


def record_scale(
    fitter: ModelFitter, where: ResidualLocation, values: Mapping[str, float]
) -> RecordScale:
    """Scales of the machine in the records, and variables that the base residual follows."""
    return fitter.scale._replace(
        resonances_Hz=tuple(sorted({f for b in where.blocks for f in _spectral_peaks(b)})),
        periods_per_turn=tuple(_per_turn(fitter.measurements, where, values)),
    )


def _spectral_peaks(block: Block) -> list[float]:
    """The three frequencies at which a block's residual stands highest above its surroundings."""
    from scipy.ndimage import median_filter  # noqa: PLC0415  slow to import
    from scipy.signal import find_peaks  # noqa: PLC0415  slow to import

    power = np.maximum(block.power - block.noise_power, 0.0)
    if not power.any():
        return []
    around = median_filter(power, 17, mode="nearest")
    height = power / (around + 0.01 * power.max())
    peaks = [n for n in find_peaks(power)[0] if n > 1 and height[n] > 2.0]
    return [float(block.frequency_Hz[n]) for n in sorted(peaks, key=lambda n: -height[n])[:3]]


def _per_turn(
    measurements: Sequence[MeasuredRecord], where: ResidualLocation, values: Mapping[str, float]
) -> list[float]:
    block = next((b for b in where.blocks if b.name in ("force", "plant")), None)
    if block is None:
        return []
    common: list[ResidualOverAngle] = []
    turnings: list[ResidualOverAngle] = []
    read = 0.0
    # Spectra are of one grid: records of another sampling rate have no residual.
    for n, residual in zip(of_usual_rate(measurements), block.residual, strict=True):
        m, inside = measurements[n], np.isfinite(residual)
        if m.angle_rad is None or not inside.any():
            continue
        read = max(read, step_of(m.angle_rad))
        zero = values.get(f"encoder_zero_rad[{n}]")
        turning = ResidualOverAngle(m.angle_rad[inside] - (zero or 0.0), residual[inside])
        (turnings if zero is None else common).append(turning)
    if not common:
        return per_turn(turnings, read)
    joined = ResidualOverAngle(*map(np.concatenate, zip(*common, strict=True)))
    # Friction may hide a wave in the balance that predictions show.
    turned = float(np.ptp(joined.angle_rad))
    if not turned > 0.0:
        return per_turn(turnings, read)
    turn = 2.0 * math.pi / turned
    return [*per_turn([*turnings, joined], read), *(n * turn for n in (1.0, 1.5, 2.0, 3.0, 4.0))]
