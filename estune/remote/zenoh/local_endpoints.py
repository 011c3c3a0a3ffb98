"""Endpoints at which processes of this user listen on this machine, each noted in a locked file.

The system releases the lock when the process dies, however it dies: a file without a lock is that
of a process that has ended. Nobody else can write into the folder.
"""

import os
import secrets
import stat
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import IO

from estune.support.file_lock import lock

_SUFFIX = ".endpoint"


class EndpointNote:
    """The note of a listener, until `close`; none where it cannot be written."""

    def __init__(self, endpoint: str) -> None:
        self._path: Path | None = None
        self._file: IO[str] | None = None
        with suppress(OSError):
            name = secrets.token_hex(8)
            written = _folder() / f".{name}.part"
            self._file = written.open("x", encoding="utf-8")
            lock(self._file)
            self._file.write(endpoint)
            self._file.flush()
            self._path = written.replace(written.with_name(f"{name}{_SUFFIX}"))

    def close(self) -> None:
        """Removes the note."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)
        if self._file is not None:
            self._file.close()


def local_endpoints() -> tuple[str, ...]:
    """Endpoints at which processes of this user listen now; notes of others are removed."""
    found = []
    with suppress(OSError):
        for path in sorted(_folder().glob(f"*{_SUFFIX}")):
            with suppress(OSError), path.open(encoding="utf-8") as file:
                try:
                    lock(file, shared=True)
                except BlockingIOError:  # its process lives
                    found.append(file.read())
                else:
                    path.unlink(missing_ok=True)
    return tuple(found)


def _folder() -> Path:
    """The folder of notes.

    Raises:
        OSError: it is not this user's alone.
    """
    user = os.getuid() if hasattr(os, "getuid") else ""
    folder = Path(tempfile.gettempdir()) / f"estune-endpoints-{user}"
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.lstat()
    is_own = user == "" or (status.st_uid == user and not status.st_mode & 0o077)
    if not stat.S_ISDIR(status.st_mode) or not is_own:
        raise PermissionError(f"{folder} belongs to others too")
    return folder
