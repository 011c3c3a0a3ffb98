"""SQLite files that lose nothing: how they are opened, locked, brought up to date and explained.

In WAL mode with synchronous=FULL what was committed survives kill -9 and a power cut, and readers
never block the writer. One process writes; a lock that dies with it keeps a second one out. The
file's `user_version` says which schema it has.
"""

import fcntl
import getpass
import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

from estune.errors import JournalError


def connect(opened: ExitStack, path: Path, mode: str) -> sqlite3.Connection:
    """A connection whose transactions are ours to begin and end, closed with the stack.

    Args:
        opened: What closes it.
        path: The file.
        mode: `ro`, `rw` or `rwc`, and what else SQLite takes in an address.
    """
    address = f"{path.resolve().as_uri()}?mode={mode}"
    connection = sqlite3.connect(
        address, uri=True, isolation_level=None, timeout=2.0, check_same_thread=False
    )
    opened.callback(connection.close)
    connection.execute("PRAGMA synchronous=FULL")
    return connection


def lock(path: Path, what: str) -> IO[str]:
    """The right to write, held until closed and let go by the system if the process dies.

    Args:
        path: The lock's own file; who holds it is written into it.
        what: What is being written, for the message.

    Raises:
        JournalError: another process holds it.
    """
    held = path.open("a+", encoding="utf-8")
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        held.seek(0)
        holder = held.readline().strip()
        held.close()
        raise JournalError(
            f"{what} is being written by another process{holder and f' ({holder})'}; "
            "wait for it or stop it"
        ) from None
    held.truncate(0)
    held.write(f"process {os.getpid()} of {_user()}\n")
    held.flush()
    return held


def being_written(path: Path) -> bool:
    """Whether a process holds the lock in this file."""
    try:
        with path.open() as held:
            fcntl.flock(held, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # never taken, or this user may not look: nothing says it is written
        return False
    return False


def inode(path: Path) -> tuple[int, int] | None:
    """Tells the file at a path from any other that may take its place; None if there is none."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_dev, found.st_ino


def version(connection: sqlite3.Connection) -> int:
    """The schema a file has; 0 if it has none yet."""
    return int(connection.execute("PRAGMA user_version").fetchone()[0])


def check_version(connection: sqlite3.Connection, path: Path, newest: int, what: str) -> None:
    """Refuses a file that this program cannot know.

    Raises:
        JournalError: it is from a newer version, or was never made by one.
    """
    found = version(connection)
    if not 1 <= found <= newest:
        remedy = "use a newer" if found > newest else f"it is not {what} of"
        raise JournalError(
            f"{path} has schema version {found}, this estune knows {newest}; {remedy} estune"
        )


def migrate(connection: sqlite3.Connection, versions: Sequence[str]) -> None:
    """Brings a file to the newest schema, inside the caller's transaction.

    Args:
        connection: The file, locked by the caller; a new one is empty.
        versions: SQL that makes schema n + 1 out of schema n, for n = 0 (an empty file) and on.
    """
    for number in range(version(connection), len(versions)):
        for statement in versions[number].split(";"):
            connection.execute(statement)
        connection.execute(f"PRAGMA user_version={number + 1}")


def check_whole(connection: sqlite3.Connection, path: Path) -> None:
    """Refuses a damaged file.

    Raises:
        JournalError: it is damaged.
    """
    fault = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
    if fault != "ok":
        raise JournalError(f"{path} is damaged ({fault}); restore it from a copy")


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[None]:
    """All that is written in the block is committed at its end, or nothing of it."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        raise


@contextmanager
def explained(path: Path, go_on: str) -> Iterator[None]:
    """Turns what SQLite and the file system say into what the user can do about it.

    Args:
        path: The file.
        go_on: What to do once the obstacle is gone, after "and".

    Raises:
        JournalError: the block failed at the file.
    """
    try:
        yield
    except sqlite3.Error as error:
        said = str(error)
        remedies = {
            "locked": f"another program holds the file; close it and {go_on}",
            "readonly": f"give write permission to the folder and the file, and {go_on}",
            "unable to open": f"give write permission to the folder and the file, and {go_on}",
            "malformed": "the file is damaged; restore it from a copy",
            "not a database": "the file is damaged or not one of estune; restore it from a copy",
            "full": f"the disk is full; make room and {go_on}",
            "I/O": f"the disk does not take what is written; see to it, and {go_on}",
        }
        remedy = next((remedies[key] for key in remedies if key in said), "see the message")
        raise JournalError(f"{path}: {said}; {remedy}") from error
    except OSError as error:
        raise JournalError(
            f"{error.filename or path}: {error.strerror or error}; "
            f"choose a folder that can be written, or mend this one and {go_on}"
        ) from error


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a process without a user's name
        return str(os.getuid())
