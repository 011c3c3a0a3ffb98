"""A response that costs are computed from, and costs given as a Python function of it."""

import importlib
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput


class LoadStep(NamedTuple):
    """A step added to the effort on its way to the plant.

    Attributes:
        sample: First sample with the load.
        size: Its size, in the unit of the effort; not zero.
    """

    sample: int
    size: float


class StepShape(NamedTuple):
    """The setpoint and the load of a step trial, in samples.

    Attributes:
        sample: First sample of the step.
        size: Its size; not zero.
        load: Load step after it, or None.
        ramp: Samples over which the setpoint moves; 1 is a step.
    """

    sample: int
    size: float
    load: LoadStep | None = None
    ramp: int = 1

    def setpoint(self, samples: int) -> FloatArray:
        """The setpoint as a deviation from the preload, shape (samples,)."""
        moved = np.arange(1 - self.sample, samples - self.sample + 1) / self.ramp
        return self.size * np.clip(moved, 0.0, 1.0)

    def loads(self, samples: int) -> FloatArray:
        """The load at each sample, shape (samples,)."""
        loads = np.zeros(samples)
        if self.load is not None:
            loads[self.load.sample :] = self.load.size
        return loads


class StepResponse(NamedTuple):
    """A step response, recorded or predicted; arrays have shape (samples,).

    Signals are deviations from the rest before the step, so that a cost of the record and of a
    prediction are the same.

    Attributes:
        time_s: Time from the step; negative before it.
        setpoint: Setpoint before its filter.
        measurement: Measurement.
        effort: Control effort.
        step_size: Size of the step.
        step_index: First sample of the step.
        settling_time_s: Desired settling time.
        load: Load step, or None.
    """

    time_s: FloatArray
    setpoint: FloatArray
    measurement: FloatArray
    effort: FloatArray
    step_size: float
    step_index: int
    settling_time_s: float
    load: LoadStep | None


CostFunction = Callable[[StepResponse], float]
"""A cost above zero; infinite or not a number marks the gains as unsafe."""


def reference_of(function: CostFunction) -> str:
    """The name "module:function" by which a cost function is stored.

    Raises:
        InvalidInput: it is not found under its name, as a lambda or a function in a function.
    """
    module, name = getattr(function, "__module__", ""), getattr(function, "__qualname__", "")
    reference = f"{module}:{name}"
    try:
        same = cost_function(reference) is function
    except InvalidInput:
        same = False
    if not same:
        raise InvalidInput(
            f"cost function {name or function!r} is not found as {reference}; define it at the "
            "top of a module, so that a run can be resumed"
        )
    return reference


@lru_cache(maxsize=64)
def cost_function(reference: str) -> CostFunction:
    """The function of a name "module:function".

    Raises:
        InvalidInput: there is none.
    """
    module, colon, name = reference.partition(":")
    try:
        found: Any = getattr(importlib.import_module(module), name) if colon else None
    except (ImportError, AttributeError, ValueError) as error:
        raise InvalidInput(f"cost function {reference} cannot be imported: {error}") from error
    if not callable(found):
        raise InvalidInput(f"cost {reference!r} is no function; write module:function")
    made: CostFunction = found
    return made


def evaluate_function(reference: str, response: StepResponse) -> float:
    """The cost of a response by a function.

    Raises:
        InvalidInput: the function is not found, raises, or returns no number.
    """
    try:
        return float(cost_function(reference)(response))
    except InvalidInput:
        raise
    except Exception as error:
        raise InvalidInput(
            f"cost function {reference} failed: {type(error).__name__}: {error}; it takes a "
            "StepResponse and returns a number"
        ) from error
