"""A plant of one input and one output compared with records, as is a Python function."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.models.diagnosed_model import DiagnosedModel, Local
from plants.diagnosis.models.free_parameters import Slot, either_way, of_calibration, positive
from plants.diagnosis.models.signal_scales import units
from plants.effects import Effect
from plants.models.linear_signal_path import READINGS_PER_ANGLE
from plants.models.python_plant import PythonPlant
from plants.models.symbolic_plant import TracedStructure, trace


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


class DiagnosedFunction(DiagnosedPlant):
    """A `PythonPlant`. Its state is not observable: predictions are free runs."""

    model: PythonPlant
    placed_by = None
    suggested_horizon_s = None

    def __init__(self, model: PythonPlant, measurements: Sequence[MeasuredRecord]) -> None:
        whole = model.traced(())
        trace(whole.step, whole.shape)  # raises where it cannot be
        super().__init__(model, measurements)

    def unavailable(self, effect: type[Effect]) -> str | None:
        """Only input and output are accessible."""
        return self.model.unavailable(effect)

    def structure(self, effects: tuple[type[Effect], ...]) -> TracedStructure:
        """The function with these effects."""
        return self.model.traced(effects)

    def local(self, measurement: MeasuredRecord) -> Local:
        """Unknown: the state is the function's own."""
        raise NotImplementedError(f"nothing places a function in {measurement.name}")

    def _calibrations(self) -> list[Slot]:
        gain = positive("input_gain", "", self.calibration.torque_gain)
        return [of_calibration(gain, "torque_gain"), self.output_offset()]
