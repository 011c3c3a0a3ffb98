"""A plant of one input and one output compared with records."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.models.diagnosed_model import (
    DiagnosedModel,
    Slot,
    either_way,
    of_calibration,
)
from plants.diagnosis.models.signal_scales import units
from plants.models.linear_signal_path import READINGS_PER_ANGLE


class DiagnosedPlant(DiagnosedModel):
    """A plant whose effects have units in which its signals are as large as a reel's."""

    def __init__(self, model: Any, measurements: Sequence[MeasuredRecord]) -> None:
        self.newtons_per_ampere = model.newtons_per_ampere
        if not model.effects:
            inputs = [self.command_N(m) for m in measurements]
            torque, angle = units(inputs, [m.tension_N for m in measurements])
            angle = math.copysign(angle, self.sense)
            model = replace(model, torque_unit=torque, angle_unit=angle)
        self.drive_unit = model.torque_unit / model.newtons_per_ampere
        self.reading_unit = model.angle_unit / READINGS_PER_ANGLE
        super().__init__(model, measurements)

    @property
    def sense(self) -> float:
        """Sign of the plant's gain at high frequency, which is where friction acts."""
        return 1.0

    def turned(self, measurement: MeasuredRecord) -> FloatArray:
        """The output as an angle."""
        output = measurement.tension_N
        return np.empty(0) if output is None else output / self.model.angle_unit

    def output_offset(self) -> Slot:
        """Offset of the output, which stands for that of the input, too."""
        start = self.calibration.gauge_offset_N * self.reading_unit
        outputs = [m.tension_N for m in self.measurements if m.tension_N is not None]
        reach = 2.0 * max(float(np.abs(y).max()) for y in outputs) + abs(start)
        free = either_way("output_offset", "", start, reach)
        return of_calibration(free, "gauge_offset_N", 1.0 / self.reading_unit)
