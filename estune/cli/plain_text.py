"""Output in an encoding that lacks characters: plain text for them instead of a traceback."""

import codecs
import io
import sys
import unicodedata

_GREEK = "GREEK SMALL LETTER "
_PLAIN = {
    "PLUS-MINUS SIGN": "+/-",
    "DEGREE SIGN": " deg",
    "RIGHTWARDS ARROW": "->",
    "MINUS SIGN": "-",
    "EN DASH": "-",
    "MULTIPLICATION SIGN": "x",
    "LESS-THAN OR EQUAL TO": "<=",
    "GREATER-THAN OR EQUAL TO": ">=",
    "MIDDLE DOT": "*",
    "BULLET": "*",
    "RIGHT SINGLE QUOTATION MARK": "'",
}
"""Plain text by the name of a character."""


def plain(error: UnicodeError) -> tuple[str, int]:
    """Handler of characters that an encoding lacks: ASCII for them, or a question mark."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(map(_plain, error.object[error.start : error.end])), error.end


def _plain(character: str) -> str:
    name = unicodedata.name(character, "")
    if name.startswith(_GREEK):
        return name.removeprefix(_GREEK).lower()
    if name in _PLAIN:
        return _PLAIN[name]
    if name.startswith("BOX DRAWINGS"):
        return "-" if "HORIZONTAL" in name else "|"
    return unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode() or "?"


def allow_any_encoding() -> None:
    """Lets standard output and error take every text, whatever their encoding."""
    codecs.register_error("estune.plain", plain)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="estune.plain")
