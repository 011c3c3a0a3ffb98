"""A linear plant compared with records: gain, modes, time constants, offset of the output."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import expm

from estune.core.margins import sample_plant
from estune.interop import linear_model
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import noise_floor
from plants.diagnosis.models.diagnosed_model import (
    CALIBRATION,
    RANGE,
    DiagnosedModel,
    Free,
    Local,
    Slot,
    either_way,
    positive,
)
from plants.diagnosis.models.initial_states import shifted
from plants.diagnosis.models.signal_scales import plant_scale, units
from plants.effects import Effect, RecordScale
from plants.models.effect_applicability import unavailable
from plants.models.linear_plant import LinearPlant, linear_plant
from plants.models.linear_signal_path import READINGS_PER_ANGLE
from plants.models.linear_with_effects import LinearEffectStructure
from plants.models.path_structure import squarings_for
from plants.models.pole_zero_form import transfer_function

HORIZON = 5.0
"""A prediction's length times the geometric mean of the poles' rates."""
SHORTEST_samples, LONGEST_share = 24, 0.2
MOST_RATE = 4.0
"""Greatest growth of the fastest pole in a fit that keeps the matrix exponential exact."""
SHOWS = 30.0
"""Travel of an integrating plant in a window due to a tenth of the input, in times its noise."""
TIMES = 60
LEAST_DAMPING = 1e-5
RESIDUAL_RATIO = 0.8
"""Residual of a difference equation, relative to that without its newest input, that proves it."""
MEAN_LEAD_samples = 0.5
"""Mean lead of an input with first-order hold over one with zero-order hold."""
SAMPLES_PER_TERM = 20
"""Fewest samples of a record for each term of a difference equation."""


class DiagnosedLinear(DiagnosedModel):
    """A `LinearPlant`, or a continuous system of python-control."""

    model: LinearPlant
    placed_by = "tension_N"

    def __init__(self, model: Any, measurements: Sequence[MeasuredRecord]) -> None:
        if not isinstance(model, LinearPlant):
            model = linear_plant(model, sampling_Hz=measurements[0].sampling_Hz)
        self.kinds, self.values = model.base, model.own_numbers  # raises where it is discrete
        self.newtons_per_ampere = model.newtons_per_ampere
        if not model.effects:
            model = self._in_units(model, measurements)
        super().__init__(model, measurements)
        self.drive_unit = model.torque_unit / model.newtons_per_ampere
        self.reading_unit = model.angle_unit / READINGS_PER_ANGLE

    def _in_units(self, model: LinearPlant, measurements: Sequence[MeasuredRecord]) -> LinearPlant:
        """The plant with units in which its signals are as large as a reel's."""
        inputs = [self.command_N(m) for m in measurements]
        torque, angle = units(inputs, [m.tension_N for m in measurements])
        return replace(model, torque_unit=torque, angle_unit=math.copysign(angle, self._sense))

    @property
    def _sense(self) -> float:
        """Sign of the plant's gain at high frequency, which is where friction acts."""
        zeros = self.kinds.zeros
        product = self.values["gain"]
        for prefix, kinds in (("", self.kinds.poles), ("zero_", zeros)):
            if "real" in kinds:
                product *= math.prod(
                    math.copysign(1.0, v)
                    for k, v in self.values.items()
                    if k.startswith(f"{prefix}time_constant")
                )
        return float(product)

    def unavailable(self, effect: type[Effect]) -> str | None:
        """Effects of the drum and the cable need an output that moves like a position."""
        return unavailable(self.kinds, effect)

    def structure(self, effects: tuple[type[Effect], ...]) -> LinearEffectStructure:
        """The plant with these effects."""
        slowest_Hz = min(m.sampling_Hz for m in self.measurements)
        A = np.array(self._linear.A)
        fastest = MOST_RATE * float(np.abs(np.linalg.eigvals(A)).max(initial=1e-9))
        needed = squarings_for(fastest, slowest_Hz)
        return LinearEffectStructure(
            self.kinds, effects, fractional=True, squarings=max(4, needed), rounded=False
        )

    @property
    def _linear(self) -> Any:
        """The continuous model with the starts of the fit."""
        values = {k: self._starts.get(k, v) for k, v in self.values.items()}
        return linear_model(transfer_function(self.kinds, values), self.values["dead_time_s"])

    def _sizes(self) -> RecordScale:
        return plant_scale(self, self.model.torque_unit, self.model.angle_unit)

    def _calibrations(self) -> list[Slot]:
        slots = []
        for name in self.kinds.own:
            if name == "rate_rad_s":
                continue
            slots.append(Slot(_free(name, self.values[name]), name))
        start = self.calibration.gauge_offset_N * self.reading_unit
        if "origin" in self.kinds.poles:
            torque = self.model.torque_unit
            start = self.calibration.torque_offset_Nm * torque
            reach = torque * max(self.sizes.torque_max_Nm, 1e-12)
            free = either_way("input_offset", "", start, reach)
            slots.append(Slot(free, f"{CALIBRATION}.torque_offset_Nm", 1.0 / torque))
            self.reasons["output_offset"] = "a plant that integrates stands anywhere"
        else:
            outputs = [m.tension_N for m in self.measurements if m.tension_N is not None]
            reach = 2.0 * max(float(np.abs(y).max()) for y in outputs) + abs(start)
            free = either_way("output_offset", "", start, reach)
            slots.append(Slot(free, f"{CALIBRATION}.gauge_offset_N", 1.0 / self.reading_unit))
            self.reasons["input_offset"] = "an offset of the input looks like one of the output"
        return slots

    def sensors(self) -> list[Slot]:
        """Hold of the input between its samples, which records do not state."""
        free = Free("input_slope", "", self._slope, 0.0, 1.0, "linear", "base")
        return [Slot(free, "input_slope")]

    @cached_property
    def _slope(self) -> float:
        """1 where the output depends on the input of the same instant: no zero-order hold."""
        held, curved = (sum(self._left(m, newest) for m in self.measurements) for newest in (1, 0))
        return 1.0 if curved < RESIDUAL_RATIO * held else 0.0

    def _left(self, m: MeasuredRecord, newest: int) -> float:
        """Residual sum of squares of a difference equation; its newest input is `newest` back."""
        n, y = self.kinds.order, m.tension_N
        u = shifted(self.command_N(m), self.values["dead_time_s"] * m.sampling_Hz)
        if y is None or y.size < SAMPLES_PER_TERM * n or not np.isfinite(y).all():
            return 0.0
        past = [y[n - k : y.size - k] for k in range(1, n + 1)]
        past += [u[n - k : u.size - k] for k in range(newest, n + 1)]
        terms = np.column_stack([*past, np.ones(y.size - n)])
        answer = np.linalg.lstsq(terms, y[n:], rcond=None)[0]
        return float(np.sum((y[n:] - terms @ answer) ** 2))

    def local(self, measurement: MeasuredRecord) -> Local:
        """The plant with a constant input error."""
        n = self.kinds.order
        p = {k: self._starts.get(k, v) for k, v in self.numbers(measurement).items()}
        motion = self.kinds.numeric(p)
        A, B, C = motion
        # The states are the reading and its derivatives without input.
        rows, row = [], C * p["angle_unit"]
        for _ in range(n):
            rows.append(row)
            row = row @ A
        u = self.command_N(measurement) / p["torque_unit"]
        output = C * p["angle_unit"]
        lead = (
            MEAN_LEAD_samples
            * self._starts.get("input_slope", self._slope)
            / measurement.sampling_Hz
        )
        return Local(A, B, output, u, p["dead_time_s"] - lead, np.array(rows))

    @cached_property
    def suggested_horizon_s(self) -> float:
        """Most of a period of the plant, with enough samples."""
        rate = max(m.sampling_Hz for m in self.measurements)
        longest = LONGEST_share * min(m.duration_s for m in self.measurements)
        wanted = float(HORIZON / self.values["rate_rad_s"])
        if "origin" in self.kinds.poles:
            wanted = min(wanted, self._travelling_s(SHORTEST_samples / rate, longest))
        return max(min(wanted, longest), SHORTEST_samples / rate)

    def _travelling_s(self, shortest_s: float, longest_s: float) -> float:
        """Time in which a tenth of the input's rms moves the output well past its noise.

        Of the travel, a parabola, the initial state explains all but 1/12.
        """
        model, n = self._linear, self.kinds.order
        stepped = np.zeros((n + 1, n + 1))
        stepped[:n, :n], stepped[:n, n] = np.reshape(np.array(model.A), (n, n)), model.B
        step = 0.1 * self.sizes.torque_rms_Nm * self.model.torque_unit
        seen = 12.0 * SHOWS * noise_floor(self.measurements).tension_N
        times = np.geomspace(shortest_s, max(longest_s, shortest_s), TIMES)
        travels = step * np.abs(expm(times[:, None, None] * stepped)[:, :n, n] @ np.array(model.C))
        return float(times[min(int(np.searchsorted(travels, seen)), TIMES - 1)])

    def calibrated(
        self, values: Mapping[str, float], effects: Sequence[type[Effect]] = ()
    ) -> LinearPlant:
        """The plant with these values; a `Calibration` holds the offset."""
        known = {**self.values, **self._starts, **values}
        plant = self.model
        rate = plant.controller.sampling_Hz
        # A controller holds its command: a lead is less dead time there.
        lead_s = MEAN_LEAD_samples * known.get("input_slope", self._slope)
        lead_s /= self.measurements[0].sampling_Hz
        model = linear_model(
            transfer_function(self.kinds, {k: known[k] for k in self.kinds.own}),
            max(self.values["dead_time_s"] - lead_s, 0.0),
        )
        n = len(model.B)
        sampled = sample_plant(
            np.reshape(np.array(model.A), (n, n)),
            np.array(model.B),
            np.array(model.C),
            model.E,
            dead_time_s=model.dead_time_s,
            sample_s=1.0 / rate,
        )
        own, read, torque = self.calibration, self.reading_unit, plant.torque_unit
        built = self.all_effects(
            values,
            effects,
            gauge_offset_N=known.get("output_offset", own.gauge_offset_N * read) / read,
            torque_offset_Nm=known.get("input_offset", own.torque_offset_Nm * torque) / torque,
        )
        return replace(plant, model=model, sampled=sampled, effects=built)


def _free(name: str, value: float) -> Free:
    """A gain, mode or time constant."""
    unit = "Hz" if name.endswith("_Hz") else "s" if name.endswith("_s") else ""
    if "damping" in name and value > 0.0:
        low = min(LEAST_DAMPING, value)
        return Free(name, unit, value, low, max(RANGE * value, 2.0), "log", "base")
    if value > 0.0:
        return positive(name, unit, value)
    reach = (1.0 - 1.0 / RANGE) * abs(value)
    return either_way(name, unit, value, reach if value else 1.0)
