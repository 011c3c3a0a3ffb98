"""The kinds of model that a file can hold: their keys, how one is made, what is written of it."""

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, asdict, fields, replace
from typing import Any, NamedTuple, get_args

from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.run import targets
from estune.trial import RigLimits
from estune.trial.profiles import StepProfile

Reader = Callable[[Any], Any]
"""Takes a value as TOML has it and gives it as the model takes it, or raises InvalidInput."""


class Kind(NamedTuple):
    """A kind of model.

    Attributes:
        table: Name of its table.
        type: Its class, loaded when it is asked for.
        keys: How each key is read.
        make: Makes the model of the values of some keys; what is missing takes its usual value.
        values: What is written of a model, by key.
    """

    table: str
    type: Callable[[], type]
    keys: Callable[[], Mapping[str, Reader]]
    make: Callable[..., Any]
    values: Callable[[Any], dict[str, Any]]


def number(value: Any) -> float:
    """A number.

    Raises:
        InvalidInput: it is something else.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InvalidInput(f"this is {_shown(value)}; it must be a number")
    return float(value)


def written(values: Mapping[str, Any]) -> Iterator[str]:
    """Lines of TOML."""
    for name, value in values.items():
        yield f"{name} = {_toml(value)}"


def names() -> str:
    """The tables there are, in words."""
    *most, last = (f"[{kind.table}]" for kind in KINDS)
    return f"{', '.join(most)} or {last}"


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise InvalidInput(f"this is {_shown(value)}; it must be true or false")
    return value


def _numbers(value: Any) -> tuple[float, ...]:
    if not isinstance(value, list):
        raise InvalidInput(f"this is {_shown(value)}; it must be a list of numbers")
    return tuple(number(item) for item in value)


def _matrix(value: Any) -> tuple[tuple[float, ...], ...]:
    if not isinstance(value, list):
        raise InvalidInput(f"this is {_shown(value)}; it must be a list of rows of numbers")
    rows = tuple(_numbers(row) for row in value)
    if any(len(row) != len(rows) for row in rows):
        raise InvalidInput(f"its {len(rows)} rows must have {len(rows)} numbers each")
    return rows


def _record_of(made: type) -> Reader:
    """A table whose keys are the fields of a dataclass: numbers, or one of a few words."""
    known = {f.name: f for f in fields(made) if f.name != "kind"}
    needed = {name for name, f in known.items() if f.default is MISSING}

    def read(value: Any) -> Any:
        if not (isinstance(value, dict) and needed <= set(value) <= set(known)):
            optional = [f"{name} if you like" for name in known if name not in needed]
            wanted = ", ".join([*(name for name in known if name in needed), *optional])
            raise InvalidInput(f"this is {_shown(value)}; it must be {{ {wanted} }}")
        return made(**{name: _entry(known[name].type, given) for name, given in value.items()})

    return read


def _entry(kind: Any, value: Any) -> Any:
    if kind is float:
        return number(value)
    if value not in get_args(kind):
        raise InvalidInput(f"this is {_shown(value)}; it must be {' or '.join(get_args(kind))}")
    return value


def _table(record: Any) -> dict[str, Any]:
    return {name: value for name, value in asdict(record).items() if name != "kind"}


def _shown(value: Any) -> str:
    return json.dumps(value, default=str, ensure_ascii=False)


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{{ {', '.join(written(value))} }}"
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, bool | str):
        return json.dumps(value, ensure_ascii=False)
    return repr(float(value))


# ---------------------------------------------------------------- reels


def _reel() -> type:
    from plants.models.reel import Reel  # noqa: PLC0415  slow to import

    return Reel


def _own_keys(made: Callable[[], type]) -> Callable[[], Mapping[str, Reader]]:
    return lambda: {f.name: number for f in fields(made()) if f.name != "effects"}


def _own_values(model: Any) -> dict[str, Any]:
    return {f.name: getattr(model, f.name) for f in fields(model) if f.name != "effects"}


def _make_reel(**values: Any) -> Any:
    from plants.models.reel import reference_reel  # noqa: PLC0415  slow to import

    return reference_reel(**values)


def _unloaded() -> type:
    from plants.models.unloaded_reel import UnloadedReel  # noqa: PLC0415  slow to import

    return UnloadedReel


def _make_unloaded(**values: Any) -> Any:
    from plants.models.unloaded_reel import unloaded_reel  # noqa: PLC0415  slow to import

    return unloaded_reel(**values)


# ---------------------------------------------------------------- linear plants


def _linear() -> type:
    from plants.models.linear_plant import LinearPlant  # noqa: PLC0415  slow to import

    return LinearPlant


_UNITS = ("torque_unit", "angle_unit")
"""What stands for a newton metre and a radian of the effects."""
_LINEAR_NUMBERS = (
    *("dead_time_s", "sampling_Hz", "output_min_N", "output_max_N"),
    *("derivative_filter_s", "noise_rms_N", "settling_time_s"),
    *_UNITS,
)
_LINEAR_KEYS: dict[str, Reader] = {
    "numerator": _numbers,
    "denominator": _numbers,
    "A": _matrix,
    "B": _numbers,
    "C": _numbers,
    "E": number,
    "discrete": _flag,
    **dict.fromkeys(_LINEAR_NUMBERS, number),
    "step": _record_of(StepProfile),
    "limits": _record_of(RigLimits),
    "gains": _record_of(Gains),
}


def _make_linear(**values: Any) -> Any:
    """A linear plant from its transfer function or its matrices."""
    import control  # noqa: PLC0415  slow to import

    from plants.models.linear_plant import linear_plant  # noqa: PLC0415  slow to import

    top, bottom = values.pop("numerator", None), values.pop("denominator", None)
    matrices = [values.pop(name, None) for name in ("A", "B", "C")]
    through, discrete = values.pop("E", 0.0), values.pop("discrete", False)
    rate = values.get("sampling_Hz", math.nan)
    if discrete and not rate > 0.0:
        raise InvalidInput("a discrete model needs its sampling_Hz, above zero")
    dt = 1.0 / rate if discrete else 0.0
    try:
        if None not in matrices and top is bottom is None:
            A, B, C = matrices
            system = control.ss(
                A, [[b] for b in B], [C], [[through]], dt, remove_useless_states=False
            )
        elif top is not None and bottom is not None and matrices == [None] * 3:
            system = control.tf(top, bottom, dt)
        else:
            raise InvalidInput("give either numerator and denominator, or A, B and C")
    except (ValueError, TypeError, control.ControlDimension) as error:
        raise InvalidInput(f"the model cannot be made: {error}") from error
    units = {name: values.pop(name) for name in _UNITS if name in values}
    return replace(linear_plant(system, profile=values.pop("step", None), **values), **units)


def _linear_values(plant: Any) -> dict[str, Any]:
    mounting, sampled = plant.mounting, plant.sampled
    if plant.model is not None:
        m = plant.model
        shown = {"A": m.A, "B": m.B, "C": m.C, "E": m.E, "dead_time_s": m.dead_time_s}
    else:
        shown = {
            "discrete": True,
            "A": tuple(map(tuple, sampled.Phi.tolist())),
            "B": tuple(sampled.now.tolist()),
            "C": tuple(sampled.C.tolist()),
            "dead_time_s": sampled.delay / mounting.controller.sampling_Hz,
        }
    settings = mounting.controller
    shown |= {name: getattr(plant, name) for name in _UNITS}
    shown |= {
        "sampling_Hz": settings.sampling_Hz,
        "output_min_N": settings.output_min_N,
        "output_max_N": settings.output_max_N,
        "derivative_filter_s": settings.derivative_filter_s,
        "noise_rms_N": mounting.noise_rms_N,
        "settling_time_s": mounting.settling_time_s,
        "step": _table(mounting.profile),
        "limits": _table(mounting.limits),
    }
    return shown if mounting.gains is None else {**shown, "gains": _table(mounting.gains)}


# ---------------------------------------------------------------- Python functions


def _python() -> type:
    from plants.models.python_plant import PythonPlant  # noqa: PLC0415  slow to import

    return PythonPlant


def _reference(value: Any) -> str:
    if not isinstance(value, str):
        raise InvalidInput(f"this is {_shown(value)}; it must be module:attribute")
    return value


_PYTHON_KEYS: dict[str, Reader] = {"plant": _reference, **dict.fromkeys(_UNITS, number)}


def _make_python(**values: Any) -> Any:
    """The plant that a name leads to; its effects are those the file lists."""
    if "plant" not in values:
        raise InvalidInput('which one is missing; say it as plant = "module:attribute"')
    reference = values.pop("plant")
    found = targets.load(reference)
    kind: Any = _python()
    if not isinstance(found, kind):
        raise InvalidInput(f"plant {reference} is a {type(found).__name__}, not a python_plant")
    return replace(found, effects=(), **values)


def _python_values(plant: Any) -> dict[str, Any]:
    return {name: getattr(plant, name) for name in _UNITS}


KINDS = (
    Kind("reel", _reel, _own_keys(_reel), _make_reel, _own_values),
    Kind("unloaded_reel", _unloaded, _own_keys(_unloaded), _make_unloaded, _own_values),
    Kind("linear_plant", _linear, lambda: _LINEAR_KEYS, _make_linear, _linear_values),
    Kind("python_plant", _python, lambda: _PYTHON_KEYS, _make_python, _python_values),
)
"""In the order they are told in."""
