"""Predictions of many records at once, for many sets of parameters, compiled.

Each record is simulated once. At the start of each window the plant's state is reset to the
measured one, while the delayed commands, the gauge and the states of the effects go on: errors of
the instants at which friction sticks do not add up, and predictions over a horizon are compared
rather than a free run. The initial state of each window is projected out of its residual, for all
channels together.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput, PlantError
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import NoiseFloor
from plants.diagnosis.models.diagnosed_model import SENSORS, DiagnosedModel
from plants.diagnosis.models.free_parameters import CALIBRATION, Free, Slot
from plants.diagnosis.prediction.data import Index, PredictionData, prepare_data, with_window_sigma
from plants.diagnosis.prediction.library import CHANNELS, Library, Task, library
from plants.diagnosis.prediction.window_projection import WindowProjection
from plants.effects import Effect

__all__ = ["CHANNELS", "Index", "Prediction", "Predictor"]

RECORD_ARRAYS = (
    *("record_samples", "preload", "reading", "command", "windows", "window_at", "window_place"),
    *("measured", "source", "block_end", "record_blocks"),
)
"""Arrays of `PredictionData` that the C code reads, by the names of `Task`."""


class Prediction(NamedTuple):
    """Predicted channels of one record, shape (rows, samples); None where not predicted.

    Attributes:
        tension_N: Gauge reading; the output of a linear or a Python plant.
        angle_rad: Encoder reading, not rounded to its steps.
        reference_N: Tension outside the reel.
        current_A: Current of the drive, where one was measured.
    """

    tension_N: FloatArray | None
    angle_rad: FloatArray | None
    reference_N: FloatArray | None
    current_A: FloatArray | None


class Predictor:
    """One compiled structure, a model with effects, compared with measurements.

    May be used from several threads at once; calls of the compiled code release the interpreter's
    lock.

    Attributes:
        free: Free parameters: first the base model's and the records', then the effects'.
        start: Their initial values, shape (free,).
        index: Description of the entries of the residuals.
        horizon_s: Length of a window, or None for a free run.
    """

    def __init__(
        self,
        model: DiagnosedModel,
        effects: Sequence[type[Effect]],
        measurements: Sequence[MeasuredRecord],
        horizon_s: float | Literal["model"] | None = "model",
        floor: NoiseFloor | None = None,
    ) -> None:
        """Compiles the structure, or finds it compiled.

        Args:
            model: Made by `diagnosed`, for these measurements or more.
            effects: Effects added to the model.
            measurements: The records to predict.
            horizon_s: Length of the windows at whose starts the state is reset to the measured
                one; "model" suits the model and the data, None is a free run.
            floor: The noise; None estimates it.

        Raises:
            PlantError: an effect is not available on the model, or nothing can be compiled.
        """
        for effect in effects:
            reason = model.unavailable(effect)
            if reason:
                raise PlantError(f"{effect.name} is not available: {reason}")
        self._model = model
        compiled = library(model.structure(model.combined(effects)))
        self.horizon_s = model.suggested_horizon_s if horizon_s == "model" else horizon_s
        self._data, self._basis = _windowed(
            model, tuple(measurements), self.horizon_s, floor, compiled.placed
        )
        self._slots = _present_slots(model.slots(effects), model, self._data)
        sensors = _sensors(model)
        known = [model.parameters(effects, m) | sensors for m in self._data.measurements]
        self._runner = _Runner(compiled, self._data, known, self._slots)
        self.index: Index = self._data.index
        self.free: tuple[Free, ...] = tuple(slot.free for slot in self._slots)
        self.start: FloatArray = np.array([free.start for free in self.free])

    def predict(self, rows: FloatArray) -> list[Prediction]:
        """The channels of each measurement, for each row of values, shape (rows, free)."""
        outputs = np.empty((len(rows), len(CHANNELS) * self._data.command.size))
        self._runner.run(rows, outputs=outputs)
        last = np.cumsum(self._data.record_samples)[:-1]
        parts = np.split(outputs, len(CHANNELS) * last, axis=1)
        return [self._shown(m, p) for m, p in zip(self._data.measurements, parts, strict=True)]

    def _shown(self, m: MeasuredRecord, outputs: FloatArray) -> Prediction:
        """The channels of one record that the model predicts, or that were measured."""
        measured = m.measured_current_A(self._model.newtons_per_ampere) is not None
        known = {*self._model.outputs, *(("current_A",) if measured else ())}
        channels = np.split(outputs, len(CHANNELS), axis=1)
        columns = (c if n in known else None for n, c in zip(CHANNELS, channels, strict=True))
        return Prediction._make(columns)

    def residuals(self, rows: FloatArray, entries: NDArray[np.int64] | None = None) -> FloatArray:
        """(measured - predicted)/sigma_eff, the initial states of the windows projected out.

        A prediction that diverges, or is no number, counts as a million sigmas. Only the records
        that the entries belong to are simulated.

        Args:
            rows: Values, shape (rows, free).
            entries: Indices of the entries wanted; None is all.

        Returns:
            Shape (rows, entries).
        """
        every = np.arange(self.index.sigma.size)
        chosen = every if entries is None else np.ascontiguousarray(entries, np.int64)
        residuals = np.empty((len(rows), chosen.size))
        self._runner.run(rows, basis=self._basis, residuals=residuals, chosen=chosen)
        return residuals

    def linearise(
        self,
        values: FloatArray,
        only: NDArray[np.int64] | None = None,
        entries: NDArray[np.int64] | None = None,
        known: FloatArray | None = None,
        over: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Residuals, shape (entries,), and their derivative by the values, (entries, free).

        The derivative is a forward difference, all in one batch of predictions; parameters of
        single records that are of one kind are stepped together.

        Args:
            values: Shape (free,).
            only: Indices of the free parameters to differentiate by; None is all.
            entries: Indices of the entries wanted; None is all.
            known: The residuals there, if already computed.
            over: Least steps of the differences, shape (chosen,).
        """
        chosen = np.arange(len(self.free)) if only is None else np.asarray(only, np.int64)
        groups: dict[tuple[str, int | None], list[int]] = defaultdict(list)
        for place, n in enumerate(chosen.tolist()):
            slot = self._slots[n]
            alone = None if slot.record is not None else n
            groups[slot.column, alone].append(place)
        least = np.zeros(chosen.size) if over is None else over
        steps = np.array(
            [
                self._step(n, float(values[n]), wide)
                for n, wide in zip(chosen.tolist(), least.tolist(), strict=True)
            ]
        )
        rows = np.repeat(np.asarray(values, np.float64)[None], 1 + len(groups), axis=0)
        for row, places in zip(rows[1:], groups.values(), strict=True):
            row[chosen[places]] += steps[places]
        batch = self.residuals(rows if known is None else rows[1:], entries)
        residuals, changes = (batch[0], batch[1:]) if known is None else (known, batch)
        jacobian = np.zeros((chosen.size, batch.shape[1]))
        changes -= residuals
        # Of each record the entries, which are in ascending order.
        measurement = (
            self.index.measurement if entries is None else self.index.measurement[entries]
        )
        edges = np.searchsorted(measurement, np.arange(len(self._data.measurements) + 1)).tolist()
        for change, places in zip(changes, groups.values(), strict=True):
            for place in places:
                record = self._slots[chosen[place]].record
                if record is None:
                    np.divide(change, steps[place], out=jacobian[place])
                else:
                    entries_of = slice(edges[record], edges[record + 1])
                    jacobian[place, entries_of] = change[entries_of] / steps[place]
        return residuals, jacobian.T

    def values(self, row: FloatArray) -> dict[str, float]:
        """A row by the names of `free`."""
        return {free.name: float(value) for free, value in zip(self.free, row, strict=True)}

    def row(self, values: Mapping[str, float]) -> FloatArray:
        """The row of some values by name, the others at their start."""
        return np.array([values.get(free.name, free.start) for free in self.free])

    def _step(self, n: int, value: float, least: float) -> float:
        free = self.free[n]
        size = max(abs(value), abs(free.start)) or 1e-3 * (free.high - free.low)
        step = max(1e-6 * size, least)
        return -step if value + step > free.high else step


class _Runner:
    """A library with prediction data, and the values of all its parameters in every record."""

    def __init__(
        self,
        compiled: Library,
        of: PredictionData,
        records: Sequence[Mapping[str, float]],
        slots: Sequence[Slot],
    ) -> None:
        """Lays out the parameter table: columns of the library, parameters of each record."""
        self._library, self._data, columns = compiled, of, compiled.columns
        self._template = np.array([[known[name] for name in columns] for known in records])
        self._slots = [
            (columns[s.column], slice(None) if s.record is None else s.record, s.factor)
            for s in slots
        ]

    def run(
        self,
        rows: FloatArray,
        *,
        kick: FloatArray | None = None,
        basis: FloatArray | None = None,
        outputs: FloatArray | None = None,
        residuals: FloatArray | None = None,
        chosen: NDArray[np.int64] | None = None,
    ) -> None:
        """Fills the outputs, or the residuals of the chosen entries.

        Args:
            rows: Values, shape (rows, slots).
            kick: Steps of the initial states, shape (rows, placed).
            basis: What is projected out, shape (placed, entries).
            outputs: Filled with all channels, shape (rows, channels x samples).
            residuals: Filled, shape (rows, chosen).
            chosen: Entries, ascending.

        Raises:
            InvalidInput: the rows have another number of values.
        """
        of, weight, wanted = self._data, 1.0 / self._data.index.sigma, None
        if chosen is not None:
            wanted = np.zeros(len(of.measurements), np.bool_)
            wanted[of.index.measurement[chosen]] = True
        arrays = {name: getattr(of, name) for name in RECORD_ARRAYS} | {
            "table": self._table(rows),
            "kick": kick,
            "weight": weight,
            "wanted": wanted,
            "basis": basis,
            "outputs": outputs,
            "chosen": chosen,
            "residuals": residuals,
        }
        task = Task(
            rows=len(rows),
            records=len(of.measurements),
            samples=of.command.size,
            entries=of.index.sigma.size,
            kept=0 if chosen is None else chosen.size,
            **{name: None if a is None else a.ctypes.data for name, a in arrays.items()},
        )
        self._library.run(task)

    def _table(self, rows: FloatArray) -> FloatArray:
        """The parameters, shape (rows, records, columns)."""
        rows = np.asarray(rows, np.float64)
        if rows.ndim != 2 or rows.shape[1] != len(self._slots):
            raise InvalidInput(
                f"the values have shape {rows.shape}; give rows of {len(self._slots)} values"
            )
        table = np.repeat(self._template[None], len(rows), axis=0)
        for values, (column, records, factor) in zip(rows.T, self._slots, strict=True):
            wanted = values * factor
            table[:, records, column] = wanted[:, None] if records == slice(None) else wanted
        return table


def _present_slots(slots: list[Slot], model: DiagnosedModel, of: PredictionData) -> list[Slot]:
    """The slots of the records that are in the data, renumbered."""
    place = {id(m): n for n, m in enumerate(of.measurements)}
    kept = []
    for slot in slots:
        if slot.record is None:
            kept.append(slot)
            continue
        number = place.get(id(model.measurements[slot.record]))
        if number is not None:
            kept.append(slot._replace(record=number))
    return kept


@lru_cache(maxsize=16)
def _windowed(
    model: DiagnosedModel,
    measurements: tuple[MeasuredRecord, ...],
    horizon_s: float | None,
    floor: NoiseFloor | None,
    placed: int,
) -> tuple[PredictionData, FloatArray]:
    """The prediction data, and the basis of the initial states of their windows."""
    whole = prepare_data(model, measurements, horizon_s, floor, placed)
    if horizon_s is None:
        return whole, _basis(model, whole)
    windowed = with_window_sigma(whole, floor, _basis(model, whole))
    return windowed, _basis(model, windowed)


def _basis(model: DiagnosedModel, of: PredictionData) -> FloatArray:
    """Basis of the responses to initial states, window by window, orthonormal, (placed, entries).

    By the model without any effect: a drum that friction holds has no free response.
    """
    bare = library(model.structure((type(model.calibration),)))
    slots = _present_slots(model.base, model, of)
    slots = [s._replace(column=s.column.replace(CALIBRATION, "0")) for s in slots]
    calibration = {
        "delay_samples": 0.0,
        **{f"0.{n}": v for n, v in vars(model.calibration).items()},
    }
    known = [{**model.numbers(m), **calibration, **_sensors(model)} for m in of.measurements]
    # Steps are relative to the spread of the initial states over the windows.
    size = np.abs(of.window_place).max(axis=0, initial=0.0)
    spread = of.window_place.std(axis=0) if len(of.window_place) > 1 else np.zeros(bare.placed)
    wide = np.where(spread > 0.0, spread, size)
    kick = np.zeros((1 + bare.placed, bare.placed))
    kick[1:] = np.diag(1e-3 * np.where(wide > 0.0, wide, 1.0))
    rows = np.tile([slot.free.start for slot in slots], (len(kick), 1))
    every = np.arange(of.index.sigma.size)
    responses = np.empty((len(kick), every.size))
    _Runner(bare, of, known, slots).run(rows, kick=kick, residuals=responses, chosen=every)
    return WindowProjection(of.block_end).orthonormal(responses[1:] - responses[0])


def _sensors(model: DiagnosedModel) -> dict[str, float]:
    """Sensors without errors."""
    return dict.fromkeys(SENSORS, 0.0) | {"current_gain": model.drive_unit}
