"""A Dask cluster of separate processes on loopback, which a test can kill one by one."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

_START_TIMEOUT_s = 60.0


class Cluster(NamedTuple):
    """Address of the scheduler, and the processes."""

    address: str
    scheduler: subprocess.Popen[bytes]
    workers: tuple[subprocess.Popen[bytes], ...]


@contextmanager
def cluster(workers: int) -> Iterator[Cluster]:
    """A scheduler and workers of one thread each, for the duration of the block."""
    with TemporaryDirectory() as folder:
        file = Path(folder, "scheduler.json")
        scheduler = _start("scheduler", "--host", "127.0.0.1", "--port", "0",
                             "--no-dashboard", "--scheduler-file", str(file))  # fmt: skip
        started = [scheduler]
        try:
            address = json.loads(_content(file, scheduler))["address"]
            options = ("--nthreads", "1", "--no-nanny", "--no-dashboard")
            started += [
                _start("worker", address, *options, "--local-directory", folder)
                for _ in range(workers)
            ]
            yield Cluster(address, scheduler, tuple(started[1:]))
        finally:
            for process in reversed(started):
                process.kill()
            for process in started:
                process.wait()


def _start(kind: str, *arguments: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", f"distributed.cli.dask_{kind}", *arguments],
        stderr=subprocess.DEVNULL,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )


def _content(file: Path, writer: subprocess.Popen[bytes]) -> str:
    end = time.monotonic() + _START_TIMEOUT_s
    while time.monotonic() < end and writer.poll() is None:
        text = file.read_text(encoding="utf-8") if file.exists() else ""
        if text.strip().endswith("}"):
            return text
        time.sleep(0.05)
    raise TimeoutError(f"the scheduler wrote nothing into {file}")
