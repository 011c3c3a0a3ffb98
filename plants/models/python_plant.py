"""Any Python function as a plant, run sample by sample with the controller of the rig."""

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
from estune.core.quantities import FloatArray
from estune.errors import PlantError
from estune.trial import SATURATED, RigDescription, RigLimits
from estune.trial.profiles import StepProfile
from plants.effects import Effect
from plants.models.effect_mixin import EffectMixin
from plants.models.linear_plant import UNLIMITED_N, LONGEST_TRIAL_samples
from plants.models.mounting import Mounted, Mounting, ServesAsRig
from plants.models.symbolic_plant import StateShape, TracedStructure, unavailable
from plants.simulation.plant import (
    Columns,
    Drive,
    check_above_zero,
    check_not_negative,
    whole_and_fraction,
)
from plants.simulation.trial_loop import Batch, trial_loop

Step = Callable[[Any, float, float], tuple[Any, float]]
"""(state, effort in N, time step in s) -> (next state, measurement in N at its end)."""


@dataclass(frozen=True)
class PythonPlant(EffectMixin, Mounted, ServesAsRig):
    """A plant given as a function; made by `python_plant`.

    Effects are added to its input and output; the function is then traced with symbols, see
    `plants.models.symbolic_plant`.

    Attributes:
        mounting: Controller, suggested step, limits and noise.
        step: The function.
        initial_state: Its state at the start of every trial; each trial gets a copy.
        initial_effort_N: Effort in force until the dead time has passed, and of the controller.
        initial_measurement_N: Measurement at the start.
        dead_time_s: Delay of the effort, s.
        torque_unit: Input that stands for a newton metre, or an ampere, of the effects.
        angle_unit: Output that stands for a radian of the effects.

    Raises:
        PlantError: an effect has no place on it, or the function cannot be traced.
    """

    mounting: Mounting
    step: Step
    initial_state: Any
    initial_effort_N: float
    initial_measurement_N: float
    dead_time_s: float
    torque_unit: float = 1.0
    angle_unit: float = 1.0

    def __post_init__(self) -> None:
        for effect in self.effects:
            reason = self.unavailable(type(effect))
            if reason:
                raise PlantError(f"{effect.name} cannot be added to a Python plant: {reason}")

    def unavailable(self, effect: type[Effect]) -> str | None:
        """Why an effect has no place on the plant, or None where it has.

        Raises:
            PlantError: the function cannot be traced.
        """
        return unavailable(self.traced((effect,)))

    def traced(self, effects: tuple[type[Effect], ...]) -> TracedStructure:
        """The structure of the plant's equations with these effects.

        Raises:
            PlantError: the function cannot be traced.
        """
        return TracedStructure(self.step, StateShape.of(self.initial_state), effects)

    @property
    def own_numbers(self) -> dict[str, float]:
        """The plant's numbers by name, as its equations take them."""
        flat = StateShape.of(self.initial_state).flat(self.initial_state)
        return {
            "sampling_Hz": self.controller.sampling_Hz,
            "dead_time_s": self.dead_time_s,
            "torque_unit": self.torque_unit,
            "angle_unit": self.angle_unit,
            "initial_effort": self.initial_effort_N,
            "initial_output": self.initial_measurement_N,
        } | {f"initial.{n}": float(value) for n, value in enumerate(flat)}

    @cached_property
    def _with_effects(self) -> tuple[TracedStructure, FloatArray]:
        """Structure and parameters of the plant with its effects."""
        return self.traced(self.kinds), self.numbers(self.own_numbers.values())

    def respond(
        self,
        coefficients: FloatArray,
        drive: Drive,
        noise_N: FloatArray | None,
        bound_N: float,
    ) -> Columns:
        """Runs a batch of trials; see `Plant.respond`."""
        if self.effects:
            structure, parameters = self._with_effects
            batch = Batch(
                parameters=parameters,
                coefficients=coefficients,
                preload_N=drive.preload_N,
                setpoint_N=drive.setpoint_N,
                noise_N=noise_N,
                delay=self.delay_samples,
                bound_N=bound_N,
                open_loop=drive.open_loop,
            )
            return trial_loop(structure).run(batch)
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
        drive: Drive,
        noise: FloatArray,
        bound_N: float,
        columns: Columns,
    ) -> int:
        """The loop of `trial_loop.c` around the function; returns where it ended."""
        h = coefficients.sample_s
        delay, fraction = whole_and_fraction(self.dead_time_s, self.controller.sampling_Hz)
        ring = [self.initial_effort_N] * (delay + 2)
        memory = pidf.at_rest(self.initial_measurement_N, self.initial_effort_N)
        state, y = copy.deepcopy(self.initial_state), self.initial_measurement_N
        for k, r in enumerate(drive.setpoint_N.tolist()):
            measured = y + float(noise[k])
            memory, effort, excess = pidf.step(coefficients, memory, r, measured)
            if drive.open_loop:
                effort, excess = pidf.limited(coefficients, r)
            columns.tension_N[k], columns.effort_N[k], columns.angle_rad[k] = measured, effort, 0.0
            if not -bound_N <= measured <= bound_N:
                return k
            columns.flags[k] = SATURATED if excess else 0
            ring[(k + delay + 1) % (delay + 2)] = float(effort)
            before, after = ring[k % (delay + 2)], ring[(k + 1) % (delay + 2)]
            if fraction:
                state, y = self._call(state, before, h * fraction, k)
            state, y = self._call(state, after, h * (1.0 - fraction), k)
        return len(drive.setpoint_N)

    def _call(self, state: Any, effort: float, dt_s: float, k: int) -> tuple[Any, float]:
        """One call of the function, and what is wrong with its answer if anything is."""
        expected = "expected (state, measurement), the measurement a finite number"
        try:
            answer = self.step(state, effort, dt_s)
        except Exception as error:
            raise PlantError(
                f"the plant's function raised {type(error).__name__} at sample {k}: {error}"
            ) from error
        if not isinstance(answer, tuple | list):
            raise PlantError(
                f"the plant's function returned a {type(answer).__name__} at sample {k}; "
                f"{expected}"
            )
        if len(answer) != 2:
            raise PlantError(
                f"the plant's function returned {len(answer)} values at sample {k}; {expected}"
            )
        following, y = answer
        if np.size(y) != 1:
            raise PlantError(
                f"the plant's function returned a measurement of shape {np.shape(y)} at sample "
                f"{k}; {expected}"
            )
        try:
            measurement = float(np.asarray(y).item())
        except (TypeError, ValueError) as error:
            raise PlantError(
                f"the plant's function returned the measurement {y!r} at sample {k}; {expected}"
            ) from error
        if not math.isfinite(measurement):
            raise PlantError(
                f"the plant's function returned the measurement {measurement} at sample {k}; "
                f"{expected}"
            )
        return following, measurement

    def describe(self, name: str, gains: Gains | None) -> RigDescription:
        """What a rig that runs this plant says of itself."""
        return self.mounting.describe(name, gains, None)


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
) -> PythonPlant:
    """A plant from a function `step(state, effort, dt_s) -> (state, measurement)`.

    Each trial starts from a copy of the initial state; give the effort and the measurement that
    belong to it at rest. A dead time that is no whole number of samples calls the function twice
    in a sample, with the parts of it.

    Args:
        step: Advances the plant by `dt_s` under a constant effort, and measures at the end.
        initial_state: Anything the function takes.
        sampling_Hz: Rate of the controller.
        settling_time_s: Settling time a good tuning can reach, s.
        gains: Safe live gains of a rig of it; a function tells nothing to choose them by.
        profile: The step suggested; None is a step of one from the initial measurement, followed
            for five settling times.
        dead_time_s: Delay of the effort, s.
        initial_effort_N: Effort at rest in the initial state.
        initial_measurement_N: Measurement in the initial state.
        output_min_N: Least effort of the controller.
        output_max_N: Greatest effort.
        derivative_filter_s: Time constant of the controller's derivative filter, s.
        noise_rms_N: Measurement noise, rms.
        limits: What a rig of it accepts; None is practically everything.

    Raises:
        PlantError: the step is no function.
        InvalidInput: a value is out of its range.
    """
    if not callable(step):
        raise PlantError(
            f"the plant is a {type(step).__name__}; expected a function step(state, effort, dt_s)"
        )
    check_above_zero("sampling rate", sampling_Hz, "Hz")
    check_above_zero("settling time", settling_time_s, "s")
    check_not_negative("dead time", dead_time_s, "s")
    start = 0.5 * settling_time_s
    mounting = Mounting(
        controller=ControllerSettings(
            sampling_Hz, derivative_filter_s, output_min_N, output_max_N
        ),
        profile=profile
        or StepProfile(initial_measurement_N, 1.0, start, start + 5.0 * settling_time_s),
        settling_time_s=settling_time_s,
        limits=limits or RigLimits(-UNLIMITED_N, UNLIMITED_N, LONGEST_TRIAL_samples / sampling_Hz),
        noise_rms_N=noise_rms_N,
        gains=gains,
    )
    return PythonPlant(
        mounting, step, initial_state, initial_effort_N, initial_measurement_N, dead_time_s
    )
