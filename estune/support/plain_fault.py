"""What pydantic says of an invalid value, in the words of this program."""

import re

_PLAIN = {
    r"^Value error, ": "",
    r"^Field required$": "is missing",
    r"^Input should ": "must ",
    r"^List should have (at \w+ \d+ items?) after validation, not (\d+)": r"must have \1, not \2",
    r"\ba valid integer.*": "a whole number",
    r"\ba valid string$": "text, in quotes",
    r"\ba valid boolean$": "true or false",
    r"\ba valid dictionary.*": "a table",
    r"\ba valid (tuple|list|array)$": "a list, in brackets",
    r"\ba valid ": "a ",
}
"""Patterns of its messages, and what takes their place."""


def plain_fault(message: str) -> str:
    """The message, as what follows the name of the value and a colon."""
    for said, told in _PLAIN.items():
        message = re.sub(said, told, message)
    return message
