"""Files of settings: TOML, units in the keys, all that is wrong told at once with its path."""

import copy
import difflib
import inspect
import tomllib
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from estune.errors import InvalidInput


class TomlTable(BaseModel):
    """A table of a file: no unknown keys, no silent conversions, no NaN or infinity."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


_Table = TypeVar("_Table", bound=TomlTable)


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        InvalidInput: it cannot be read, or is no TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    except tomllib.TOMLDecodeError as error:
        raise InvalidInput(f"{path}: no TOML: {error}") from error


def validate(kind: type[_Table], data: dict[str, Any], source: str) -> _Table:
    """What was read, as the table it should be.

    Args:
        kind: The table.
        data: What was read.
        source: Where from, for the message.

    Raises:
        InvalidInput: something in it is wrong; all of it is in the message, a line each.
    """
    lines: dict[str, None] = {}
    removed: set[tuple[int | str, ...]] = set()
    while True:
        try:
            found = kind.model_validate(data)
        except ValidationError as error:
            faults = error.errors(include_url=False, include_context=False)
            new = [fault for fault in faults if fault["loc"] not in removed]
            lines |= dict.fromkeys(line for fault in new for line in _lines(fault, kind))
            # What one key says about another is looked at only where each is right by itself: the
            # rest is looked at again without those that are not.
            wrong = {fault["loc"] for fault in new if _has(data, fault["loc"])}
            if not wrong:
                break
            removed |= wrong
            data = _without(data, wrong)
        else:
            break
    if lines:
        raise InvalidInput("\n".join(f"{source}: {line}" for line in lines))
    return found


def _lines(fault: ErrorDetails, kind: type[TomlTable]) -> Iterator[str]:
    where = ".".join(map(str, fault["loc"]))
    if fault["type"] == "extra_forbidden":
        known = _keys(kind, fault["loc"][:-1])
        near = difflib.get_close_matches(str(fault["loc"][-1]), known, 1, 0.5)
        hint = f"did you mean {near[0]}?" if near else f"the keys are {', '.join(known)}"
        yield f"{where}: there is no such key; {hint}"
        return
    own = _keys(kind, fault["loc"])
    for sentence in fault["msg"].removeprefix("Value error, ").split("\n"):
        # What a table says of one of its keys begins with the key.
        key, colon, _ = sentence.partition(": ")
        deeper = colon and key.partition(".")[0] in own
        yield f"{where}{'.' if deeper and where else ': ' if where else ''}{sentence}"


def _has(table: Any, place: tuple[int | str, ...]) -> bool:
    """Whether a key is there to be taken out; items of lists and whole tables stay."""
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
    """The keys of the table at a place."""
    found: type[TomlTable] = kind
    for step in place:
        if isinstance(step, str) and step in found.model_fields:
            found = _table_in(found.model_fields[step].annotation) or found
    return list(found.model_fields)


def _table_in(annotation: Any) -> type[TomlTable] | None:
    """The table that a field holds, itself or as an item."""
    if inspect.isclass(annotation) and issubclass(annotation, TomlTable):
        return annotation
    inner = (_table_in(argument) for argument in typing.get_args(annotation))
    return next((table for table in inner if table is not None), None)
