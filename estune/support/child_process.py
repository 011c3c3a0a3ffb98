"""Programs of this project in processes of their own, for the duration of a block."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from estune.errors import RigError


@contextmanager
def child_process(
    *arguments: str, end_within_s: float = 0.0, **options: Any
) -> Iterator["subprocess.Popen[str]"]:
    """`python -m ...` with pipes for standard input and output, ended with the block.

    Its standard input closes at the end of the block, and however this process ends, too: so a
    program that reads it ends by itself.

    Args:
        *arguments: Module, and its arguments.
        end_within_s: Time in which it may end by itself before it is killed, s.
        **options: Further options of `subprocess.Popen`.
    """
    # -P: a folder of the working directory must not hide an installed package.
    command = [sys.executable, "-P", "-m", *arguments]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE} | options
    process = subprocess.Popen(command, text=True, **pipes)  # noqa: S603  our own interpreter and module
    try:
        yield process
    finally:
        for stream in (process.stdin, process.stdout, process.stderr):
            if stream:
                with suppress(BrokenPipeError):
                    stream.close()
        try:
            process.wait(end_within_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def next_line(process: "subprocess.Popen[str]") -> str:
    """The next line that a process prints, without its end.

    Raises:
        RigError: it has ended instead.
    """
    line = process.stdout.readline() if process.stdout else ""
    if not line:
        words = process.args if isinstance(process.args, list) else [process.args]
        raise RigError(
            f"a process has ended unasked (exit code {process.wait()}); run it by itself: "
            f"python {' '.join(map(str, words[2:]))}"
        )
    return line.strip()
