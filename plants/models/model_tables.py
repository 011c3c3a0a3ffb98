"""The tables of a model file: keys, constructors and saved values of each kind of model."""

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, fields, replace
from inspect import signature
from typing import Any, NamedTuple, get_args, get_type_hints

from pydantic import TypeAdapter

from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.run import targets
from estune.trial import RigLimits
from estune.trial.profiles import StepProfile
from plants.models.drives import Servo, Stage, servo, stage
from plants.models.fmu.plant import FmuPlant, fmu_plant
from plants.models.linear_plant import LinearPlant, linear_plant
from plants.models.plant_model import PlantModel, own_fields
from plants.models.python_plant import PythonPlant
from plants.models.reel import Reel, reference_reel
from plants.models.unloaded_reel import UnloadedReel, unloaded_reel

Reader = Callable[[Any], Any]
"""Converts a value of TOML to an argument of the model, or raises InvalidInput."""


class ModelKind(NamedTuple):
    """How one table of a model file becomes a plant, and a plant that table."""

    table: str  # name of its table
    type: type[PlantModel]  # its class
    keys: Mapping[str, Reader]  # reader of each key
    # Makes the model from the values of some keys; the others have defaults.
    make: Callable[..., Any]
    values: Callable[[Any], dict[str, Any]]  # saved values of a model, by key


def read_number(value: Any) -> float:
    """A number.

    Raises:
        InvalidInput: the value is something else.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InvalidInput(f"this is {_shown(value)}; it must be a number")
    return float(value)


def read_share(value: Any) -> float:
    """A relative standard deviation.

    Raises:
        InvalidInput: the value is something else, or not above zero.
    """
    share = read_number(value)
    if not 0.0 < share < math.inf:
        raise InvalidInput(f"this is {share:g}; it must be a relative deviation above 0, as 0.05")
    return share


def form_of(reader: Reader) -> str:
    """What a reader takes, for a form: number, numbers, text, flag, or toml for any value."""
    forms: dict[Reader, str] = {
        read_number: "number",
        _numbers: "numbers",
        _text: "text",
        _flag: "flag",
    }
    return forms.get(reader, "toml")


def toml_lines(values: Mapping[str, Any]) -> Iterator[str]:
    """One `key = value` line each, in the order given."""
    for name, value in values.items():
        yield f"{name} = {_toml(value)}"


def table_names() -> str:
    """The names of the tables, as a phrase."""
    *most, last = (f"[{kind.table}]" for kind in KINDS)
    return f"{', '.join(most)} or {last}"


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise InvalidInput(f"this is {_shown(value)}; it must be a text")
    return value


def _reference(value: Any) -> str:
    if not isinstance(value, str):
        raise InvalidInput(f"this is {_shown(value)}; it must be module:attribute")
    return value


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise InvalidInput(f"this is {_shown(value)}; it must be true or false")
    return value


def _numbers(value: Any) -> tuple[float, ...]:
    if not isinstance(value, list):
        raise InvalidInput(f"this is {_shown(value)}; it must be a list of numbers")
    return tuple(read_number(item) for item in value)


def _matrix(value: Any) -> tuple[tuple[float, ...], ...]:
    if not isinstance(value, list):
        raise InvalidInput(f"this is {_shown(value)}; it must be a list of rows of numbers")
    rows = tuple(_numbers(row) for row in value)
    if any(len(row) != len(rows) for row in rows):
        raise InvalidInput(f"its {len(rows)} rows must have {len(rows)} numbers each")
    return rows


def _record_of(made: type) -> Reader:
    """Reader of a table whose keys are the fields of a dataclass: numbers or literals."""
    known = {f.name: f for f in fields(made) if f.name != "kind"}
    kinds = get_type_hints(made)
    needed = {name for name, f in known.items() if f.default is MISSING}

    def read(value: Any) -> Any:
        if not (isinstance(value, dict) and needed <= set(value) <= set(known)):
            optional = [f"{name} if you like" for name in known if name not in needed]
            expected = ", ".join([*(name for name in known if name in needed), *optional])
            raise InvalidInput(f"this is {_shown(value)}; it must be {{ {expected} }}")
        return made(**{name: _entry(kinds[name], given) for name, given in value.items()})

    return read


def _entry(kind: Any, value: Any) -> Any:
    if kind is float:
        return read_number(value)
    if value not in get_args(kind):
        raise InvalidInput(f"this is {_shown(value)}; it must be {' or '.join(get_args(kind))}")
    return value


def _table(record: Any) -> dict[str, Any]:
    shown = TypeAdapter(type(record)).dump_python(record)
    return {name: value for name, value in shown.items() if name != "kind"}


def _shown(value: Any) -> str:
    return json.dumps(value, default=str, ensure_ascii=False)


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{{ {', '.join(toml_lines(value))} }}"
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, bool | str):
        return json.dumps(value, ensure_ascii=False)
    return repr(float(value))


def _own_keys(kind: type[PlantModel]) -> dict[str, Reader]:
    return {f.name: read_number for f in own_fields(kind)}


def _own_values(model: PlantModel) -> dict[str, Any]:
    return {f.name: getattr(model, f.name) for f in own_fields(type(model))}


_UNITS = ("torque_unit", "angle_unit")
_CONTROLLER = ("sampling_Hz", "output_min_N", "output_max_N", "derivative_filter_s")
_SIGNALS = ("measurement", "command")
_MOUNTED = ("noise_rms_N", "settling_time_s", "newtons_per_ampere")
_LINEAR_KEYS: dict[str, Reader] = {
    "numerator": _numbers,
    "denominator": _numbers,
    "A": _matrix,
    "B": _numbers,
    "C": _numbers,
    "E": read_number,
    "discrete": _flag,
    **dict.fromkeys(("dead_time_s", *_CONTROLLER, *_MOUNTED, *_UNITS), read_number),
    **dict.fromkeys(_SIGNALS, _text),
    "step": _record_of(StepProfile),
    "limits": _record_of(RigLimits),
    "gains": _record_of(Gains),
}
_PYTHON_KEYS: dict[str, Reader] = {"plant": _reference, **dict.fromkeys(_UNITS, read_number)}
_FMU_KEYS: dict[str, Reader] = {
    **dict.fromkeys(("file", "input", "output"), _text),
    **dict.fromkeys(("dead_time_s", "initial_effort_N", *_CONTROLLER), read_number),
    **dict.fromkeys(("noise_rms_N", "settling_time_s"), read_number),
    "step": _record_of(StepProfile),
    "limits": _record_of(RigLimits),
    "gains": _record_of(Gains),
}


def _make_linear(**values: Any) -> LinearPlant:
    """A linear plant from its transfer function or its matrices."""
    import control  # noqa: PLC0415  slow to import

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


def _linear_values(plant: LinearPlant) -> dict[str, Any]:
    m, mounting, sampled = plant.model, plant.mounting, plant.sampled
    values: dict[str, Any]
    if m is not None:
        values = {"A": m.A, "B": m.B, "C": m.C, "E": m.E, "dead_time_s": m.dead_time_s}
    else:
        values = {
            "discrete": True,
            "A": tuple(map(tuple, sampled.Phi.tolist())),
            "B": tuple(sampled.now.tolist()),
            "C": tuple(sampled.C.tolist()),
            "dead_time_s": sampled.delay / mounting.controller.sampling_Hz,
        }
    values |= _units_of(plant)
    values |= {name: getattr(mounting.controller, name) for name in _CONTROLLER}
    values |= {name: getattr(mounting, name) for name in _MOUNTED}
    signals = {name: getattr(mounting, name) for name in _SIGNALS}
    values |= {name: label for name, label in signals.items() if "," in label}  # with a unit
    if mounting.newtons_per_ampere == 1.0:  # as in files of earlier versions
        del values["newtons_per_ampere"]
    values |= {"step": _table(mounting.profile), "limits": _table(mounting.limits)}
    return values if mounting.gains is None else {**values, "gains": _table(mounting.gains)}


def _make_python(**values: Any) -> PythonPlant:
    """The plant that a reference names, with the effects listed in the file."""
    if "plant" not in values:
        raise InvalidInput('which one is missing; say it as plant = "module:attribute"')
    reference = values.pop("plant")
    plant = targets.load(reference)
    if not isinstance(plant, PythonPlant):
        raise InvalidInput(f"plant {reference} is a {type(plant).__name__}, not a python_plant")
    return replace(plant, effects=(), **values)


def _make_fmu(**values: Any) -> FmuPlant:
    """The plant of an FMU file, whose path is relative to the working directory."""
    needed = ("file", "input", "output", "sampling_Hz", "settling_time_s")
    missing = [key for key in needed if key not in values]
    if missing:
        raise InvalidInput(f"it needs {' and '.join(missing)}")
    return fmu_plant(profile=values.pop("step", None), **values)


def _fmu_values(plant: FmuPlant) -> dict[str, Any]:
    m, step = plant.mounting, plant.step
    values: dict[str, Any] = {"file": step.file, "input": step.input, "output": step.output}
    values |= {name: getattr(m.controller, name) for name in _CONTROLLER}
    values |= {"dead_time_s": plant.stated_dead_time_s, "noise_rms_N": m.noise_rms_N}
    values |= {"settling_time_s": m.settling_time_s, "initial_effort_N": plant.initial_effort_N}
    values |= {"step": _table(m.profile), "limits": _table(m.limits)}
    return values if m.gains is None else {**values, "gains": _table(m.gains)}


def _units_of(plant: LinearPlant | PythonPlant) -> dict[str, Any]:
    return {name: getattr(plant, name) for name in _UNITS}


def _of_drive(kind: type[Servo], make: Callable[..., Servo]) -> ModelKind:
    """A servo or a stage: all its keys are numbers, of which two have no default."""
    needed = [p.name for p in signature(make).parameters.values() if p.default is p.empty]

    def made(**values: Any) -> Servo:
        missing = [key for key in needed if key not in values]
        if missing:
            raise InvalidInput(f"it needs {' and '.join(missing)}")
        return make(**values)

    keys = dict.fromkeys(kind.FIELDS, read_number)
    return ModelKind(kind.title, kind, keys, made, lambda drive: drive.own_values)


KINDS = (
    ModelKind("reel", Reel, _own_keys(Reel), reference_reel, _own_values),
    _of_drive(Stage, stage),
    _of_drive(Servo, servo),
    ModelKind("unloaded_reel", UnloadedReel, _own_keys(UnloadedReel), unloaded_reel, _own_values),
    ModelKind("linear_plant", LinearPlant, _LINEAR_KEYS, _make_linear, _linear_values),
    ModelKind("fmu", FmuPlant, _FMU_KEYS, _make_fmu, _fmu_values),
    ModelKind("python_plant", PythonPlant, _PYTHON_KEYS, _make_python, _units_of),
)
"""All kinds, in the order of messages."""
