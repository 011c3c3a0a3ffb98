"""Settings files: TOML with units in the keys; all errors are reported at once with their path."""

import copy
import difflib
import inspect
import tomllib
import typing
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from estune.errors import InvalidInput
from estune.support.file_limits import SETTINGS_MAX, check_size, check_values
from estune.support.plain_fault import plain_fault


class TomlTable(BaseModel):
    """A table of a file, without unknown keys, implicit conversions, NaN or infinity."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


_Table = TypeVar("_Table", bound=TomlTable)


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        InvalidInput: the file cannot be read, or is not TOML.
    """
    try:
        check_size(path, path.stat().st_size, SETTINGS_MAX)
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    return parse_toml(text, str(path))


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """The tables of a text from a source.

    Raises:
        InvalidInput: it is no TOML, or has values that cannot be used.
    """
    try:
        # Editors on Windows write a byte-order mark, which TOML does not allow.
        found = tomllib.loads(text.removeprefix("\ufeff"))
    except tomllib.TOMLDecodeError as error:
        raise InvalidInput(f"{source}: no TOML: {error}") from error
    except RecursionError as error:
        raise InvalidInput(f"{source}: nested too deeply; write it flatter") from error
    check_values(found, source)
    return found


def validate(kind: type[_Table], data: dict[str, Any], source: str) -> _Table:
    """The validated table.

    Raises:
        InvalidInput: the values are not valid; the message has a line for each error.
    """
    lines: dict[str, None] = {}
    removed: set[tuple[int | str, ...]] = set()
    while True:
        try:
            table = kind.model_validate(data)
        except ValidationError as error:
            faults = error.errors(include_url=False, include_context=False)
            new = [fault for fault in faults if fault["loc"] not in removed]
            lines |= dict.fromkeys(line for fault in new for line in _lines(fault, kind, removed))
            # Checks of one key against another run only on keys that are valid by themselves: the
            # rest is validated again without the invalid ones.
            wrong = {fault["loc"] for fault in new if _has(data, fault["loc"])}
            if not wrong:
                break
            removed |= wrong
            data = _without(data, wrong)
        else:
            break
    if lines:
        raise InvalidInput("\n".join(f"{source}: {line}" for line in lines))
    return table


def _lines(
    fault: ErrorDetails, kind: type[TomlTable], removed: Collection[tuple[int | str, ...]]
) -> Iterator[str]:
    where = ".".join(map(str, fault["loc"]))
    if fault["type"] == "extra_forbidden":
        known = _keys(kind, fault["loc"][:-1])
        near = difflib.get_close_matches(str(fault["loc"][-1]), known, 1, 0.5)
        hint = f"did you mean {near[0]}?" if near else f"the keys are {', '.join(known)}"
        yield f"{where}: there is no such key; {hint}"
        return
    own = _keys(kind, fault["loc"])
    if fault["type"] == "list_type" and own != list(kind.model_fields):
        yield f"{where}: must be a list of tables; write each of them as [[{where}]]"
        return
    for sentence in plain_fault(fault["msg"]).split("\n"):
        # An error that a table reports of one of its keys begins with the key.
        key, colon, _ = sentence.partition(": ")
        deeper = colon and key.partition(".")[0] in own
        if (*fault["loc"], *key.split(".")) in removed:  # reported as invalid already
            continue
        yield f"{where}{'.' if deeper and where else ': ' if where else ''}{sentence}"


def _has(table: Any, place: tuple[int | str, ...]) -> bool:
    """Whether a key can be removed; items of lists and whole tables stay."""
    if not place or not isinstance(place[-1], str):
        return False
    for step in place[:-1]:
        if not _holds(table, step):
            return False
        table = table[step]
    return isinstance(table, dict) and place[-1] in table


def _holds(table: Any, step: int | str) -> bool:
    if isinstance(table, list):
        return isinstance(step, int) and step < len(table)
    return isinstance(table, dict) and step in table


def _without(data: dict[str, Any], places: Iterable[tuple[int | str, ...]]) -> dict[str, Any]:
    left = copy.deepcopy(data)
    for place in sorted(places, key=len, reverse=True):
        table: Any = left
        for step in place[:-1]:
            table = table[step]
        del table[place[-1]]
    return left


def _keys(kind: type[TomlTable], place: tuple[int | str, ...]) -> list[str]:
    table: type[TomlTable] = kind
    for step in place:
        if isinstance(step, str) and step in table.model_fields:
            table = _table_in(table.model_fields[step].annotation) or table
    return list(table.model_fields)


def _table_in(annotation: Any) -> type[TomlTable] | None:
    """The table class of a field, or of its items."""
    if inspect.isclass(annotation) and issubclass(annotation, TomlTable):
        return annotation
    inner = (_table_in(argument) for argument in typing.get_args(annotation))
    return next((table for table in inner if table is not None), None)
