"""Free parameters of a model that is compared with records, and effects that may be added."""

import importlib
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput, PlantError
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.models.calibration import Calibration
from plants.diagnosis.models.free_parameters import (
    CALIBRATION,
    Free,
    Slot,
    either_way,
    informed,
    positive,
)
from plants.diagnosis.models.signal_scales import signal_scale
from plants.effects import Effect, Parameter, RecordScale, Role
from plants.models.linear_plant import LinearPlant
from plants.models.path_structure import PathStructure, squarings_for
from plants.models.symbolic_plant import TracedStructure

SENSORS = (
    *("angle_zero", "current_gain", "current_offset", "reference_offset"),
    *("input_slope", "input_before"),
)
"""Errors of the readings and the command of a record, in the order of the C code. The input slope
is the hold between samples: 0 for zero order, 1 for first order. The input before is what was
commanded before the record began, less its first command."""


class Local(NamedTuple):
    """Local linear model that estimates initial states from the samples around them.

    x' = A x + B (u + a constant), y = C x; u is delayed by the dead time.

    Attributes:
        A: Shape (n, n).
        B: Shape (n,).
        C: Shape (n,).
        input: The input u, shape (samples,), or None where it is left to the constant.
        dead_time_s: Of the input; negative where it leads.
        to_placed: From the states to the argument of `Equations.place`, shape (n, n).
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    input: FloatArray | None
    dead_time_s: float
    to_placed: FloatArray


def free_drum() -> Local:
    """Angle and velocity of unit inertia under a constant torque."""
    A = np.array([[0.0, 1.0], [0.0, 0.0]])
    return Local(A, np.array([0.0, 1.0]), np.array([1.0, 0.0]), None, 0.0, np.eye(2))


class DiagnosedModel(ABC):
    """A model that can be compared with records; made by `diagnosed`.

    Attributes:
        effects: Effects of the given model, without calibration; their parameters are free.
        output: Unit of prediction errors: that of the first output.
        sizes: Scale of the signals, in the units of the effects.
        placed_by: Channel that the initial states are estimated from, or None.
        newtons_per_ampere: Effort per command of an open-loop record.
        torque_per_drive: Torque, N m, per command of one `drive_unit`.
        drive_unit: Command, A, per unit of the actuator's effects.
        reading_unit: Output, as recorded, per newton of the gauge's effects.
    """

    output: Literal["N", "rad"] = "N"
    placed_by: str | None
    newtons_per_ampere: float = 1.0
    torque_per_drive: float = 1.0
    drive_unit: float = 1.0
    reading_unit: float = 1.0

    def __init__(self, model: Any, measurements: Sequence[MeasuredRecord]) -> None:
        self.model = model
        self.measurements = tuple(measurements)
        self.effects: tuple[Effect, ...] = tuple(
            e for e in getattr(model, "effects", ()) if not isinstance(e, Calibration)
        )
        self.calibration = next(
            (e for e in getattr(model, "effects", ()) if isinstance(e, Calibration)), Calibration()
        )
        commands = [m.command_A(self.newtons_per_ampere) for m in self.measurements]
        self.sizes = signal_scale(
            [command / self.drive_unit for command in commands],
            self.torque_per_drive,
            [self.turned(m) for m in self.measurements],
            [m.sampling_Hz for m in self.measurements],
        )
        self.sizes = self._with_readings(self.sizes)
        # Which depends on the sizes of torque and motion.
        window_s = self.suggested_horizon_s or self.sizes.record_s
        self.sizes = self.sizes._replace(window_s=window_s)

    # Declared by each kind of model.

    @abstractmethod
    def turned(self, measurement: MeasuredRecord) -> FloatArray:
        """The angle, measured or from the output, in the unit of the effects; may be empty."""

    @abstractmethod
    def _calibrations(self) -> list[Slot]:
        """The free base-model parameters; those that cannot be told are held."""

    @abstractmethod
    def structure(self, effects: tuple[type[Effect], ...]) -> PathStructure | TracedStructure:
        """The model with these effects and its calibration after them."""

    def numbers(self, measurement: MeasuredRecord) -> dict[str, float]:
        """The plant's own parameters at the record's rate."""
        return {**self.model.own_numbers, "sampling_Hz": measurement.sampling_Hz}

    @abstractmethod
    def local(self, measurement: MeasuredRecord) -> Local:
        """The local linear model."""

    @abstractmethod
    def unavailable(self, effect: type[Effect]) -> str | None:
        """Why an effect cannot be added to this model, or None where it can."""

    @property
    @abstractmethod
    def suggested_horizon_s(self) -> float | None:
        """Length of a prediction window that shows the model's dynamics, s; None is a free run."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Channels that the model predicts."""
        return ("tension_N",)

    def preload(self, measurement: MeasuredRecord) -> float:
        """The tension at which the plant's constants are taken, N."""
        return measurement.preload_N

    def sensors(self) -> list[Slot]:
        """Free numbers of the sensors, per record or shared."""
        return []

    # The same for all kinds.

    def _with_readings(self, sizes: RecordScale) -> RecordScale:
        read = [np.nanmax(m.tension_N) for m in self.measurements if m.tension_N is not None]
        most = float(np.max(read, initial=0.0)) / abs(self.reading_unit)
        numbers = [BaseNumbers.of(self.model, m) for m in self.measurements]
        softness = [1.0 / b.stiffness_N_m for b in numbers if b is not None and b.stiffness_N_m]
        lengths = [m.cable_length_m for m in self.measurements if m.cable_length_m]
        preloads = [m.preload_N for m in self.measurements if m.preload_N > 0.0]
        return sizes._replace(
            reading_max_N=most if most > 0.0 else math.nan,
            stretch_max_m=most * max(softness, default=math.nan),
            preload_N=float(np.median(preloads)) if preloads else math.nan,
            cable_length_m=float(np.median(lengths)) if lengths else math.nan,
        )

    def squarings(self, fastest_rad_s: float) -> int:
        """Squarings of a matrix exponential of such a rate; the same for most records."""
        slowest_Hz = min(m.sampling_Hz for m in self.measurements)
        return max(4, squarings_for(fastest_rad_s, slowest_Hz))

    def window_s(self, wanted_s: float, shortest_samples: int) -> float:
        """A window's length within a share of the shortest record, and above some samples."""
        longest_s = 0.2 * min(m.duration_s for m in self.measurements)
        rate_Hz = max(m.sampling_Hz for m in self.measurements)
        return max(min(wanted_s, longest_s), shortest_samples / rate_Hz)

    def calibrated(self, values: Mapping[str, float], effects: Sequence[type[Effect]] = ()) -> Any:
        """A model of the same kind as given, with the values of a fit and effects added.

        Args:
            values: By the names of `Predictor.free`; missing ones keep their values, those of
                single records are ignored.
            effects: The effects the fit added, in the predictor's order.
        """
        numbers = {name: values[name] for name in self.model.own_numbers if name in values}
        return replace(self.model, effects=self.built(values, effects), **numbers)

    @property
    def is_linear(self) -> bool:
        """Whether the balance of its motion is linear in what is measured."""
        return not self.effects

    @property
    def fuller(self) -> "DiagnosedModel | None":
        """The model with the law that its own is an approximation of, if records may show it."""
        return None

    def for_records(self, measurements: Sequence[MeasuredRecord]) -> "DiagnosedModel":
        """The same model, with the same laws, for other records."""
        effects = (*self.effects, self.calibration)
        return type(self)(replace(self.model, effects=effects), measurements)

    @cached_property
    def base(self) -> list[Slot]:
        """The base-model parameters with their initial values."""
        listed = [*self._calibrations(), *self.sensors(), *self._current_sensor()]
        known = dict(getattr(self.model, "uncertainty", ()))
        known.setdefault("drum_inertia_kg_m2", CONSTANTS.inertia_sd)
        return [s._replace(free=informed(s.free, known.get(s.free.name))) for s in listed]

    def slots(self, added: Sequence[type[Effect]]) -> list[Slot]:
        """All free parameters: of the base model, the records and the effects."""
        place, count = len(self.effects) + len(added), dict[str, int]()
        slots = [s._replace(column=s.column.replace(CALIBRATION, str(place))) for s in self.base]
        for n, (cls, effect) in enumerate(self._listed(added)):
            count[cls.name] = count.get(cls.name, 0) + 1
            slug = cls.name if count[cls.name] == 1 else f"{cls.name}#{count[cls.name]}"
            for name, p in cls.parameters().items():
                value = None if effect is None else float(getattr(effect, name))
                free = self._of_effect(cls, slug, name, p, value)
                slots.append(Slot(free, f"{n}.{name}"))
        return slots

    def command_N(self, measurement: MeasuredRecord) -> FloatArray:
        """The recorded command as effort, N, shape (samples,)."""
        amperes = measurement.command_A(self.newtons_per_ampere)
        return np.asarray(amperes * self.newtons_per_ampere, dtype=np.float64)

    def combined(self, added: Sequence[type[Effect]]) -> tuple[type[Effect], ...]:
        """Classes of the model's effects, of those added, and of the calibration."""
        return (*(type(e) for e in self.effects), *added, type(self.calibration))

    def parameters(
        self, added: Sequence[type[Effect]], measurement: MeasuredRecord
    ) -> dict[str, float]:
        """All parameters of the structure for one record but the samples of dead time."""
        values = dict(self.numbers(measurement))
        values["delay_samples"] = 0.0
        effects = self._listed(added)
        effects.append((type(self.calibration), self.calibration))
        for n, (cls, effect) in enumerate(effects):
            for name in cls.parameters():
                values[f"{n}.{name}"] = float(getattr(effect or cls(), name))
        return values

    def built(
        self, values: Mapping[str, float], added: Sequence[type[Effect]]
    ) -> tuple[Effect, ...]:
        """The model's effects, those added, and the calibration if it does something.

        All have the values of a fit.
        """
        by_column = {
            slot.column: slot.factor * values.get(slot.free.name, slot.free.start)
            for slot in self.slots(added)
        }
        listed = self._listed(added)
        effects = tuple(
            cls(**{name: by_column[f"{n}.{name}"] for name in cls.parameters()})
            for n, (cls, _) in enumerate(listed)
        )
        kept = vars(self.calibration).items()
        fields = {name: by_column.get(f"{len(listed)}.{name}", value) for name, value in kept}
        calibration = type(self.calibration)(**fields)
        return effects if calibration == Calibration.neutral() else (*effects, calibration)

    def _current_sensor(self) -> list[Slot]:
        per_ampere = self.newtons_per_ampere
        if all(m.measured_current_A(per_ampere) is None for m in self.measurements):
            return []
        reach = max(self.sizes.current_max_A, 1e-300) * self.drive_unit
        offset = either_way("current_offset_A", "A", 0.0, reach)
        return [
            Slot(positive("current_gain", "", 1.0), "current_gain", self.drive_unit),
            Slot(offset, "current_offset"),
        ]

    def _listed(self, added: Sequence[type[Effect]]) -> list[tuple[type[Effect], Effect | None]]:
        """The model's effects and the added ones, which have no values yet."""
        return [*((type(e), e) for e in self.effects), *((cls, None) for cls in added)]

    def _of_effect(
        self, cls: type[Effect], slug: str, name: str, p: Parameter, value: float | None
    ) -> Free:
        """An effect's parameter with the model's value, or one of the size of the data."""
        low, start, high = cls.range(name, self.sizes)
        if value is not None:
            low, start, high = min(low, value), value, max(high, value)
        # A limit does nothing from where a fit ends on.
        neutral = high if p.role is Role.LIMIT else p.neutral
        return Free(
            name=f"{slug}.{name}",
            unit=p.unit,
            start=start,
            low=low,
            high=high,
            scale="log" if low > 0.0 else "linear",
            owner=slug,
            neutral=neutral,
        )


def diagnosed(model: Any, measurements: Sequence[MeasuredRecord]) -> DiagnosedModel:
    """The model as the diagnosis uses it.

    Args:
        model: `Reel`, `UnloadedReel`, `LinearPlant`, `PythonPlant`, a continuous system of
            python-control, or a `DiagnosedModel` for the same measurements as it is.
        measurements: The records; they decide which parameters are identifiable.

    Raises:
        PlantError: the model is of another kind, or its function cannot be traced.
        InvalidInput: there are no measurements, or none has an output that the model predicts.
    """
    if isinstance(model, DiagnosedModel):
        return model
    if not measurements:
        raise InvalidInput("there are no records to compare the model with")
    reference = getattr(model, "diagnosed_by", "")
    if type(model).__name__ in ("TransferFunction", "StateSpace"):
        reference = LinearPlant.diagnosed_by
    if not reference:
        raise PlantError(
            f"the model is a {type(model).__name__}; give a model file, a plant that declares "
            "`diagnosed_by`, or a system of python-control"
        )
    module, _, kind = reference.partition(":")
    plant: DiagnosedModel = getattr(importlib.import_module(module), kind)(model, measurements)
    wanted = set(plant.outputs)
    if not any(wanted & set(m.outputs) for m in measurements):
        raise InvalidInput(
            f"the model predicts {' and '.join(plant.outputs)}, and no record has such a column"
        )
    return plant
