"""Models as TOML files: a reel, or another plant, and its effects.

```toml
[reel]
cable_length_m = 0.8
tension_N = 15.0

[[effects]]
name = "eyelet_friction"
attenuation = 0.93
inner_share = 0.2
```

A table `[uncertainty]` states how well numbers of the model are known, by their keys: relative
standard deviations, `inertia_kg_m2 = 0.05`. A diagnosis moves a number that is known well only for
what nothing else explains.

Keys that a file leaves out have the values of `plants.reference_reel`; a saved file is complete.
The name of an effect is its slug, or module:attribute for an effect of the user's. All mistakes in
a file are reported at once, one per line.
"""

import difflib
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from estune.errors import EstuneError, InvalidInput
from estune.run import targets
from estune.support.toml_file import parse_toml
from estune.support.whole_file import replace_file
from plants.effects import Effect, find
from plants.models import model_tables
from plants.models.model_tables import KINDS, ModelKind, Reader

_BESIDE = ("effects", "uncertainty", "format")
"""Keys beside the table of the model."""

FORMAT = 1
"""Version of the files written, as their key `format`; a file without one has the first."""

_MOVED = {
    f"plants.discrepancy.models.calibration:{name}": f"plants.diagnosis.models.calibration:{name}"
    for name in ("Calibration", "SaggingCalibration")
}
"""References in files of earlier versions."""


def load_model(model: str | Path, **settings: Any) -> Any:
    """A model from a file, or from "module:attribute".

    Args:
        model: A TOML file such as `reel.toml`, or a name such as `plants:reference_reel`.
        **settings: Replace values of the file; or arguments of the named function.

    Returns:
        The model: anything with a `.rig()`.

    Raises:
        InvalidInput: there is no such model, or it is invalid; the message has one line per
            mistake.
    """
    if isinstance(model, str) and not model.endswith(targets.MODEL_FILE):
        return targets.load(model, settings)
    path = Path(model)
    return from_toml(_text(path), settings, source=str(path))


def save_model(model: Any, path: str | Path, note: str = "", plant: str = "") -> None:
    """Writes a model as a TOML file, atomically.

    Args:
        model: A reel or another plant of this package.
        path: The file; an existing one is replaced.
        note: Comment at the top.
        plant: Reference of a Python plant, module:attribute; a function cannot be written.

    Raises:
        InvalidInput: the model cannot be written as text, or the file cannot be written.
    """
    text = to_toml(model, note, plant)
    try:
        replace_file(Path(path), text.encode())
    except OSError as error:
        raise InvalidInput(
            f"{path}: {error.strerror or error}; give another file to save to"
        ) from error


def to_toml(model: Any, note: str = "", plant: str = "") -> str:
    """A model as TOML; see `save_model`.

    Raises:
        InvalidInput: the model cannot be written as text.
    """
    kind = next((kind for kind in KINDS if isinstance(model, kind.type)), None)
    if kind is None:
        raise InvalidInput(
            f"a {type(model).__name__} cannot be written as TOML; a model is one of "
            f"{model_tables.table_names()}"
        )
    values = kind.values(model)
    if kind.table == "python_plant":
        if not plant:
            raise InvalidInput(
                "a function cannot be written as TOML; give the plant's reference, as "
                'save_model(..., plant="module:attribute")'
            )
        values = {"plant": plant, **values}
    known = {_key_of(kind, name): share for name, share in model.uncertainty}
    lines = [f"# {line}".rstrip() for line in note.splitlines()]
    lines += [""] * bool(lines) + [
        f"format = {FORMAT}",
        "",
        f"[{kind.table}]",
        *model_tables.toml_lines(values),
    ]
    if known:
        lines += ["", "[uncertainty]", *model_tables.toml_lines(known)]
    for effect in getattr(model, "effects", ()):
        values = {name: getattr(effect, name) for name in effect.parameters()}
        named = {"name": reference_of(type(effect)), **values}
        lines += ["", f"# {effect.title}", "[[effects]]", *model_tables.toml_lines(named)]
    return "\n".join(lines) + "\n"


def reference_of(effect: type[Effect]) -> str:
    """Reference by which `plants.effects.find` returns the effect: slug or module:attribute.

    Raises:
        InvalidInput: there is none, as for an effect defined in a notebook or a function.
    """
    for name in (effect.name, f"{effect.__module__}:{effect.__qualname__}"):
        try:
            if effect.__module__ != "__main__" and find(name) is effect:
                return name
        except InvalidInput:
            continue
    raise InvalidInput(
        f"effect {effect.name} cannot be named in a file: {effect.__module__}:"
        f"{effect.__qualname__} does not lead to it; define it in a module of its own"
    )


def from_toml(
    text: str, settings: Mapping[str, Any] | None = None, source: str = "the model"
) -> Any:
    """The model described by a TOML text.

    Args:
        text: The text.
        settings: Replace values of the text, by key of the model's own table.
        source: Name of the text in messages.

    Raises:
        InvalidInput: the text is invalid; the message has one line per mistake.
    """
    tables = parse_toml(text, source)
    if tables.get("format", FORMAT) != FORMAT:
        raise InvalidInput(
            f"{source}: format {tables['format']!r} is unknown; this estune reads models of "
            f"format {FORMAT}: use the estune that wrote it, or a newer one"
        )
    problems: list[str] = []
    kind = _kind(tables, problems)
    model: Any = None
    if kind is not None:
        model = _model(kind, {**tables[kind.table], **(settings or {})}, problems)
        model = _with_uncertainty(kind, model, tables.get("uncertainty", {}), problems)
    for number, effect in _effects(tables.get("effects", []), problems):
        if model is None:
            continue
        place = f"[[effects]] {number} ({effect.name})"
        if not hasattr(model, "effects"):
            problems.append(f"{place}: a {type(model).__name__} takes no effects")
            continue
        try:
            model = model + effect
        except EstuneError as error:
            problems.append(f"{place}: {error}")
    if problems:
        raise InvalidInput("\n".join(f"{source}: {problem}" for problem in problems))
    return model


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise InvalidInput(
            f"{path}: {error.strerror or error}; give a model file, or module:attribute such as "
            "plants:reference_reel"
        ) from error
    except UnicodeDecodeError as error:
        raise InvalidInput(f"{path}: this is not text in UTF-8, as TOML is: {error}") from error


def _kind(tables: Mapping[str, Any], problems: list[str]) -> ModelKind | None:
    known = [kind.table for kind in KINDS]
    problems += [
        f"[{name}]: there is no such table{_near(name, [*known, *_BESIDE])}"
        for name in tables
        if name not in known and name not in _BESIDE
    ]
    given = [kind for kind in KINDS if kind.table in tables]
    if len(given) != 1:
        which = f"it has [{'] and ['.join(k.table for k in given)}]" if given else "it has none"
        problems.append(f"a model is one table of {model_tables.table_names()}; {which}")
        return None
    if not isinstance(tables[given[0].table], dict):
        problems.append(
            f"{given[0].table}: this is a value, not a table; write [{given[0].table}]"
        )
        return None
    return given[0]


def _model(kind: ModelKind, values: Mapping[str, Any], problems: list[str]) -> Any:
    place = f"[{kind.table}]"
    return _make(kind.make, _read_values(values, kind.keys, place, problems), place, problems)


def _key_of(kind: ModelKind, name: str) -> str:
    keys: Mapping[str, str] = getattr(kind.type, "FIELDS", {})
    return next((key for key, of in keys.items() if of == name), name)


def _with_uncertainty(kind: ModelKind, model: Any, table: Any, problems: list[str]) -> Any:
    """The model with the standard deviations of a table."""
    if not isinstance(table, dict):
        problems.append("uncertainty: this is a value, not a table; write [uncertainty]")
        return model
    keys = {_key_of(kind, name): name for name in kind.type.uncertain}
    if table and not keys:
        problems.append(f"[uncertainty]: nothing of a [{kind.table}] is known beforehand")
        return model
    readers = dict.fromkeys(keys, model_tables.read_share)
    shares = _read_values(table, readers, "[uncertainty]", problems)
    if model is None or not shares:
        return model
    return replace(model, uncertainty=tuple((keys[key], share) for key, share in shares.items()))


def _effects(tables: Any, problems: list[str]) -> list[tuple[int, Effect]]:
    if not (isinstance(tables, list) and all(isinstance(table, dict) for table in tables)):
        problems.append("effects: these are tables; begin each with [[effects]]")
        return []
    effects = [(n, _effect(table, n, problems)) for n, table in enumerate(tables, 1)]
    return [(n, effect) for n, effect in effects if effect is not None]


def _effect(table: Mapping[str, Any], number: int, problems: list[str]) -> Effect | None:
    place, name = f"[[effects]] {number}", table.get("name")
    if not isinstance(name, str):
        problems.append(f'{place}: its name is missing; give one as name = "coulomb_friction"')
        return None
    try:
        effect = find(_MOVED.get(name, name))
    except InvalidInput as error:
        problems.append(f"{place} name: {error}")
        return None
    values = {key: value for key, value in table.items() if key != "name"}
    keys = dict.fromkeys(effect.parameters(), model_tables.read_number)
    good = _read_values(values, keys, f"{place} ({name})", problems)
    made: Effect | None = _make(effect, good, f"{place} ({name})", problems)
    return made


def _read_values(
    values: Mapping[str, Any],
    keys: Mapping[str, Reader],
    place: str,
    problems: list[str],
) -> dict[str, Any]:
    """The values with a known key and a valid form; mistakes go to `problems`."""
    good = {}
    for name, value in values.items():
        if name not in keys:
            problems.append(f"{place} {name}: there is no such key{_near(name, keys)}")
            continue
        try:
            good[name] = keys[name](value)
        except InvalidInput as error:
            problems.append(f"{place} {name}: {error}")
    return good


def _make(
    make: Callable[..., Any], values: dict[str, Any], place: str, problems: list[str]
) -> Any:
    """Makes an object; a value that is rejected by name is reported and omitted."""
    while True:
        try:
            return make(**values)
        except EstuneError as error:
            message = str(error)
        wrong = next((name for name in re.findall(r"\w+", message) if name in values), None)
        problems.append(f"{place} {wrong}: {message}" if wrong else f"{place}: {message}")
        if wrong is None:
            return None
        values = {name: value for name, value in values.items() if name != wrong}


def _near(name: str, known: Iterable[str]) -> str:
    """Hint at the closest known name, or at all names."""
    names = list(known)
    near = difflib.get_close_matches(name, names, 1)
    return f"; did you mean {near[0]}?" if near else f"; there are {', '.join(sorted(names))}"
