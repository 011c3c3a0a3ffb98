"""Files that are written completely or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from estune.errors import InvalidInput


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary file beside the path, renamed to it at the end of the block."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def replace_file(path: Path, content: bytes) -> None:
    """Writes a file completely or not at all."""
    with whole_file(path) as temporary:
        temporary.write_bytes(content)


def write_file(path: Path, content: bytes) -> None:
    """Writes a file of the user's choice completely or not at all.

    Raises:
        InvalidInput: it cannot be written.
    """
    try:
        replace_file(path, content)
    except OSError as error:
        raise InvalidInput(f"{path}: {error.strerror or error}; give another file") from error
