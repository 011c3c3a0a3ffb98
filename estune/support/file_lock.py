"""A lock on an open file, released by the system when its process dies."""

import importlib
from typing import IO, Any


def lock(file: IO[Any], *, shared: bool = False) -> None:
    """Locks an open file for this process alone, or against such locks only; returns at once.

    Raises:
        BlockingIOError: another process has it.
    """
    try:
        fcntl = importlib.import_module("fcntl")
    except ImportError:  # Windows
        _lock_on_windows(file)
        return
    fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)


def _lock_on_windows(file: IO[Any]) -> None:
    """Locks a byte far behind what is written, so that others can still read who has the file."""
    msvcrt = importlib.import_module("msvcrt")
    position = file.tell()
    file.seek(2**30)
    try:
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    except OSError as error:
        raise BlockingIOError(str(error)) from error
    finally:
        file.seek(position)
