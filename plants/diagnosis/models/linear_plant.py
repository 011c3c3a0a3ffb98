"""A linear plant compared with records: gain, modes, time constants, offset of the output."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import expm

from estune.interop import linear_model, sampled_model
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import noise_floor
from plants.diagnosis.models.diagnosed_model import Local
from plants.diagnosis.models.diagnosed_plant import DiagnosedPlant
from plants.diagnosis.models.free_parameters import (
    CALIBRATION,
    Free,
    Slot,
    either_way,
    of_calibration,
    positive,
)
from plants.diagnosis.models.initial_states import shifted
from plants.effects import Effect, Port
from plants.models.effect_applicability import unavailable
from plants.models.linear_plant import LinearPlant, linear_plant
from plants.models.linear_with_effects import LinearEffectStructure
from plants.models.pole_zero_form import transfer_function


class DiagnosedLinear(DiagnosedPlant):
    """A `LinearPlant`, or a continuous system of python-control."""

    model: LinearPlant
    placed_by = "tension_N"

    def __init__(self, model: Any, measurements: Sequence[MeasuredRecord]) -> None:
        if not isinstance(model, LinearPlant):
            model = linear_plant(model, sampling_Hz=measurements[0].sampling_Hz)
        self.kinds, self.values = model.base, model.own_numbers  # raises where it is discrete
        super().__init__(model, measurements)

    @property
    def sense(self) -> float:
        """Sign of the plant's gain at high frequency, which is where friction acts."""
        times = ("time_constant", "zero_time_constant")
        signs = [np.sign(v) for k, v in self.values.items() if k.startswith(times) and v]
        return float(np.prod([self.values["gain"], *signs]))

    def unavailable(self, effect: type[Effect]) -> str | None:
        """Effects of the drum and the cable need an output that moves like a position."""
        return unavailable(self.kinds, effect)

    def structure(self, effects: tuple[type[Effect], ...]) -> LinearEffectStructure:
        """The plant with these effects."""
        rates = np.abs(np.linalg.eigvals(np.array(self._linear.A)))
        # The fastest pole may grow fourfold in a fit.
        n = self.squarings(4.0 * float(rates.max(initial=1e-9)))
        return LinearEffectStructure(
            self.kinds, effects, fractional=True, squarings=n, rounded=False
        )

    @property
    def _linear(self) -> Any:
        return self.model.model

    def _calibrations(self) -> list[Slot]:
        names = [name for name in self.kinds.own if name != "rate_rad_s"]
        slots = [Slot(_free(name, self.values[name]), name) for name in names]
        if "origin" in self.kinds.poles:  # where the output stands says nothing
            return [*slots, self.input_offset()]
        return [*slots, self.output_offset()]

    def slots(self, added: Sequence[type[Effect]]) -> list[Slot]:
        """The free parameters; beside a spring that bends, offsets of input and output differ."""
        slots = super().slots(added)
        laws = (*(type(effect) for effect in self.effects), *added)
        bends = any(law.port is Port.CABLE for law in laws)
        if not bends or "origin" in self.kinds.poles:
            return slots
        slot = self.input_offset()
        place = str(len(self.effects) + len(added))
        return [*slots, slot._replace(column=slot.column.replace(CALIBRATION, place))]

    def input_offset(self) -> Slot:
        """Offset of the input."""
        torque = self.model.torque_unit
        start = self.calibration.torque_offset_Nm * torque
        reach = torque * max(self.sizes.torque_max_Nm, 1e-300)
        free = either_way("input_offset", "", start, reach)
        return of_calibration(free, "torque_offset_Nm", 1.0 / torque)

    def sensors(self) -> list[Slot]:
        """What records do not state: the input's hold between samples, and the one before them.

        A record of a plant with a long dead time begins with the answer to what was commanded
        earlier: with the first command in its place a delay of a time constant left 4 noise floors
        instead of 1, in which a rate limit was found.
        """
        free = Free("input_slope", "", self._slope, 0.0, 1.0, "linear", "base")
        reach = 2.0 * self.sizes.current_max_A * self.model.torque_unit
        before = (
            either_way(f"input_before[{n}]", "", 0.0, reach, f"record {n}")
            for n in range(len(self.measurements))
        )
        return [
            Slot(free, "input_slope"),
            *(Slot(free, "input_before", record=n) for n, free in enumerate(before)),
        ]

    @cached_property
    def _slope(self) -> float:
        """1 where the output depends on the input of the same instant: no zero-order hold."""
        held, curved = (sum(self._left(m, newest) for m in self.measurements) for newest in (1, 0))
        # The newest input counts where it takes off more than a small share of the residual.
        return 1.0 if curved < (1.0 - CONSTANTS.small) * held else 0.0

    def _left(self, m: MeasuredRecord, newest: int) -> float:
        """Residual sum of squares of a difference equation; its newest input is `newest` back."""
        n, y = self.kinds.order, m.tension_N
        u = shifted(self.command_N(m), self.values["dead_time_s"] * m.sampling_Hz)
        if y is None or not np.isfinite(y).all():
            return 0.0
        past = [y[n - k : y.size - k] for k in range(1, n + 1)]
        past += [u[n - k : u.size - k] for k in range(newest, n + 1)]
        terms = np.column_stack([*past, np.ones(y.size - n)])
        answer = np.linalg.lstsq(terms, y[n:], rcond=None)[0]
        return float(np.sum((y[n:] - terms @ answer) ** 2))

    def local(self, measurement: MeasuredRecord) -> Local:
        """The plant with a constant input error."""
        n = self.kinds.order
        p = self.numbers(measurement)
        A, B, C = self.kinds.numeric(p)
        output = C * p["angle_unit"]
        # The states are the reading and its derivatives without input.
        rows = np.array([output @ np.linalg.matrix_power(A, k) for k in range(n)])
        u = self.command_N(measurement) / p["torque_unit"]
        # First-order hold leads zero-order hold by half a sample.
        lead_s = 0.5 * self._slope / measurement.sampling_Hz
        dead_time_s = p["dead_time_s"] - lead_s
        return Local(A, B, output, u, dead_time_s, rows)

    @cached_property
    def suggested_horizon_s(self) -> float:
        """A period of the plant, with enough samples."""
        wanted = float(2.0 * math.pi / self.values["rate_rad_s"])
        if "origin" in self.kinds.poles:
            ends = (self.window_s(end, 24) for end in (0.0, math.inf))
            wanted = min(wanted, self._travelling_s(*ends))
        return self.window_s(wanted, 24)

    def _travelling_s(self, shortest_s: float, longest_s: float) -> float:
        """Time in which a tenth of the input's rms moves the output well past its noise.

        Of the travel, a parabola, the initial state explains all but 1/12.
        """
        model, n = self._linear, self.kinds.order
        stepped = np.zeros((n + 1, n + 1))
        stepped[:n, :n], stepped[:n, n] = np.reshape(np.array(model.A), (n, n)), model.B
        step = 0.1 * self.sizes.torque_rms_Nm * self.model.torque_unit
        visible = 12.0 * CONSTANTS.travel * noise_floor(self.measurements).tension_N
        times = np.geomspace(shortest_s, max(longest_s, shortest_s), num=60)
        travels = step * np.abs(expm(times[:, None, None] * stepped)[:, :n, n] @ np.array(model.C))
        return float(times[min(int(np.searchsorted(travels, visible)), times.size - 1)])

    def calibrated(
        self, values: Mapping[str, float], effects: Sequence[type[Effect]] = ()
    ) -> LinearPlant:
        """The plant with these values; a `Calibration` holds the offset."""
        known = {**self.values, **values}
        # A controller holds its command: a lead is less dead time there.
        lead_s = 0.5 * known.get("input_slope", self._slope)
        lead_s /= self.measurements[0].sampling_Hz
        model = linear_model(
            transfer_function(self.kinds, {k: known[k] for k in self.kinds.own}),
            max(self.values["dead_time_s"] - lead_s, 0.0),
        )
        sampled = sampled_model(model, self.model.controller)
        return replace(
            self.model, model=model, sampled=sampled, effects=self.built(values, effects)
        )


def _free(name: str, value: float) -> Free:
    unit = "Hz" if name.endswith("_Hz") else "s" if name.endswith("_s") else ""
    if "damping" in name and value > 0.0:
        low = min(1e-5, value)
        return Free(name, unit, value, low, max(CONSTANTS.range * value, 2.0), "log", "base")
    if value > 0.0:
        return positive(name, unit, value)
    reach = (1.0 - 1.0 / CONSTANTS.range) * abs(value)
    return either_way(name, unit, value, reach if value else 1.0)
