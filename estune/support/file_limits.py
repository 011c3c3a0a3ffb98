"""What a file from outside may cost: bytes, memory, rows, length of a line, depth.

The one option, the environment variable `ESTUNE_FILE_LIMIT`, multiplies all of them but the depth.
"""

import importlib
import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from estune.errors import InvalidInput

OPTION = "ESTUNE_FILE_LIMIT"

SIZE_MAX = 2**30
"""Size of a file, bytes."""
SETTINGS_MAX = 2**24
"""Size of a file of settings, bytes."""
MEMORY_MIN = 2**29
MEMORY_PER_BYTE = 32
"""Memory for the reading of a file: the least, bytes, and beside it that per byte of the file.

Texts of 26 to 97 MB (CSV, JSON lines, line protocol) took 7 to 17 bytes a byte; a .mat of
0.78 MB whose 1e8 zeros are packed needs 1 000."""
ROWS_MAX = 100_000_000
LINE_MAX = 2**20
"""Length of a line at the head of a text, bytes."""
DEPTH_MAX = 64
"""Depth of nested tables and arrays; the example of a rig's file has 4."""

WHOLE_MAX = 10**300
"""Whole number that a float still holds: one of 400 digits ended in a traceback."""

_LINES = 400
_DIGITS_MAX = 300
_one_at_a_time = threading.RLock()


def factor() -> float:
    """The factor that the option states, 1 by default.

    Raises:
        InvalidInput: it is no number above zero.
    """
    text = os.environ.get(OPTION, "1")
    try:
        stated = float(text)
    except ValueError:
        stated = 0.0
    if not 0.0 < stated < 1e6:  # with `inf`, a float too, nothing would be limited
        raise InvalidInput(f"{OPTION} is {text!r}; give a number above zero, such as 4")
    return stated


def check_size(path: Path, size: int, most: int | None = None) -> None:
    """Raises `InvalidInput` if a file is too large."""
    most_bytes = (SIZE_MAX if most is None else most) * factor()
    if size > most_bytes:
        raise _too_much(f"{path.name} has {size} bytes, {most_bytes:.0f}")


def check_rows(rows: int) -> None:
    """Raises `InvalidInput` if a file has too many rows."""
    if rows > ROWS_MAX * factor():
        raise _too_much(f"the file has {rows} rows, {ROWS_MAX * factor():.0f}")


def check_lines(path: Path) -> None:
    """Raises `InvalidInput` if a line at the head of a text is too long."""
    most = int(LINE_MAX * factor())
    with path.open("rb") as file:
        for number in range(1, _LINES + 1):
            line = file.readline(most + 1)
            if len(line) > most:
                raise _too_much(f"line {number} is longer than {most} bytes, which")
            if not line:
                return


def check_values(value: Any, path: Path | str) -> None:
    """Raises `InvalidInput` if values are nested too deeply, or whole numbers are too large."""
    level, depth = [value], 0
    while level := [
        inner
        for outer in level
        if isinstance(outer, dict | list)
        for inner in (outer.values() if isinstance(outer, dict) else outer)
    ]:
        depth += 1
        if depth > DEPTH_MAX:
            raise InvalidInput(f"{path}: nested more than {DEPTH_MAX} deep; write it flatter")
        if any(isinstance(inner, int) and abs(inner) > WHOLE_MAX for inner in level):
            raise InvalidInput(f"{path}: a whole number is above {WHOLE_MAX:g}; correct it")


def parse_json(data: bytes | str) -> Any:
    """JSON of a file from outside; a whole number that no float holds is infinite.

    Raises:
        ValueError: it is none, or is nested too deeply.
    """
    try:
        return json.loads(data, parse_int=_whole)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def _whole(digits: str) -> int | float:
    return int(digits) if len(digits) <= _DIGITS_MAX else float(digits)


@contextmanager
def bounded_memory(size: int) -> Iterator[None]:
    """Bounds the memory that this process may take for the reading of a file while it lasts.

    Whatever unpacks the file then gets a `MemoryError`. Threads that read wait for each other. On
    a system without such limits nothing is bounded.

    Raises:
        InvalidInput: the reading took more.
    """
    most = int((MEMORY_MIN + MEMORY_PER_BYTE * size) * factor())
    try:
        resource = importlib.import_module("resource")
        taken = int(Path("/proc/self/statm").read_text("ascii").split()[5])
    except (ImportError, OSError):
        yield
        return
    with _one_at_a_time:
        kind, unlimited = resource.RLIMIT_DATA, resource.RLIM_INFINITY
        soft, hard = resource.getrlimit(kind)
        bound = taken * resource.getpagesize() + most
        bound = bound if soft == unlimited else min(bound, soft)
        resource.setrlimit(kind, (bound, hard))
        try:
            yield
        except MemoryError as error:
            raise _too_much(
                f"to unpack the file takes more than {most / 2**20:.0f} MB, which"
            ) from error
        finally:
            resource.setrlimit(kind, (soft, hard))


def _too_much(what: str) -> InvalidInput:
    return InvalidInput(
        f"{what} is the limit; export a shorter part, or, if you trust the file, raise all limits "
        f"with {OPTION}=4 in the environment"
    )
