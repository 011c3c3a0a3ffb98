"""A Python function as equations: traced with symbols, it can be differentiated and compiled.

Effects act on its input (actuator) and its output (gauge), in the units of `linear_with_effects`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from estune.errors import PlantError
from plants.effects.effect import Effect, Port, Site
from plants.models.effect_stages import EffectStages
from plants.models.linear_signal_path import READINGS_PER_ANGLE
from plants.models.parameters import ParametricStructure
from plants.models.path_structure import prepare_effects
from plants.models.state_shape import StateShape, bare
from plants.simulation.equations import Equations, Expression, dense_function

STEP_MIN = 1e-9
"""Shortest step as a fraction of a sample; the function may divide by it."""
CHECK_RTOL = 1e-9
CHECK_CALLS = 5

Step = Callable[[Any, Any, Any], tuple[Any, Any]]


@dataclass(frozen=True)
class TracedStructure(ParametricStructure):
    """Structure of the equations of a Python function."""

    step: Step  # the plant's function
    shape: StateShape  # shape of its state
    effects: tuple[type[Effect], ...] = ()  # the effects added, in order

    COMMON: ClassVar[tuple[str, ...]] = (
        "sampling_Hz",
        "dead_time_s",
        "torque_unit",
        "angle_unit",
        "initial_effort",
        "initial_output",
    )

    @property
    def own_names(self) -> tuple[str, ...]:
        return (*self.COMMON, *(f"initial.{n}" for n in range(self.shape.numbers)))

    def substitutes(self) -> dict[str, float]:
        """The function's input is its torque."""
        return {"torque_constant_Nm_A": 1.0}

    def equations(self) -> Equations:
        """The plant's equations of one sample.

        Raises:
            PlantError: the function cannot be called with symbols.
            AttributeError: an effect asks for a parameter that the plant does not have.
        """
        advance, n = trace(self.step, self.shape), self.shape.numbers
        constants = ca.SX.sym("parameters", len(self.parameter_names))
        preload, reading, noise = (ca.SX.sym(name) for name in ("preload", "reading", "noise"))
        before, after, effort = (ca.SX.sym(name) for name in ("before", "after", "effort"))
        given = self.split_parameters(constants)
        p = given.with_effects()
        h = 1.0 / p.sampling_Hz
        numbers = prepare_effects(given, p, preload, substep_s=h)
        stages = EffectStages(self.effects, numbers, n + 1)
        x, placed = ca.SX.sym("x", stages.states), ca.SX.sym("placed", n)
        _, torque = stages.rest_torque(ca.SX.zeros(stages.states), _site(Port.DRUM, h))

        def advanced(state: Expression, drive: Expression, span: Expression) -> Expression:
            driven = (p.torque_constant_Nm_A * drive + torque) * p.torque_unit
            return ca.vertcat(*advance(state[:n], driven, span))

        per_output = READINGS_PER_ANGLE / p.angle_unit
        observed, seen = stages.forward(x, x[n] * per_output, _site(Port.GAUGE, h))
        driven, drive = stages.forward(x, effort / p.torque_unit, _site(Port.ACTUATOR, h))
        first = ca.fmax(p.dead_time_s * p.sampling_Hz - given.delay, STEP_MIN)
        moved = advanced(advanced(x, before, first * h), after, (1.0 - first) * h)
        rest, rest_effort = self._rest(stages, given.nominal, p, per_output)

        measurement = seen / per_output + noise
        return Equations(
            prepare=dense_function("prepare", [constants, preload], constants, rest, rest_effort),
            observe=dense_function(
                "observe", [constants, x, before, noise], observed, measurement, ca.SX(0.0)
            ),
            drive=dense_function("drive", [constants, x, effort], driven, drive),
            substep=dense_function(
                "substep",
                [constants, x, before, after, ca.SX.sym("n")],
                ca.vertcat(moved, x[n + 1 :]),
            ),
            substeps=1,
            dead_time_samples=dense_function(
                "dead_time_samples", [constants], self.dead_time_samples(constants)
            ),
            settle=dense_function("settle", [constants, reading], rest, rest_effort),
            locate=dense_function("locate", [constants, x], x[:n]),
            place=dense_function("place", [constants, x, placed], ca.vertcat(placed, x[n:])),
        )

    def _rest(
        self, stages: EffectStages, nominal: Any, p: Any, per_output: Expression
    ) -> tuple[Expression, Expression]:
        """State and effort at the start of a trial."""
        n, h = self.shape.numbers, 1.0 / p.sampling_Hz
        rest = ca.SX.zeros(stages.states)
        rest[:n] = ca.vertcat(*(getattr(nominal, f"initial.{k}") for k in range(n)))
        rest[n] = nominal.initial_output
        rest, _ = stages.inverse(rest, rest[n] * per_output, _site(Port.GAUGE, h))
        initial = nominal.initial_effort / p.torque_unit
        rest, command = stages.inverse(rest, initial, _site(Port.ACTUATOR, h))
        return rest, command * p.torque_unit


def _site(port: Port, span_s: Expression) -> Site:
    zero = ca.SX(0.0)
    return Site(port, span_s, zero, zero, zero, zero, zero)


@lru_cache(maxsize=64)
def unavailable(structure: TracedStructure) -> str | None:
    """Reason why the structure's one effect cannot be added; None where it can."""
    (effect,) = structure.effects
    ports = set(effect.ports())
    inside = ports - {Port.ACTUATOR, Port.GAUGE}
    if inside and ports != {Port.DRUM, Port.GAUGE}:  # both together are a gain and an offset
        return f"it acts at the {min(inside)}, which is inside the plant's function"
    try:
        structure.equations()
    except AttributeError as error:
        missing_name = str(error).rpartition("attribute ")[2].strip("'")
        return f"it needs {missing_name}, which such a plant does not have"
    return None


@lru_cache(maxsize=64)
def trace(step: Step, shape: StateShape) -> Expression:
    """The function as one of CasADi: (state, effort, time) -> (next state, measurement).

    Raises:
        PlantError: it branches on its arguments, or uses operations without symbolic form.
    """
    reasons = []
    for as_columns in (True, False):  # arrays as CasADi's columns, or as arrays of objects
        try:
            function = _call_with_symbols(step, shape, as_columns=as_columns)
        except Exception as error:  # noqa: BLE001  any exception of the user's function
            lines = str(error).strip().splitlines() or ["no message"]
            reasons.append(f"{type(error).__name__}: {lines[-1]}")
            continue
        if _agrees(function, step, shape):
            return function
        reasons.append("called with symbols it gives other numbers")
    raise PlantError(
        f"the plant's function cannot be traced with symbols ({reasons[0]}); write a branch on "
        "its arguments as casadi.if_else(condition, this, that), math.sin and the like as "
        "numpy.sin, and float(x) as x"
    )


def _call_with_symbols(step: Step, shape: StateShape, *, as_columns: bool) -> Expression:
    x, effort, span = ca.SX.sym("x", shape.numbers), ca.SX.sym("effort"), ca.SX.sym("span")
    symbols: list[Any] = [*ca.vertsplit(x), effort, span]
    if not as_columns:
        symbols = [_as_object(symbol) for symbol in symbols]
    state = shape.build(iter(symbols), as_columns=as_columns)
    next_state, measurement = step(state, *symbols[-2:])
    flat = ca.vertcat(*(ca.SX(bare(part)) for part in shape.flatten(next_state)))
    read = ca.SX(bare(measurement))
    if flat.numel() != shape.numbers or read.numel() != 1:
        raise ValueError(f"{flat.numel()} numbers of state and {read.numel()} of measurement")
    return ca.Function("advance", [x, effort, span], [ca.densify(flat), ca.densify(read)])


def _as_object(symbol: Expression) -> Any:
    """A symbol in an array without dimensions, to which numpy's functions apply."""
    array = np.empty((), object)
    array[()] = symbol
    return array


def _agrees(function: Expression, step: Step, shape: StateShape) -> bool:
    """Whether the traced function gives the numbers of the function itself."""
    draw = np.random.default_rng(0)
    for _ in range(CHECK_CALLS):
        x, (effort, span) = draw.normal(size=shape.numbers), draw.uniform(0.1, 1.0, 2) * (1, 1e-3)
        next_state, measurement = step(
            shape.build(iter(x.tolist()), as_columns=None), effort, span
        )
        expected = np.array(
            [*map(float, shape.flatten(next_state)), float(np.asarray(measurement))]
        )
        given = np.concatenate([np.asarray(part).ravel() for part in function(x, effort, span)])
        if not np.allclose(expected, given, rtol=CHECK_RTOL, atol=CHECK_RTOL, equal_nan=True):
            return False
    return True
