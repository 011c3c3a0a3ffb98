"""A Python function compared with records: gain of its input and offset of its output."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.models.diagnosed_model import (
    CALIBRATION,
    DiagnosedModel,
    Local,
    Slot,
    either_way,
    positive,
)
from plants.diagnosis.models.signal_scales import plant_scale, units
from plants.effects import Effect, RecordScale
from plants.models.linear_signal_path import READINGS_PER_ANGLE
from plants.models.python_plant import PythonPlant
from plants.models.symbolic_plant import TracedStructure, trace


class DiagnosedFunction(DiagnosedModel):
    """A `PythonPlant`. Its state is not observable: predictions are free runs."""

    model: PythonPlant
    placed_by = None
    suggested_horizon_s = None

    def __init__(self, model: PythonPlant, measurements: Sequence[MeasuredRecord]) -> None:
        whole = model.traced(())
        trace(whole.step, whole.shape)  # raises where it cannot be
        self.newtons_per_ampere = model.newtons_per_ampere
        if not model.effects:
            inputs = [self.command_N(m) for m in measurements]
            torque, angle = units(inputs, [m.tension_N for m in measurements])
            model = replace(model, torque_unit=torque, angle_unit=angle)
        super().__init__(model, measurements)
        self.drive_unit = model.torque_unit / model.newtons_per_ampere
        self.reading_unit = model.angle_unit / READINGS_PER_ANGLE

    def unavailable(self, effect: type[Effect]) -> str | None:
        """Only input and output are accessible."""
        return self.model.unavailable(effect)

    def structure(self, effects: tuple[type[Effect], ...]) -> TracedStructure:
        """The function with these effects."""
        return self.model.traced(effects)

    def local(self, measurement: MeasuredRecord) -> Local:
        """Unknown: the state is the function's own."""
        raise NotImplementedError(f"nothing places a function in {measurement.name}")

    def _sizes(self) -> RecordScale:
        return plant_scale(self, self.model.torque_unit, self.model.angle_unit)

    def _calibrations(self) -> list[Slot]:
        start = self.calibration.gauge_offset_N * self.reading_unit
        outputs = [m.tension_N for m in self.measurements if m.tension_N is not None]
        reach = 2.0 * max(float(np.abs(y).max()) for y in outputs) + abs(start)
        self.reasons["input_offset"] = "an offset of the input looks like one of the output"
        return [
            Slot(
                positive("input_gain", "", self.calibration.torque_gain),
                f"{CALIBRATION}.torque_gain",
            ),
            Slot(
                either_way("output_offset", "", start, reach),
                f"{CALIBRATION}.gauge_offset_N",
                1.0 / self.reading_unit,
            ),
        ]

    def calibrated(
        self, values: Mapping[str, float], effects: Sequence[type[Effect]] = ()
    ) -> PythonPlant:
        """The function with these values; a `Calibration` holds gain and offset."""
        known = {**self._starts, **values}
        own, read = self.calibration, self.reading_unit
        built = self.all_effects(
            values,
            effects,
            torque_gain=known.get("input_gain", own.torque_gain),
            gauge_offset_N=known.get("output_offset", own.gauge_offset_N * read) / read,
        )
        return replace(self.model, effects=built)
