"""A Python function as a plant, run sample by sample with the controller of the rig."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from estune.core import pidf
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray, check_not_negative, check_positive
from estune.errors import PlantError
from estune.trial import SATURATED, RigDescription, RigLimits
from estune.trial.description import UNLIMITED_N
from estune.trial.profiles import StepProfile
from plants.effects import Effect
from plants.models.mounting import MountedModel, Mounting, unit_step, wide_limits
from plants.models.start_gains import identified_gains
from plants.models.state_shape import StateShape
from plants.models.symbolic_plant import TracedStructure, unavailable
from plants.simulation.plant import Columns, TrialSetpoint, split_dead_time

Step = Callable[[Any, float, float], tuple[Any, float]]
"""(state, effort in N, time step in s) -> (next state, measurement in N at its end)."""


@dataclass(frozen=True, repr=False)
class PythonPlant(MountedModel):
    """A plant given as a function; made by `python_plant`.

    Effects act on its input and output; the function is then traced with symbols, see
    `plants.models.symbolic_plant`.

    Attributes:
        mounting: Controller, suggested step, limits and noise.
        step: The function.
        initial_state: State at the start of a trial; each trial gets a copy.
        initial_effort_N: Effort of the controller at the start, and during the dead time.
        initial_measurement_N: Measurement at the start.
        dead_time_s: Delay of the effort, s.
        torque_unit: Input that is one newton metre, or ampere, of the effects.
        angle_unit: Output that is one radian of the effects.

    Raises:
        PlantError: an effect cannot be added, or the function cannot be traced.
    """

    mounting: Mounting
    step: Step
    initial_state: Any
    initial_effort_N: float
    initial_measurement_N: float
    dead_time_s: float
    torque_unit: float = 1.0
    angle_unit: float = 1.0

    diagnosed_by = "plants.diagnosis.models.diagnosed_plant:DiagnosedFunction"

    def __post_init__(self) -> None:
        for effect in self.effects:
            reason = self.unavailable(type(effect))
            if reason:
                raise PlantError(f"{effect.name} cannot be added to a Python plant: {reason}")

    def unavailable(self, effect: type[Effect]) -> str | None:
        """Reason why an effect cannot be added to the plant; None where it can.

        Raises:
            PlantError: the function cannot be traced.
        """
        return unavailable(self.traced((effect,)))

    def traced(self, effects: tuple[type[Effect], ...]) -> TracedStructure:
        """Structure of the plant's equations with these effects.

        Raises:
            PlantError: the function cannot be traced.
        """
        return TracedStructure(self.step, StateShape.of(self.initial_state), effects)

    @property
    def own_numbers(self) -> dict[str, float]:
        flat = StateShape.of(self.initial_state).flatten(self.initial_state)
        return {
            "sampling_Hz": self.controller.sampling_Hz,
            "dead_time_s": self.dead_time_s,
            "torque_unit": self.torque_unit,
            "angle_unit": self.angle_unit,
            "initial_effort": self.initial_effort_N,
            "initial_output": self.initial_measurement_N,
        } | {f"initial.{n}": float(value) for n, value in enumerate(flat)}

    def summary(self) -> str:
        """The function's name and the sampling rate."""
        name = getattr(self.step, "__qualname__", type(self.step).__name__)
        return f"{name}, {self.controller.sampling_Hz:g} Hz"

    @cached_property
    def structure(self) -> TracedStructure:
        """Structure of the equations.

        Raises:
            PlantError: the function cannot be traced.
        """
        return self.traced(self.kinds)

    def respond(
        self,
        coefficients: FloatArray,
        drive: TrialSetpoint,
        noise_N: FloatArray | None,
        bound_N: float,
    ) -> Columns:
        if self.effects:
            return super().respond(coefficients, drive, noise_N, bound_N)
        samples = len(drive.setpoint_N)
        columns = Columns.empty(len(coefficients), samples)
        for n, row in enumerate(coefficients):
            noise = np.zeros(samples) if noise_N is None else noise_N[n]
            one = columns.trial(n)
            columns.ended[n] = self._trial(
                pidf.Coefficients(*row.tolist()), drive, noise, bound_N, one
            )
        return columns

    def _trial(
        self,
        coefficients: pidf.Coefficients,
        drive: TrialSetpoint,
        noise: FloatArray,
        bound_N: float,
        columns: Columns,
    ) -> int:
        """Runs the loop of `trial_loop.c` around the function; returns its end index."""
        h = coefficients.sample_s
        delay, fraction = split_dead_time(self.dead_time_s, self.controller.sampling_Hz)
        ring = [self.initial_effort_N] * (delay + 2)
        memory = pidf.state_at_rest(self.initial_measurement_N, self.initial_effort_N)
        state, y = copy.deepcopy(self.initial_state), self.initial_measurement_N
        load = [0.0] * len(drive.setpoint_N) if drive.load_N is None else drive.load_N.tolist()
        for k, r in enumerate(drive.setpoint_N.tolist()):
            measured = y + float(noise[k])
            memory, effort, excess = pidf.step(coefficients, memory, r, measured)
            if drive.open_loop:
                effort, excess = pidf.limit_effort(coefficients, r)
            columns.tension_N[k], columns.effort_N[k], columns.angle_rad[k] = measured, effort, 0.0
            if not -bound_N <= measured <= bound_N:
                return k
            columns.flags[k] = SATURATED if excess else 0
            ring[(k + delay + 1) % (delay + 2)] = float(effort) + load[k]
            before, after = ring[k % (delay + 2)], ring[(k + 1) % (delay + 2)]
            if fraction:
                state, y = self._call(state, before, h * fraction, k)
            state, y = self._call(state, after, h * (1.0 - fraction), k)
        return len(drive.setpoint_N)

    def _call(self, state: Any, effort: float, dt_s: float, k: int) -> tuple[Any, float]:
        def fail(what: str) -> PlantError:
            expected = "expected (state, measurement), the measurement a finite number"
            return PlantError(f"the plant's function returned {what} at sample {k}; {expected}")

        try:
            answer = self.step(state, effort, dt_s)
        except Exception as error:
            raise PlantError(
                f"the plant's function raised {type(error).__name__} at sample {k}: {error}"
            ) from error
        if not isinstance(answer, tuple | list):
            raise fail(f"a {type(answer).__name__}")
        if len(answer) != 2:
            raise fail(f"{len(answer)} values")
        next_state, y = answer
        if k == 0 and _length(next_state) != _length(self.initial_state):
            raise fail(
                f"a state of length {_length(next_state)} where the initial state has length "
                f"{_length(self.initial_state)}"
            )
        if np.size(y) != 1:
            raise fail(f"a measurement of shape {np.shape(y)}")
        try:
            measurement = float(np.asarray(y).item())
        except (TypeError, ValueError) as error:
            raise fail(f"the measurement {y!r}") from error
        if not math.isfinite(measurement):
            raise fail(f"the measurement {measurement}")
        return next_state, measurement

    def describe(self, name: str, gains: Gains | None) -> RigDescription:
        live = gains or self.mounting.gains or self._identified_gains
        return self.mounting.describe(name, live, None)

    @cached_property
    def _identified_gains(self) -> Gains:
        """Cautious gains by a first identification in open loop."""
        return identified_gains(self, self.mounting.settling_time_s, self.initial_effort_N)


def _length(state: Any) -> int:
    listed = isinstance(state, list | tuple) or np.ndim(state)
    return len(state) if listed else 1


def python_plant(
    step: Step,
    initial_state: Any,
    *,
    sampling_Hz: float,
    settling_time_s: float,
    gains: Gains | None = None,
    profile: StepProfile | None = None,
    dead_time_s: float = 0.0,
    initial_effort_N: float = 0.0,
    initial_measurement_N: float = 0.0,
    output_min_N: float = -UNLIMITED_N,
    output_max_N: float = UNLIMITED_N,
    derivative_filter_s: float = 0.0,
    noise_rms_N: float = 0.0,
    limits: RigLimits | None = None,
    measurement: str = "measurement",
    command: str = "control effort",
) -> PythonPlant:
    """A plant from a function `step(state, effort, dt_s) -> (state, measurement)`.

    Each trial starts from a copy of the initial state; give the effort and the measurement at
    rest there. With a dead time that is no whole number of samples, the function is called twice a
    sample.

    Args:
        step: Advances the plant by `dt_s` under a constant effort, and measures at the end.
        initial_state: State in the form that the function takes.
        sampling_Hz: Rate of the controller.
        settling_time_s: Settling time a good tuning can reach, s.
        gains: Safe live gains of its rig; None is a slow PI by an identification in open loop,
            with an effort of at most a tenth of its range.
        profile: The suggested step; None is a step of one from the initial measurement, followed
            for five settling times.
        dead_time_s: Delay of the effort, s.
        initial_effort_N: Effort at rest in the initial state.
        initial_measurement_N: Measurement in the initial state.
        output_min_N: Lower limit of the controller's effort.
        output_max_N: Upper limit.
        derivative_filter_s: Time constant of the controller's derivative filter, s.
        noise_rms_N: Measurement noise, rms.
        limits: Limits of its rig; None is practically none.
        measurement: What is measured, with its unit: "temperature, K". Figures and tables use it.
        command: What the controller commands, likewise: "heating power, W".

    Raises:
        PlantError: `step` is no function.
        InvalidInput: a value is out of its range.
    """
    if not callable(step):
        raise PlantError(
            f"the plant is a {type(step).__name__}; expected a function step(state, effort, dt_s)"
        )
    check_positive("sampling rate", sampling_Hz, "Hz")
    check_positive("settling time", settling_time_s, "s")
    check_not_negative("dead time", dead_time_s, "s")
    controller = ControllerSettings(sampling_Hz, derivative_filter_s, output_min_N, output_max_N)
    mounting = Mounting(
        controller,
        profile or unit_step(initial_measurement_N, settling_time_s),
        settling_time_s,
        limits or wide_limits(sampling_Hz),
        noise_rms_N,
        gains,
        measurement=measurement,
        command=command,
    )
    return PythonPlant(
        mounting, step, initial_state, initial_effort_N, initial_measurement_N, dead_time_s
    )
