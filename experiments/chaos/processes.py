"""Start and end of the processes of this experiment."""

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
    """A process of this experiment, its standard error appended to a file.

    This process does the writing: the text must reach the file even if the disk of the other is
    full.
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
        threading.Thread(target=_append, args=(process.stderr, errors), daemon=True).start()
    return process


def _append(stream: IO[bytes], path: Path) -> None:
    with stream, path.open("ab") as file:
        for line in stream:
            file.write(line)
            file.flush()


def end(process: subprocess.Popen[bytes], number: int = signal.SIGKILL) -> int:
    """Ends a process by a signal; kills it after 20 s. Returns its exit code."""
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
    """Lets Ctrl-C reach this process, and ends it when its parent has ended; called first."""
    # Shells let what they start in the background ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def read_command() -> str:
    """Next words of the parent; the process ends here when the parent has ended."""
    # Unbuffered: a thread inside a buffered reader would abort the interpreter at its end.
    text = os.read(sys.stdin.fileno(), 4096)
    if not text:
        os._exit(1)
    return text.decode()


def _end_with_parent() -> None:
    while True:
        read_command()
