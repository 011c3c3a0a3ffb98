"""Text from outside, made safe to print: no terminal obeys it, and it cannot forge a line."""

import json
import re
from typing import Any

from estune.support.file_limits import parse_json

_OBEYED = re.compile(
    "[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""Control characters, ends of lines, marks of direction, and halves of characters."""


def printable(text: str) -> str:
    """The text with what a terminal would obey as visible escapes."""
    return _OBEYED.sub(lambda found: ascii(found[0])[1:-1], text)


def printable_json(data: bytes) -> bytes:
    """JSON with every string printable, keys included.

    Raises:
        ValueError: it is no JSON, or nested too deeply.
    """
    if data.isascii() and b"\\" not in data:
        return data  # a control character would be an escape, or an error of its own
    try:
        found = parse_json(data.decode())
        return json.dumps(_printable(found), ensure_ascii=False).encode()
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def _printable(value: Any) -> Any:
    match value:
        case str():
            return printable(value)
        case list():
            return [_printable(item) for item in value]
        case dict():
            return {printable(key): _printable(item) for key, item in value.items()}
        case _:
            return value
