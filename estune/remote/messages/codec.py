"""JSON encoding of messages, with their size limits.

Unknown fields, missing fields, wrong types, NaN and infinities are refused on arrival. Strings
arrive printable: they end on terminals and in logs.
"""

from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from estune.errors import ProtocolError
from estune.support.printable import printable_json
from estune.trial import record_frame

if TYPE_CHECKING:
    from pydantic import TypeAdapter

COMMAND_MAX_BYTES = 2 * 2**10
"""Largest command: the request buffer of a microcontroller."""
ANSWER_MAX_BYTES = 64 * 2**10
HOLDER_MAX = 128
"""Characters in the name of a lease holder or the reason of an emergency stop."""

_AnyMessage = TypeVar("_AnyMessage", bound="Message")


class Message:
    """Base of the messages, each a frozen dataclass; by itself a command."""

    __slots__ = ()
    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True, "allow_inf_nan": False}
    max_bytes: ClassVar[int] = COMMAND_MAX_BYTES


def encode(message: Message) -> bytes:
    """A message as JSON.

    Raises:
        ProtocolError: it is too large, or JSON cannot represent it.
    """
    kind = type(message)
    try:
        text = _adapter(kind).dump_json(message, warnings=False)
    except ValueError as error:
        raise ProtocolError(f"{kind.__name__} message: {record_frame.one_line(error)}") from error
    _check_size(kind, text)
    return text


def decode(kind: type[_AnyMessage], data: bytes) -> _AnyMessage:
    """The message of a kind in the JSON of a payload.

    Raises:
        ProtocolError: it is too large, or not a valid message of this kind.
    """
    _check_size(kind, data)
    try:
        message: _AnyMessage = _adapter(kind).validate_json(printable_json(data))
    except (ValueError, OverflowError) as error:  # an integer may have hundreds of digits
        raise ProtocolError(f"{kind.__name__} message: {record_frame.one_line(error)}") from error
    return message


def _check_size(kind: type[Message], data: bytes) -> None:
    if len(data) > kind.max_bytes:
        raise ProtocolError(
            f"{kind.__name__} message of {len(data)} bytes; the limit is {kind.max_bytes}: "
            "use shorter names"
        )


_adapters: "dict[type[Message], TypeAdapter[Any]]" = {}


def _adapter(kind: type[Message]) -> "TypeAdapter[Any]":
    if kind not in _adapters:
        from pydantic import TypeAdapter  # noqa: PLC0415  slow to import, not always needed

        _adapters[kind] = TypeAdapter(kind)
    return _adapters[kind]
