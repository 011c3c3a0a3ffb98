"""Messages of the rig protocol as tables and dumps of Markdown, from types and docstrings."""

import inspect
import json
import re
import types
from collections.abc import Collection, Iterable, Iterator
from dataclasses import MISSING, fields
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from estune.remote.state_machine.reply_codes import ReplyCode
from estune.remote.state_machine.state import Mode
from estune.trial import Outcome
from estune.trial.profiles import AnyProfile

PROFILES: tuple[type[AnyProfile], ...] = get_args(AnyProfile)


def table(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> Iterator[str]:
    """A table of Markdown."""
    columns = tuple(head)
    for row in (columns, ("---",) * len(columns), *rows):
        yield f"| {' | '.join(map(str, row))} |\n"


def message_section(
    kind: type, remark: str = "", known: set[tuple[str, str]] | None = None
) -> Iterator[str]:
    """Name, meaning and fields of a message.

    Args:
        kind: The message.
        remark: Text after its meaning.
        known: Names and meanings of fields that earlier messages have; those of this one are
            added. A field that they have with its meaning is left out: the example shows it.
    """
    yield f"### {kind.__name__}\n\n{title(kind)}{remark}\n\n"
    if not fields(kind):
        yield "No fields: `{}`.\n\n"
        return
    said = set(_attributes(kind).items())
    yield from fields_list(kind, leave_out={name for name, _ in said & (known or set())})
    if known is not None:
        known |= said


def fields_list(
    kind: type, base: type | None = None, leave_out: Collection[str] = ()
) -> Iterator[str]:
    """The fields of a message as a list: name, type, default, meaning.

    Args:
        kind: The message.
        base: A class that says what fields mean whose meaning the message leaves to it.
        leave_out: Names of fields that are left out.
    """
    hints = get_type_hints(kind)
    meanings = (_attributes(base) if base else {}) | _attributes(kind)
    for field in fields(kind):
        if field.name in leave_out:
            continue
        default = "" if field.default is MISSING else f", default {json_code(field.default)}"
        meaning = meanings.get(field.name, _OWN.get(field.name, ""))
        yield f"* `{field.name}` ({_type(hints[field.name])}{default}): {meaning}\n"
    yield "\n"


def profile_sections(kinds: Iterable[type], known: Collection[str] = ()) -> Iterator[str]:
    """Setpoint profiles: formula, fields in order, and what those mean that are new.

    Args:
        kinds: The profiles.
        known: Names of fields whose meaning the reader knows.
    """
    seen = {"kind", *known}
    for kind in kinds:
        text = inspect.getdoc(kind) or ""
        prose = text.split("Attributes:")[0].partition("\n")[2].strip("\n")
        yield f"### {kind.__name__}: `{default(kind, 'kind')}`\n\n{title(kind)}\n\n"
        yield f"```text\n{inspect.cleandoc(prose)}\n```\n\n" if prose else ""
        if seen & {field.name for field in fields(kind)} > {"kind"}:
            yield f"Fields: {', '.join(f'`{field.name}`' for field in fields(kind))}.\n\n"
        yield from fields_list(kind, leave_out=seen)
        seen |= {field.name for field in fields(kind)}


_OWN = {
    "columns": "The columns that follow, without the flags.",
    "samples": "Number of samples in each column.",
}


def json_code(value: object) -> str:
    """A value as JSON, in code."""
    return f"`{json.dumps(value)}`"


OPTIONAL = ("ControllerForm", "LinearModel", "GainBounds", "Setpoint", "Feedback", "Following")
"""Messages and parts of docs/reference/rig-options.md that others name."""

_PLAIN: dict[Any, str] = {
    float: "number",
    int: "integer",
    str: "string",
    bool: "true or false",
    type(None): "null",
    Outcome: "an outcome",
    **dict.fromkeys(get_args(AnyProfile), "a profile"),
    ReplyCode: "a reply code",
    Mode: "a mode",
}


def _type(hint: Any) -> str:
    """JSON name of a type."""
    origin, inside = get_origin(hint), get_args(hint)
    if hint in _PLAIN:
        return _PLAIN[hint]
    if origin is Literal:
        return ", ".join(f"`{json.dumps(value)}`" for value in inside)
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(_type, inside)))
    if origin is tuple:
        return f"array of {_type(inside[0])}"
    return link(hint.__name__)


def link(name: str) -> str:
    """A link to the section of a message, on either page."""
    other = "rig-options.md" if name in OPTIONAL else ""
    return f"[{name}]({other}#{name.lower()})"


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
    """Hexadecimal dump: offset, 32 bytes in words of eight, and their text."""
    yield "```text\n"
    for at in range(0, len(data), 32):
        line = data[at : at + 32]
        text = "".join(chr(byte) if 32 <= byte < 127 else "." for byte in line)
        yield f"{at:04x}  {line.hex(' ', -8):67}  {text}".rstrip() + "\n"
    yield "```\n"
