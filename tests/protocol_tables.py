"""Messages of the rig protocol as tables and dumps of Markdown, from types and docstrings."""

import inspect
import json
import re
import types
from collections.abc import Iterable, Iterator
from dataclasses import MISSING, fields
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import Mode
from estune.trial import (
    Outcome,
    TrialRecord,
)
from estune.trial.profiles import PROFILES


def table(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> Iterator[str]:
    """A table of Markdown."""
    columns = tuple(head)
    for row in (columns, ("---",) * len(columns), *rows):
        yield f"| {' | '.join(map(str, row))} |\n"


def message_section(kind: type) -> Iterator[str]:
    """Name, meaning and fields of a message."""
    yield f"### {kind.__name__}\n\n{title(kind)}\n\n"
    yield from fields_table(kind)


def fields_table(kind: type, others: dict[str, Any] | None = None) -> Iterator[str]:
    """The fields of a message as a table."""
    if not fields(kind):
        yield "No fields: `{}`.\n\n"
        return
    hints, meanings = get_type_hints(kind), _attributes(kind)
    if others:
        meanings = _attributes(TrialRecord) | meanings
    rows = []
    for field in fields(kind):
        default = "" if field.default is MISSING else f"; default {json_code(field.default)}"
        meaning = meanings.get(field.name, _OWN.get(field.name, "")).replace("|", "\\|")
        rows.append((f"`{field.name}`", f"{_type(hints[field.name])}{default}", meaning))
    yield from table(("field", "type", "meaning"), rows)
    yield "\n"


_OWN = {
    "columns": "The columns that follow, in this order: the five of a record, and those "
    "of the optional ones that there are. `flags` is always the last and is not named.",
    "samples": "Number of samples in each column.",
}


def json_code(value: object) -> str:
    """A value as JSON, in code."""
    return f"`{json.dumps(value)}`"


_PLAIN: dict[Any, str] = {
    float: "number",
    int: "integer",
    str: "string",
    bool: "true or false",
    type(None): "null",
    Outcome: "an outcome",
    **dict.fromkeys(PROFILES, "a profile"),
    ReplyCode: "a reply code",
    Mode: "a mode",
}


def _type(hint: Any) -> str:
    """JSON name of a type."""
    origin, inside = get_origin(hint), get_args(hint)
    if hint in _PLAIN:
        return _PLAIN[hint]
    if origin is Literal:
        return " or ".join(f"`{json.dumps(value)}`" for value in inside)
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(_type, inside)))
    if origin is tuple:
        return f"array of {_type(inside[0])}"
    return link(hint.__name__)


def link(name: str) -> str:
    """A link to the section of a message."""
    return f"[{name}](#{name.lower()})"


def title(thing: Any) -> str:
    """First line of a docstring."""
    text = inspect.getdoc(thing) or ""
    return text.split("\n")[0]


def default(kind: type, name: str) -> str:
    """Default of a field."""
    return str(next(f.default for f in fields(kind) if f.name == name))


def _attributes(kind: type) -> dict[str, str]:
    """Meanings of the attributes, from a docstring."""
    text = inspect.getdoc(kind) or ""
    _, _, section = text.partition("Attributes:\n")
    found: dict[str, str] = {}
    name = ""
    for line in section.split("\n"):
        if not line.strip() and found:
            break
        if (match := re.match(r"    (\w+): (.*)", line)) is not None:
            name = match[1]
            found[name] = match[2]
        elif name:
            found[name] += f" {line.strip()}"
    return found


def hex_dump(data: bytes) -> Iterator[str]:
    """Hexadecimal dump: offset, sixteen bytes, and their text."""
    yield "```text\n"
    for at in range(0, len(data), 16):
        line = data[at : at + 16]
        text = "".join(chr(byte) if 32 <= byte < 127 else "." for byte in line)
        yield f"{at:04x}  {line.hex(' '):47}  {text}".rstrip() + "\n"
    yield "```\n"
