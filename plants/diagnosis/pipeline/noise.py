"""Step 3: the noise that each sensor adds, which is the unit of all errors from here on."""

from collections.abc import Sequence
from dataclasses import dataclass

from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import NoiseFloor, noise_floor
from plants.diagnosis.search.mains_interference import coarse_step_N


@dataclass(frozen=True, slots=True, eq=False)
class SensorNoise:
    """The noise of the sensors.

    Attributes:
        floor: Noise of each channel.
        coarse_step_N: Step of a gauge whose readings are rounded by more than its noise, or None.
    """

    floor: NoiseFloor
    coarse_step_N: float | None


def noise(measurements: Sequence[MeasuredRecord]) -> SensorNoise:
    """The noise of the sensors in some records of one rig."""
    floor = noise_floor(measurements)
    gauge = floor.channels.get("tension_N")
    return SensorNoise(floor, None if gauge is None else coarse_step_N(gauge))
