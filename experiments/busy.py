"""Load on the machine while something is measured."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager


@contextmanager
def busy(processes: int) -> Iterator[None]:
    """So many processes that never wait."""
    command = [sys.executable, "-c", "while True: pass"]
    with ExitStack() as stack:
        for _ in range(processes):
            process = stack.enter_context(subprocess.Popen(command))  # noqa: S603  ourselves
            stack.callback(process.kill)
        yield
