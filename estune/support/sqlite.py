"""SQLite files that survive kill -9 and power loss: base of the journal, ledger and stores.

A store holds one `SqliteFile` and describes its kind once:

    KIND = FileKind("a run", VERSIONS, "continue with: estune resume {folder}", "writer.lock")

    file = SqliteFile.open_writer(path, KIND, prepare=prepare)  # creates it if missing
    file = SqliteFile.open_reader(path, KIND)  # the file must exist

    file.rows("SELECT P, I FROM trial WHERE number=?", 3)  # a list of tuples
    file.write("INSERT INTO trial VALUES (?, ?)", 3, "abc")  # committed; returns the row number
    with file.transaction():  # all or nothing; blocks nest
        file.write(...)
        file.write_many("INSERT INTO fact VALUES (?, ?)", [("a", 1), ("b", 2)])

`prepare(file)` runs in the transaction that creates or migrates the tables: where `file.is_new`
it writes the first rows, else it checks whose file it is; it may raise, and nothing is changed.
Every method raises `JournalError` with the file, the obstacle and the remedy. Any thread may call;
a transaction holds the file's own lock (reentrant), so other threads wait until it ends. A thread
that must not wait for the disk reads through a second `SqliteFile`, opened by `open_reader`.

In WAL mode with synchronous=FULL, what was committed is on disk, and readers never block the
writer. One process writes: a lock file, released by the system if the process dies, refuses a
second writer. The file's `user_version` is the version of its schema.
"""

import os
import shlex
import sqlite3
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple, Self

from estune.errors import JournalError
from estune.support import file_lock
from estune.support.closing import Closing
from estune.support.user import user_name

_LARGE_bytes = 64 * 2**20
"""Size from which on tables with checksums are not checked when a file is opened."""


class FileKind(NamedTuple):
    """Properties that the files of one kind of store have in common.

    Attributes:
        noun: What such a file is, with its article, for messages.
        versions: SQL that makes schema n + 1 out of schema n, from n = 0 (an empty file) on.
        continuation: What to do once an obstacle is removed, for messages; {folder} is its folder.
        lock_name: Name of the writer's lock file; by default that of the file and `.lock`.
        checksummed: Tables whose rows have checksums of their own, checked when they are read.
    """

    noun: str
    versions: tuple[str, ...]
    continuation: str
    lock_name: str = ""
    checksummed: tuple[str, ...] = ()

    def lock_path(self, path: Path) -> Path:
        """The lock file beside a file of this kind."""
        return path.with_name(self.lock_name or f"{path.name}.lock")


class SqliteFile(Closing):
    """One open SQLite file.

    Attributes:
        is_new: Whether this process has just begun it.
    """

    def __init__(
        self, path: Path, kind: FileKind, connection: sqlite3.Connection, opened: ExitStack
    ) -> None:
        """Use `open_writer` or `open_reader`."""
        self.path = path
        self.is_new = False
        self._kind = kind
        self._connection = connection
        self._opened = opened
        self._lock = threading.RLock()
        self._inode = _inode(path)

    @classmethod
    def open_writer(
        cls,
        path: Path,
        kind: FileKind,
        *,
        create: bool = True,
        prepare: Callable[[Self], None] = lambda _: None,
    ) -> Self:
        """Opens a file for the one process that writes it.

        Args:
            create: Whether to begin the file if there is none, and its folder.
            prepare: Called with the file before its new or migrated tables are committed.

        Raises:
            JournalError: another process writes it, it is from a newer version, damaged, of
                another kind, or cannot be written.
        """
        is_begun = create and not path.exists()
        # There is nothing yet that could be continued.
        so_far = kind._replace(continuation="begin again") if is_begun else kind
        with _explained(path, so_far), ExitStack() as opened:
            if create:
                path.parent.mkdir(parents=True, exist_ok=True)
            opened.enter_context(_lock(path, kind))
            if create and not path.exists():  # asked again: nobody else begins it now

                def discard(error: type[BaseException] | None, *_: object) -> None:
                    if error is not None:
                        path.unlink(missing_ok=True)

                opened.push(discard)
            file = cls(path, so_far, _connect(opened, path, "rwc" if create else "rw"), opened)
            file.is_new = create and file._version() == 0
            if not file.is_new:
                file._check()
            file._connection.execute("PRAGMA journal_mode=WAL")
            with file.transaction():
                file._migrate()
                prepare(file)
            file._inode, file._kind = _inode(path), kind
            file._opened = opened.pop_all()
        return file

    @classmethod
    def open_reader(cls, path: Path, kind: FileKind, *, briefly: bool = False) -> Self:
        """Opens an existing file for reading; migrates one of an older schema first.

        Args:
            briefly: Whether a file that nobody writes is read without the shared index that a
                reader beside a writer needs, which takes longer to make than a small file to
                read. For a reader that reads again what changes.

        Raises:
            JournalError: there is none, it is from a newer version or of another kind.
        """
        with _explained(path, kind), ExitStack() as opened:
            # Without the right to write, SQLite cannot make the shared index a WAL reader needs.
            unshared = not os.access(path.parent, os.W_OK) and not Path(f"{path}-wal").exists()
            unshared = unshared or (briefly and _is_at_rest(path))
            mode = "ro&immutable=1" if unshared else "ro"
            file = cls(path, kind, _connect(opened, path, mode), opened)
            file._check_version()
            if file._version() < len(kind.versions):
                if os.access(path, os.W_OK) and os.access(path.parent, os.W_OK):
                    cls.open_writer(path, kind, create=False).close()
                else:
                    file._migrate_copy(opened)
            file._opened = opened.pop_all()
        return file

    def rows(self, statement: str, *values: Any) -> list[Any]:
        """All rows of a query, as tuples."""
        with self._lock, _explained(self.path, self._kind):
            return self._connection.execute(statement, values).fetchall()

    def write(self, statement: str, *values: Any) -> int:
        """Executes one statement, committed at once outside of a transaction; the row's number."""
        with self._lock, _explained(self.path, self._kind):
            return self._connection.execute(statement, values).lastrowid or 0

    def write_many(self, statement: str, rows: Iterable[Iterable[Any]]) -> None:
        """Executes one statement for each row, all or none."""
        with self.transaction():
            self._connection.executemany(statement, [tuple(row) for row in rows])

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Commits all that is written in the block at its end, or nothing; blocks nest."""
        with self._lock, _explained(self.path, self._kind):
            is_nested = self._connection.in_transaction
            if is_nested:
                yield
                return
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._connection.execute("COMMIT")
            except BaseException:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                raise

    @property
    def changes(self) -> int:
        """Number of rows that this connection has changed, committed or not."""
        return self._connection.total_changes

    def is_in_place(self) -> bool:
        """Whether the path still names the file that was opened, not another or none."""
        return _inode(self.path) == self._inode

    def close(self) -> None:
        """Closes the file and releases the writer's lock; what was committed stays."""
        with self._lock:
            self._opened.close()

    def _version(self) -> int:
        return int(self._connection.execute("PRAGMA user_version").fetchone()[0])

    def _check_version(self) -> None:
        version, newest = self._version(), len(self._kind.versions)
        if not 1 <= version <= newest:
            remedy = "use a newer" if version > newest else f"it is not {self._kind.noun} of"
            raise JournalError(
                f"{self.path} has schema version {version}, this estune knows {newest}; "
                f"{remedy} estune"
            )

    def _check(self) -> None:
        self._check_version()
        faults = [row[0] for check in self._checks() for row in self._connection.execute(check)]
        fault = next((fault for fault in faults if fault != "ok"), None) or self._missing_end()
        if fault:
            raise JournalError(f"{self.path} is damaged ({fault}); restore it from a copy")

    def _checks(self) -> list[str]:
        """Statements that check the file: all of it, or a large one without checksummed tables."""
        if not self._kind.checksummed or self.path.stat().st_size < _LARGE_bytes:
            return ["PRAGMA quick_check(1)"]
        tables = self._connection.execute("SELECT name FROM sqlite_schema WHERE type='table'")
        names = {name for (name,) in tables} - set(self._kind.checksummed)
        return [f"PRAGMA quick_check('{name}')" for name in sorted(names)]

    def _missing_end(self) -> str:
        """A sentence on the part of the file that is cut off; empty if it is whole."""
        page_count, page_size = "PRAGMA page_count", "PRAGMA page_size"
        pages, size = (self._connection.execute(s).fetchone()[0] for s in (page_count, page_size))
        wal = Path(f"{self.path}-wal")
        missing = int(pages * size) - self.path.stat().st_size
        if missing <= 0 or (wal.exists() and wal.stat().st_size):  # the rest is in the log
            return ""
        return f"{missing} bytes are missing at its end"

    def _migrate(self) -> None:
        """Brings the file to the newest schema, inside the caller's transaction."""
        for number in range(self._version(), len(self._kind.versions)):
            for statement in self._kind.versions[number].split(";"):
                self._connection.execute(statement)
            self._connection.execute(f"PRAGMA user_version={number + 1}")

    def _migrate_copy(self, opened: ExitStack) -> None:
        """Reads on in a temporary copy of the newest schema; the file cannot be written."""
        copy = sqlite3.connect("", isolation_level=None, check_same_thread=False)
        opened.callback(copy.close)
        self._connection.backup(copy)
        self._connection = copy
        self._migrate()


def has_writer(path: Path, kind: FileKind) -> bool:
    """Whether a process holds the right to write this file."""
    try:
        with kind.lock_path(path).open() as lock:
            file_lock.lock(lock, shared=True)
    except BlockingIOError:
        return True
    except OSError:  # no lock file, or not readable for this user: no sign of a writer
        return False
    return False


def _connect(opened: ExitStack, path: Path, mode: str) -> sqlite3.Connection:
    """A connection without implicit transactions, closed with the stack."""
    address = f"{path.resolve().as_uri()}?mode={mode}"
    connection = sqlite3.connect(
        address, uri=True, isolation_level=None, timeout=2.0, check_same_thread=False
    )
    opened.callback(connection.close)
    connection.execute("PRAGMA synchronous=FULL")
    return connection


def _is_at_rest(path: Path) -> bool:
    """Whether all that was written to a file is in it."""
    try:
        return Path(f"{path}-wal").stat().st_size == 0
    except FileNotFoundError:
        return True


def _lock(path: Path, kind: FileKind) -> IO[str]:
    """The right to write, held until closed; the lock file names its holder."""
    lock = kind.lock_path(path).open("a+", encoding="utf-8")
    try:
        file_lock.lock(lock)
    except BlockingIOError:
        lock.seek(0)
        holder = lock.readline().strip()
        lock.close()
        raise JournalError(
            f"{path} is being written by another process{holder and f' ({holder})'}; "
            "wait for it or stop it"
        ) from None
    lock.truncate(0)
    lock.write(f"process {os.getpid()} of {user_name()}\n")
    lock.flush()
    return lock


def _inode(path: Path) -> tuple[int, int] | None:
    """Identity of the file at a path; None if there is none."""
    try:
        stat = path.stat()
    except FileNotFoundError:
        return None
    return stat.st_dev, stat.st_ino


@contextmanager
def _explained(path: Path, kind: FileKind) -> Iterator[None]:
    """Adds the remedy to an error of SQLite or the file system.

    Raises:
        JournalError: the block failed at the file.
    """
    go_on = kind.continuation.format(folder=shlex.quote(str(path.parent)))
    try:
        yield
    except sqlite3.Error as error:
        remedies = {
            "locked": f"another program holds the file; close it and {go_on}",
            "readonly": f"give write permission to the folder and the file, and {go_on}",
            "unable to open": f"give write permission to the folder and the file, and {go_on}",
            "malformed": "the file is damaged; restore it from a copy",
            "not a database": "the file is damaged or not one of estune; restore it from a copy",
            "full": f"the disk is full; make room and {go_on}",
            "I/O": f"disk write error; check the disk and {go_on}",
        }
        remedy = next((remedies[key] for key in remedies if key in str(error)), "see the message")
        raise JournalError(f"{path}: {error}; {remedy}") from error
    except OSError as error:
        raise JournalError(
            f"{error.filename or path}: {error.strerror or error}; "
            f"choose a folder that can be written, or repair this one and {go_on}"
        ) from error
