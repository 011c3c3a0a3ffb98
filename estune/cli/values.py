"""Values written as text on the command line: `P=0.1:10`, `cable_length_m=1.1`."""

import ast
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from estune.errors import InvalidInput

if TYPE_CHECKING:
    from estune.remote.security import Security


def settings_from(texts: Iterable[str]) -> dict[str, Any]:
    """Settings written `name=value`; a value is a number, True, False or None, or else text.

    Raises:
        InvalidInput: one of them has no name or no value.
    """
    return dict(_setting(text) for text in texts)


def security_from(path: Path | None) -> "Security":
    """The settings in a security file; where none is named, nobody is asked who they are.

    Raises:
        InvalidInput: something in the file is wrong.
    """
    from estune.remote.security import OPEN, read_security  # noqa: PLC0415  slow to import

    return OPEN if path is None else read_security(path)


def numbers_from(texts: Iterable[str]) -> dict[str, float]:
    """Numbers written `name=number`.

    Raises:
        InvalidInput: one of them is not of that form.
    """
    return {name: _number(name, value) for name, value in map(_split, texts)}


def share_from(name: str, text: str) -> float:
    """A share written as a number or in per cent: 0.01 or 1%.

    Raises:
        InvalidInput: it is neither.
    """
    bare = text.removesuffix("%").strip()
    return _number(name, bare) * (1.0 if bare == text.strip() else 0.01)


def ranges_from(texts: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Ranges written `name=low:high`.

    Raises:
        InvalidInput: one of them is not of that form.
    """
    ranges = {}
    for name, value in map(_split, texts):
        low, colon, high = value.partition(":")
        if not colon:
            raise InvalidInput(f"{name}={value} is no range; write {name}=LOW:HIGH")
        ranges[name] = (_number(name, low), _number(name, high))
    return ranges


def _setting(text: str) -> tuple[str, Any]:
    name, value = _split(text)
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def _split(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name.strip() and equals and value.strip()):
        raise InvalidInput(f"{text!r} is not of the form NAME=VALUE")
    return name.strip(), value.strip()


def _number(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InvalidInput(f"{name}: {text!r} is not a number") from None
