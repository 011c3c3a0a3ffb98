"""The processes of this experiment: how they are started and ended."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import IO, Any

NO_THREADS = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def started(module: str, *arguments: str, errors: Path, **options: Any) -> subprocess.Popen[bytes]:
    """A process of this experiment; what it says of errors is added to a file.

    By way of this process: what it says must reach the file even where its own disk is full.
    """
    process = subprocess.Popen(  # noqa: S603  our own interpreter and module
        [sys.executable, "-m", f"experiments.chaos.{module}", *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | NO_THREADS,
        **options,
    )
    if process.stderr is not None:
        threading.Thread(target=_keep, args=(process.stderr, errors), daemon=True).start()
    return process


def _keep(stream: IO[bytes], path: Path) -> None:
    with stream, path.open("ab") as file:
        for line in stream:
            file.write(line)
            file.flush()


def end(process: subprocess.Popen[bytes], number: int = signal.SIGKILL) -> int:
    """Ends a process by a signal, and waits for it; killed where it does not obey."""
    if process.poll() is None:
        process.send_signal(number)
        killer = threading.Timer(20.0, process.kill)
        killer.start()
        process.wait()
        killer.cancel()
    if process.stdin is not None:
        with contextlib.suppress(OSError):
            process.stdin.close()
    return process.returncode


def ready() -> None:
    """Called first by a process: Ctrl-C reaches it, and it ends when its parent has ended."""
    # Shells let what they start in the background ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def heard() -> str:
    """What the parent says next; the process ends here when the parent has ended."""
    # Unbuffered: a thread inside a buffered reader would abort the interpreter at its end.
    said = os.read(sys.stdin.fileno(), 4096)
    if not said:
        os._exit(1)
    return said.decode()


def _end_with_parent() -> None:
    while True:
        heard()
