"""Step 3: the noise that each sensor adds, which is the unit of all errors from here on."""

from plants.diagnosis.data.noise_floor import noise_floor as noise

__all__ = ["noise"]
