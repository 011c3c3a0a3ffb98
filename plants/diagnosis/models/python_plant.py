"""A Python function compared with records: gain of its input and offset of its output."""

from collections.abc import Sequence

from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.models.diagnosed_model import Local, Slot, of_calibration, positive
from plants.diagnosis.models.diagnosed_plant import DiagnosedPlant
from plants.effects import Effect
from plants.models.python_plant import PythonPlant
from plants.models.symbolic_plant import TracedStructure, trace


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
