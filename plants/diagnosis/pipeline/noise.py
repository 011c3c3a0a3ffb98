"""Step 3: the noise that each sensor adds, which is the unit of all errors from here on."""

from collections.abc import Sequence

from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import NoiseFloor, noise_floor


def noise(measurements: Sequence[MeasuredRecord]) -> NoiseFloor:
    """The noise of the sensors in some records of one rig."""
    return noise_floor(measurements)
