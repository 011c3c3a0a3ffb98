"""A plant from what a user holds: a system of python-control or SciPy, or a Python function."""

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from plants.models.linear_plant import SAMPLES_PER_SETTLING_TIME, linear_plant, settling_time
from plants.models.python_plant import python_plant

ORDER_MAX = 8
"""States that a function without an initial state is tried with at most."""
SHORT = 0.02
"""Time step over which the rates of a function are measured, relative to its fastest time
constant: an explicit Euler step is then 1 % off, and the differences are far above rounding."""
MOVE = 1e-4
"""Motion of a state that its rates are measured by, relative to it or one."""
KINK = 3.0
"""Ratio of the fastest rates by a tenth of that motion and by the whole, from which a switch is
seen and no time constant: with the sign of a speed it is 10, without one 1. A motor with such
friction was run at 1.9 MHz."""
ROUNDS = 60
"""Time steps that are tried, each from the rates of the last: a decade in two."""
SAMPLES_PER_FAST = 2.0
"""Samples in the fastest time constant of a function, at which an explicit step is damped."""
UNIT_OCTAVES, UNIT_STEPS = 30, 16
"""Times, as powers of two of a second, in which a function that integrates may move by one, and
steps by which it is run over them."""
STIFFNESS_MAX = 20_000.0
"""Samples in a settling time at most: a trial of five and a half takes a second of CPU."""

_WRITTEN = "plants.python_plant(step, state, sampling_Hz=..., settling_time_s=...)"

Step = Callable[[Any, float, float], tuple[Any, float]]


def plant_of(
    given: Any,
    dead_time_s: float = 0.0,
    sampling_Hz: float | None = None,
    gains: Gains | None = None,
) -> Any:
    """The plant of an object.

    Args:
        given: A linear system, a function `step(state, effort, dt_s)`, or one of no arguments
            that returns a plant or a system.
        dead_time_s: Dead time of a system or a function, s.
        sampling_Hz: Rate of the controller; by default 200 samples in a settling time.
        gains: Safe live gains, which an unstable system needs.

    Raises:
        InvalidInput: it is of another kind, or has no time scale that can be found.
    """
    if callable(given) and not _is_system(given):
        if not _takes(given, 0) or _takes(given, 3):
            return _of_function(given, dead_time_s, sampling_Hz, gains)
        given = given()
        if hasattr(given, "rig"):
            return given
    if not _is_system(given):
        raise InvalidInput(
            f"the target is of type {type(given).__name__}; give an endpoint "
            "(tcp/127.0.0.1:7447), a plant (plants.reference_reel()), a rig, a linear system of "
            "python-control or SciPy, or a function step(state, effort, dt_s)"
        )
    return linear_plant(given, dead_time_s, sampling_Hz, gains=gains)


def _is_system(given: Any) -> bool:
    """Whether it is of python-control or SciPy; `linear_plant` refuses those it cannot take."""
    return type(given).__module__.startswith(("control.", "scipy.signal"))


def _takes(function: Callable[..., Any], count: int) -> bool:
    try:
        inspect.signature(function).bind(*[None] * count)
    except (TypeError, ValueError):  # ValueError: a built-in without a signature
        return False
    return True


def _of_function(
    step: Step, dead_time_s: float, sampling_Hz: float | None, gains: Gains | None
) -> Any:
    state = _initial_state(step)
    rates = _rates(step, state)
    settling_time_s = settling_time(
        rates, dead_time_s, sampling_Hz, partial(_unit_time, step, state)
    )
    if sampling_Hz is None:
        fastest = SAMPLES_PER_FAST * float(np.abs(rates).max(initial=0.0))
        sampling_Hz = max(SAMPLES_PER_SETTLING_TIME / settling_time_s, fastest)
        if sampling_Hz * settling_time_s > STIFFNESS_MAX:
            raise InvalidInput(
                f"the function {_name(step)} settles in {settling_time_s:.3g} s and its fastest "
                f"time constant is {SAMPLES_PER_FAST / sampling_Hz:.3g} s: "
                f"{sampling_Hz * settling_time_s:.3g} samples, more than {STIFFNESS_MAX:g}; give "
                "the rate of the controller as sampling_Hz"
            )
    return python_plant(
        step,
        state,
        sampling_Hz=sampling_Hz,
        settling_time_s=settling_time_s,
        dead_time_s=dead_time_s,
        gains=gains,
        initial_measurement_N=_first_measurement(step, state, 1.0 / sampling_Hz),
    )


def _first_measurement(step: Step, state: Any, dt_s: float) -> float:
    measurement = float(np.asarray(step(state, 0.0, dt_s)[1]).item())
    if not np.isfinite(measurement):
        raise InvalidInput(
            f"the function {_name(step)} gives a measurement of {measurement} in the state "
            f"{state} without effort; it must be finite: give another state as the default of "
            "its first argument"
        )
    return measurement


def _initial_state(step: Step) -> Any:
    """The default of the function's first argument, else a zero or zeros that it takes."""
    first = next(iter(inspect.signature(step).parameters.values()), None)
    if first is not None and first.default is not first.empty:
        return first.default
    why = ""
    zeros: list[Any] = [0.0, *(np.zeros(order) for order in range(1, ORDER_MAX + 1))]
    for state in zeros:
        try:
            following, measurement = step(state, 0.0, 1e-6)
            if np.size(following) == np.size(state) and np.size(measurement) == 1:
                return state
        except Exception as error:  # noqa: BLE001  a function of the user's may raise anything
            why = f"; the last attempt: {type(error).__name__}: {error}"
    raise InvalidInput(
        f"the function {_name(step)} takes neither 0.0 nor {ORDER_MAX} or fewer zeros as its "
        f"state, as step(state, effort, dt_s) -> (state, measurement) would{why}; give the state "
        f"as the default of its first argument, or write {_WRITTEN}"
    )


def _unit_time(step: Step, state: Any, effort: float) -> float:
    """Time in which an effort moves a function that integrates alone by one, s."""
    begin = float(np.asarray(step(state, 0.0, 1e-6)[1]).item())
    for exponent in range(-UNIT_OCTAVES, UNIT_OCTAVES + 1):
        dt_s, now = 2.0**exponent / UNIT_STEPS, state
        for _ in range(UNIT_STEPS):
            now, _measured = step(now, effort, dt_s)
        if abs(float(np.asarray(step(now, 0.0, 1e-6)[1]).item()) - begin) >= 1.0:
            return 2.0**exponent
    return 1.0  # no effort moves it: no gains are found safe for it, whatever its time


def _rates(step: Step, state: Any) -> FloatArray:
    """Magnitudes of the poles about the initial state, rad/s.

    Raises:
        InvalidInput: they cannot be found.
    """
    small, smaller = (_rates_of_moves(step, state, move) for move in (MOVE, 0.1 * MOVE))
    if np.max(smaller, initial=0.0) > KINK * np.max(small, initial=0.0):
        raise InvalidInput(
            f"the function {_name(step)} reacts the more strongly the less its initial state is "
            f"moved, as with dry friction: that hides its time constants; write {_WRITTEN}"
        )
    return small


def _rates_of_moves(step: Step, state: Any, move: float) -> FloatArray:
    flat = np.atleast_1d(np.asarray(state, np.float64)).ravel()
    dt_s = 1e-6
    for _ in range(ROUNDS):
        jacobian = _jacobian(step, state, flat, dt_s, move)
        if not np.isfinite(jacobian).all():
            raise InvalidInput(
                f"the function {_name(step)} returns a state that is not finite near its initial "
                f"state {state}, for a time step of {dt_s:.3g} s"
            )
        rates = np.abs(np.linalg.eigvals(jacobian - np.eye(flat.size))) / dt_s
        fastest = float(rates.max(initial=0.0))
        if 0.5 * SHORT <= fastest * dt_s <= 2.0 * SHORT:
            return np.asarray(np.where(rates > 1e-6 * fastest, rates, 0.0))
        # At most a decade at a time: a step beyond the fastest time constant says little.
        dt_s *= float(np.clip(SHORT / max(fastest * dt_s, 1e-12), 0.1, 10.0**0.5))
        if dt_s > 1e9:  # a pure integrator
            return np.zeros(flat.size)
    raise InvalidInput(
        f"the function {_name(step)} has no time constant at its initial state that differences "
        f"show, as behind dead bands or switches; write {_WRITTEN}"
    )


def _jacobian(step: Step, state: Any, flat: FloatArray, dt_s: float, move: float) -> FloatArray:
    def following(values: FloatArray) -> FloatArray:
        given: Any = values.reshape(np.shape(state)) if np.ndim(state) else float(values[0])
        if isinstance(state, list | tuple):
            given = type(state)(values.tolist())
        return np.atleast_1d(np.asarray(step(given, 0.0, dt_s)[0], np.float64)).ravel()

    moves = move * np.maximum(1.0, np.abs(flat))
    columns = [
        (following(flat + h * unit) - following(flat - h * unit)) / (2.0 * h)
        for h, unit in zip(moves, np.eye(flat.size), strict=True)
    ]
    return np.column_stack(columns)


def _name(step: Step) -> str:
    return getattr(step, "__qualname__", type(step).__name__)
