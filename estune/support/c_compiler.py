"""Libraries compiled from C source and cached on disk, safe for concurrent processes.

The file name of a library holds a key (source, compiler and flags) and the digest of its own
bytes, so that a truncated or damaged one is detected before it is loaded, and compiled again.
Libraries are spread over folders by their keys: one folder of ten thousand, as a year of
diagnoses leaves them, takes 7 ms to look through for each.
Files appear by an atomic rename, so that two processes may compile the same source at once.
"""

import contextlib
import ctypes
import hashlib
import logging
import os
import re
import shlex
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

from estune.errors import PlantError

_log = logging.getLogger(__name__)
_noticed = threading.Event()

# With C99, CasADi calls fmin and fmax, which remain calls because of NaN; before C99 it writes a
# comparison, one instruction. It writes a choice as a sum with zero, which costs nothing without
# signed zeros.
FLAGS = (
    *("-std=gnu90", "-fno-math-errno", "-fno-signed-zeros"),
    *("-fPIC", "-shared", "-fvisibility=hidden", "-w"),
)
COMPILE_LIMIT_s = 120.0
_KEY = "[0-9a-f]{32}"


def load(source: str, optimise: str = "-O3") -> ctypes.CDLL:
    """The library of a C source, compiled or from the cache.

    Args:
        optimise: The compiler's option for it: what is run once may be worth less compiling.

    The cache is the folder `ESTUNE_CACHE`, or `estune` in the user's cache folder; if it cannot be
    written, a temporary folder of this process.

    Raises:
        PlantError: there is no compiler, it failed, or the library cannot be loaded.
    """
    command = (*compiler(), optimise)
    key = _key(source, command)
    reason = ""
    for folder in _folders():
        try:
            return _load_cached(folder, key) or _compile(folder, key, source, command)
        except OSError as error:
            reason = f"{folder}: {error.strerror or error}"
    raise PlantError(reason)


def load_beside(module: str, *names: str) -> ctypes.CDLL:
    """The library of C sources in files beside that of a module, one after another.

    Raises:
        PlantError: as of `load`.
    """
    files = (Path(module).with_name(name) for name in names)
    return load("".join(file.read_text(encoding="utf-8") for file in files))


def load_named(name: str, written: Callable[[], str], optimise: str = "-O3") -> ctypes.CDLL:
    """The library of a C source that takes long to write, by a name of it.

    Args:
        name: Text that differs wherever the source differs.
        written: Gives the source; it is called where the cache does not know the name.
        optimise: The compiler's option for it.

    Raises:
        PlantError: there is no compiler, it failed, or the library cannot be loaded.
    """
    command = (*compiler(), optimise)
    folder = next(_folders())
    note = folder / f"{_key(name, command)}.key"
    try:
        key = note.read_text(encoding="ascii")
        library = _load_cached(folder, key) if re.fullmatch(_KEY, key) else None
    except (OSError, UnicodeError):
        library = None
    if library is None:
        source = written()
        library = load(source, optimise)
        with contextlib.suppress(OSError):
            with tempfile.NamedTemporaryFile("w", dir=folder, delete=False) as file:
                file.write(_key(source, command))
            Path(file.name).replace(note)
    return library


def notice(reason: str) -> None:
    """Logs, once per process, that trials run without compiled code."""
    if not _noticed.is_set():
        _noticed.set()
        _log.warning("trials run in CasADi's virtual machine, many times slower: %s", reason)


def compiler() -> tuple[str, ...]:
    """The compiler's command: `CC` if it is set, else `cc`, `gcc` or `clang`.

    Raises:
        PlantError: there is none.
    """
    for name in filter(None, (os.environ.get("CC"), "cc", "gcc", "clang")):
        command = shlex.split(name)
        program = shutil.which(command[0])
        if program:
            return (program, *command[1:])
        if name == os.environ.get("CC"):
            raise PlantError(f"the compiler named by CC, {name!r}, was not found; correct CC")
    raise PlantError("no C compiler found; install gcc or clang, or name one in CC")


def _key(source: str, command: tuple[str, ...]) -> str:
    """Digest of everything the library depends on; of the compiler, size and age of its file."""
    program = Path(command[0]).resolve()
    status = program.stat()
    parts = (source, *command, *FLAGS, str(program), str(status.st_size), str(status.st_mtime_ns))
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


def _folders() -> Iterator[Path]:
    """The cache folder, then a temporary one of this process."""
    try:
        chosen = os.environ.get("ESTUNE_CACHE")
        shared = os.environ.get("XDG_CACHE_HOME")
        folder = Path(chosen) if chosen else Path(shared or Path.home() / ".cache") / "estune"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        yield folder
    except (OSError, RuntimeError):  # RuntimeError: no home folder
        pass
    yield Path(_temporary().name)


@cache
def _temporary() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="estune-", ignore_cleanup_errors=True)


def _load_cached(folder: Path, key: str) -> ctypes.CDLL | None:
    for path in (folder / key[:2]).glob(f"{key}-*.so"):
        if path.name == _name(key, path.read_bytes()):
            return ctypes.CDLL(str(path))
        path.unlink(missing_ok=True)
    return None


def _compile(folder: Path, key: str, source: str, command: tuple[str, ...]) -> ctypes.CDLL:
    with tempfile.TemporaryDirectory(prefix="making-", dir=folder) as workshop:
        written, product = Path(workshop, "generated.c"), Path(workshop, "generated.so")
        written.write_text(source)
        arguments = [*command, *FLAGS, "-o", str(product), str(written), "-lm"]
        try:
            done = subprocess.run(  # noqa: S603  the compiler is the user's own choice
                arguments, capture_output=True, text=True, timeout=COMPILE_LIMIT_s, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise PlantError(
                f"{command[0]} did not finish within {COMPILE_LIMIT_s:g} s"
            ) from error
        if done.returncode or not product.exists():
            lines = done.stderr.strip().splitlines() or ["no message"]
            raise PlantError(f"{command[0]} failed: {lines[0]}")
        path = folder / key[:2] / _name(key, product.read_bytes())
        path.parent.mkdir(exist_ok=True)
        product.replace(path)
    return ctypes.CDLL(str(path))


def _name(key: str, content: bytes) -> str:
    return f"{key}-{hashlib.sha256(content).hexdigest()[:32]}.so"
