"""A Python function as equations: called once with symbols, it is differentiated and compiled.

Effects act on its input (actuator) and its output (gauge), in units as in `plants.models.linear_with_effects`.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from estune.errors import PlantError
from plants.effects.effect import Effect, Port, Site
from plants.models.effect_stages import Stages
from plants.models.linear_with_effects import READINGS_PER_ANGLE
from plants.models.parameters import Parametrised
from plants.models.reel_equations import GRAVITY_m_s2
from plants.simulation.equations import Equations, Expression

SHORTEST = 1e-9
"""Least part of a sample that the function is called for; it may divide by the time."""
AGREES = 1e-9
TRIALS = 5

Step = Callable[[Any, Any, Any], tuple[Any, Any]]


@dataclass(frozen=True)
class StateShape:
    """How a state is built of numbers.

    Attributes:
        kind: `number`, `array`, `list` or `tuple`.
        size: Shape of an array.
        parts: Of a list or a tuple.
    """

    kind: str
    size: tuple[int, ...] = ()
    parts: tuple["StateShape", ...] = ()

    @classmethod
    def of(cls, state: Any) -> "StateShape":
        """The shape of a state.

        Raises:
            PlantError: it is not made of numbers.
        """
        if isinstance(state, np.ndarray):
            return cls("array", state.shape)
        if isinstance(state, list | tuple):
            parts = tuple(cls.of(part) for part in state)
            return cls("list" if isinstance(state, list) else "tuple", (), parts)
        if isinstance(state, int | float | np.number):
            return cls("number")
        raise PlantError(
            f"the plant's state is a {type(state).__name__}; to hold it against records it has to "
            "be a number, an array, or a list or tuple of them"
        )

    @property
    def numbers(self) -> int:
        """How many numbers it holds."""
        own = int(np.prod(self.size)) if self.kind == "array" else int(self.kind == "number")
        return own + sum(part.numbers for part in self.parts)

    def flat(self, state: Any) -> list[Any]:
        """The numbers, or symbols, of a state."""
        if self.kind == "number":
            return [state]
        if self.kind == "array":
            if isinstance(state, np.ndarray):
                return list(state.ravel())
            return list(ca.vertsplit(ca.vec(ca.SX(state).T)))
        return [x for part, own in zip(self.parts, state, strict=True) for x in part.flat(own)]

    def built(self, numbers: Iterator[Any], *, as_columns: bool | None) -> Any:
        """A state of these numbers, or symbols.

        Args:
            numbers: As many as there are.
            as_columns: Whether an array of symbols becomes a column of CasADi, else an array of
                objects; None: they are numbers.
        """
        if self.kind == "number":
            return next(numbers)
        if self.kind == "array":
            parts = [next(numbers) for _ in range(self.numbers)]
            if as_columns is None:
                return np.array(parts).reshape(self.size)
            if as_columns:
                column = ca.vertcat(*parts)
                # CasADi counts along columns, numpy along rows.
                return ca.reshape(column, *self.size[::-1]).T if len(self.size) > 1 else column
            array = np.empty(self.numbers, object)
            array[:] = [_bare(part) for part in parts]
            return array.reshape(self.size)
        parts = [part.built(numbers, as_columns=as_columns) for part in self.parts]
        return parts if self.kind == "list" else tuple(parts)


@dataclass(frozen=True)
class TracedStructure(Parametrised):
    """What the equations depend on besides numbers.

    Attributes:
        step: The plant's function.
        shape: Of its state.
        effects: The effects added, in order.
    """

    step: Step
    shape: StateShape
    effects: tuple[type[Effect], ...] = ()

    COMMON: ClassVar[tuple[str, ...]] = (
        "sampling_Hz",
        "dead_time_s",
        "torque_unit",
        "angle_unit",
        "initial_effort",
        "initial_output",
    )
    has_outside_gauge: ClassVar[bool] = False

    @property
    def own_names(self) -> tuple[str, ...]:
        """The plant's own parameters, with the numbers of its initial state."""
        return (*self.COMMON, *(f"initial.{n}" for n in range(self.shape.numbers)))

    def plain_numbers(self) -> dict[str, float]:
        """What drives the function is its torque."""
        return {"torque_constant_Nm_A": 1.0}

    def equations(self) -> Equations:
        """The plant's equations of one sample.

        Raises:
            PlantError: the function cannot be called with symbols.
            AttributeError: an effect asks for what such a plant does not have.
        """
        advance, n = traced(self.step, self.shape), self.shape.numbers
        constants = ca.SX.sym("parameters", len(self.parameter_names))
        preload, reading, noise = (ca.SX.sym(name) for name in ("preload", "reading", "noise"))
        before, after, effort = (ca.SX.sym(name) for name in ("before", "after", "effort"))
        given = self.named(constants)
        nominal, delay, effects = given
        p = given.amended()
        facts = SimpleNamespace(
            **vars(p),
            preload_N=preload,
            gravity_m_s2=GRAVITY_m_s2,
            sample_s=1.0 / p.sampling_Hz,
            substep_s=1.0 / p.sampling_Hz,
        )
        numbers = [vars(known) | effect.prepare(known, facts) for effect, known in effects]
        stages = Stages(self.effects, numbers, n + 1)
        x, placed = ca.SX.sym("x", stages.states), ca.SX.sym("placed", n)

        def now(port: Port) -> Site:
            zero = ca.SX(0.0)
            return Site(port, 1.0 / p.sampling_Hz, zero, zero, zero, zero, zero)

        def moved(state: Expression, drive: Expression, span: Expression) -> Expression:
            _, torque = stages.rest_torque(ca.SX.zeros(stages.states), now(Port.DRUM))
            given = (p.torque_constant_Nm_A * drive + torque) * p.torque_unit
            return ca.vertcat(*advance(state[:n], given, span))

        per_output = READINGS_PER_ANGLE / p.angle_unit
        observed, seen = stages.forward(x, x[n] * per_output, now(Port.GAUGE))
        driven, drive = stages.forward(x, effort / p.torque_unit, now(Port.ACTUATOR))
        fraction = p.dead_time_s * p.sampling_Hz - delay
        first = ca.fmax(fraction, SHORTEST)
        h = 1.0 / p.sampling_Hz
        half = moved(moved(x, before, first * h), after, (1.0 - first) * h)
        rest = ca.SX.zeros(stages.states)
        rest[:n] = ca.vertcat(*(getattr(nominal, f"initial.{k}") for k in range(n)))
        rest[n] = nominal.initial_output
        rest, _ = stages.back(rest, rest[n] * per_output, now(Port.GAUGE))
        initial = nominal.initial_effort / p.torque_unit
        rest, command = stages.back(rest, initial, now(Port.ACTUATOR))
        rest_effort = command * p.torque_unit
        return Equations(
            prepare=ca.Function(
                "prepare", [constants, preload], [constants, ca.densify(rest), rest_effort]
            ),
            observe=ca.Function(
                "observe",
                [constants, x, before, noise],
                [observed, seen / per_output + noise, ca.SX(0.0)],
            ),
            drive=ca.Function("drive", [constants, x, effort], [driven, drive]),
            substep=ca.Function(
                "substep",
                [constants, x, before, after, ca.SX.sym("n")],
                [ca.vertcat(half, x[n + 1 :])],
            ),
            substeps=1,
            late=ca.Function("late", [constants], [self.late(constants)]),
            settle=ca.Function("settle", [constants, reading], [ca.densify(rest), rest_effort]),
            locate=ca.Function("locate", [constants, x], [x[:n]]),
            place=ca.Function("place", [constants, x, placed], [ca.vertcat(placed, x[n:])]),
        )


@lru_cache(maxsize=64)
def unavailable(structure: TracedStructure) -> str | None:
    """Why the one effect of a structure has no place on a Python plant, or None where it has."""
    (effect,) = structure.effects
    ports = set(effect.ports())
    inside = ports - {Port.ACTUATOR, Port.GAUGE}
    if inside and ports != {Port.DRUM, Port.GAUGE}:  # what is both is a gain and an offset
        return f"it acts at the {min(inside)}, which is inside the plant's function"
    try:
        structure.equations()
    except AttributeError as error:
        wanted = str(error).rpartition("attribute ")[2].strip("'")
        return f"it needs {wanted}, which such a plant does not have"
    return None


@lru_cache(maxsize=64)
def traced(step: Step, shape: StateShape) -> Expression:
    """The function as one of CasADi: (state, effort, time) -> (next state, measurement).

    Raises:
        PlantError: it branches on its arguments, or does what cannot be done with symbols.
    """
    reasons = []
    for as_columns in (True, False):  # arrays as CasADi's columns, or as arrays of objects
        try:
            found = _called(step, shape, as_columns=as_columns)
        except Exception as error:  # noqa: BLE001  whatever the user's function raises
            lines = str(error).strip().splitlines() or ["no message"]
            reasons.append(f"{type(error).__name__}: {lines[-1]}")
            continue
        if _agrees(found, step, shape):
            return found
        reasons.append("called with symbols it gives other numbers")
    raise PlantError(
        f"the plant's function cannot be traced with symbols ({reasons[0]}); write a branch on "
        "its arguments as casadi.if_else(condition, this, that), math.sin and the like as "
        "numpy.sin, and float(x) as x"
    )


def _called(step: Step, shape: StateShape, *, as_columns: bool) -> Expression:
    """The function called with symbols."""
    x, effort, span = ca.SX.sym("x", shape.numbers), ca.SX.sym("effort"), ca.SX.sym("span")
    symbols: list[Any] = [*ca.vertsplit(x), effort, span]
    if not as_columns:
        symbols = [_as_object(symbol) for symbol in symbols]
    state = shape.built(iter(symbols), as_columns=as_columns)
    following, measurement = step(state, *symbols[-2:])
    flat = ca.vertcat(*(ca.SX(_bare(part)) for part in shape.flat(following)))
    read = ca.SX(_bare(measurement))
    if flat.numel() != shape.numbers or read.numel() != 1:
        raise ValueError(f"{flat.numel()} numbers of state and {read.numel()} of measurement")
    return ca.Function("advance", [x, effort, span], [ca.densify(flat), ca.densify(read)])


def _as_object(symbol: Expression) -> Any:
    """A symbol as an array of objects without dimensions, which numpy's functions go into."""
    array = np.empty((), object)
    array[()] = symbol
    return array


def _bare(value: Any) -> Any:
    return value.item() if isinstance(value, np.ndarray) else value


def _agrees(found: Expression, step: Step, shape: StateShape) -> bool:
    """Whether the traced function gives what the function itself gives."""
    draw = np.random.default_rng(0)
    for _ in range(TRIALS):
        x, (effort, span) = draw.normal(size=shape.numbers), draw.uniform(0.1, 1.0, 2) * (1, 1e-3)
        following, measurement = step(shape.built(iter(x.tolist()), as_columns=None), effort, span)
        wanted = np.array([*map(float, shape.flat(following)), float(np.asarray(measurement))])
        given = np.concatenate([np.asarray(part).ravel() for part in found(x, effort, span)])
        if not np.allclose(wanted, given, rtol=AGREES, atol=AGREES, equal_nan=True):
            return False
    return True
